"""What each room says of a merge: the rooms of the first map coloured by it, and both maps side by side, place by place."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from topomerge.fusion.transfer import laid_floor
from topomerge.registration.evidence.crops import PARTS
from topomerge.registration.evidence.places import MOST_ODDS, Places
from topomerge.types import Array, Placement, Sim3, TopometricMap
from topomerge.viz.markup import Markup, element, join
from topomerge.viz.merge_plan import Drawn
from topomerge.viz.report import plan_view, section
from topomerge.viz.tables import room_link

MOST_SHOWN = 40  # places, those that say most
REACH = 3.0  # m between the middle of a place and the nearest floor of a room
AGAINST, FOR, SILENT = np.array([201, 64, 48.0]), np.array([38, 140, 86.0]), np.array([205, 203, 196.0])
PIXEL_COLOURS = {"free": (236, 234, 228), "clutter": (224, 152, 60), "wall": (40, 44, 52), "hanging": (120, 160, 214)}
UNKNOWN = (160, 160, 156)


def places_section(a: TopometricMap, drawn: Drawn, places: Places) -> Markup:
    """The plan of map a with its rooms in the colours of what they say, and the places that say most."""
    rooms = rooms_of(a, places)
    odds = room_log_odds(places, rooms, len(a.rooms))
    sheet, plans = drawn
    words = "Green rooms look the same in both maps, red ones more like another room; grey ones give no evidence."
    view = plan_view(a, sheet, plans, room_shades(odds))
    order = np.argsort(-np.abs(places.log_odds), kind="stable")[:MOST_SHOWN]
    by_room = sorted({int(rooms[k]) for k in order}, key=lambda i: odds[i] if i >= 0 and np.isfinite(odds[i]) else 0.0)
    groups = [_room(i, [int(k) for k in order if rooms[k] == i], odds, places) for i in by_room]
    note = "Click a room to see what was compared there, map a left, map b right; rooms with evidence against come first."
    parts = [
        element("p", words, class_="note"),
        view,
        element("p", note, class_="note"),
        element("div", *groups, class_="places"),
    ]
    return section("Evidence by room", join(parts), "places")


def rooms_of(map: TopometricMap, places: Places) -> Array:
    """(k,) room of a map in which each place is, -1 none."""
    floor, room = laid_floor(map, Placement.of(Sim3(), None))
    inside = room >= 0
    if not inside.any() or not len(places):
        return np.full(len(places), -1, np.int64)
    away, near = cKDTree(floor[inside]).query(places.crops.middle)
    out: Array = np.where(away <= REACH, room[inside][near], -1)
    return out


def room_log_odds(places: Places, rooms: Array, count: int) -> Array:
    """(count,) mean log odds of the places in each room; nan where nothing was compared."""
    odds = np.clip(places.log_odds, -MOST_ODDS, MOST_ODDS)
    inside = rooms >= 0
    total, weight = (np.bincount(rooms[inside], w[inside], count) for w in (odds * places.crops.area, places.crops.area))
    return np.where(weight > 0, total / np.maximum(weight, 1e-9), np.nan)


def room_shades(odds: Array) -> Array:
    """(R, 3) uint8 from red (against) over grey to green (for)."""
    share = np.nan_to_num(np.clip(odds / MOST_ODDS, -1, 1))[:, None]
    return np.where(share >= 0, SILENT + share * (FOR - SILENT), SILENT - share * (AGAINST - SILENT)).round().astype(np.uint8)


def _room(room: int, shown: Sequence[int], odds: Array, places: Places) -> Markup:
    """A room's places, folded."""
    name = room_link("a", room) if room >= 0 else Markup("outside rooms")
    words = f" {said(float(odds[room]))}, {len(shown)} shown" if room >= 0 else f" {len(shown)} shown"
    cards = [_card(k, places) for k in shown]
    return element("details", element("summary", name, words), element("div", *cards, class_="cards"), data_room_of_a=room)


def _card(k: int, places: Places) -> Markup:
    images = [
        element("img", src=png_uri(crop_image(places.crops.parts[k, m])), alt=f"map {name} from above", width="128", height="128")
        for m, name in enumerate("ab")
    ]
    caption = f"{said(float(places.log_odds[k]))} · {places.crops.area[k]:.0f} m²"
    return element("figure", *images, element("figcaption", caption))


def said(odds: float) -> str:
    """Log odds in words."""
    if abs(odds) < 0.5:
        return "little evidence"
    times = np.exp(min(abs(odds), MOST_ODDS))
    return f"{times:.0f} times as likely {'the same place' if odds > 0 else 'another place'}"


def crop_image(parts: Array) -> Array:
    """(side, side, 3) uint8 picture of a square, north up."""
    image = np.full((*parts.shape, 3), UNKNOWN, np.uint8)
    for name, colour in PIXEL_COLOURS.items():
        image[(parts >> PARTS.index(name) & 1) > 0] = colour
    return drawn_north_up(image)


def drawn_north_up(image: Array) -> Array:
    """Pixels (x, y, 3) as rows of a picture, the largest y first."""
    return np.ascontiguousarray(image.transpose(1, 0, 2)[::-1])


def png_uri(image: Array) -> str:
    """A picture (h, w, 3) uint8 as a PNG in a data URI: the same picture gives the same bytes."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode("ascii")
