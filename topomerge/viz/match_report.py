"""The report of a matching: both plans, rooms coloured by how sure their match is, and what stands around them side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.archive import replace_on_success
from topomerge.embedding.sheets import build_sheet_arrays
from topomerge.embedding.surroundings import CROP, CROP_PLANES, SHEET_PIXEL, cut_crops
from topomerge.fusion.result import RoomMatch
from topomerge.matching.match import Matching
from topomerge.types import Array, TopometricMap
from topomerge.viz.merge_plan import lay_out_pair, render_lines
from topomerge.viz.merge_report import FOR, PIXEL_COLOURS, SILENT, UNKNOWN, encode_png_uri, flip_north_up
from topomerge.viz.report import render_page, render_plan_view, render_scroller, render_section
from topomerge.viz.tables import (
    Markup,
    build_element,
    join,
    render_cell,
    render_properties,
    render_room_link,
    render_share_bar,
    render_table,
)

PRESENT = 64  # of 255: so much of a pixel is drawn as of a kind
ROOM_TINT = np.array([196, 222, 240], np.uint8)  # the floor of the room in the middle


def save_match_report(matching: Matching, a: TopometricMap, b: TopometricMap, path: str | Path) -> None:
    """Write the report. The same matching gives the same bytes.

    Raises:
        InputError: the path can't be written.
    """
    text = render_match_html(matching, a, b)
    with replace_on_success(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="replace", newline="\n")


def render_match_html(matching: Matching, a: TopometricMap, b: TopometricMap) -> str:
    """Return the report as HTML: the plans, a line for each match, and for each match what stands around both rooms."""
    matches = [
        RoomMatch((0, 1), (i, j), float(p)) for (i, j), p in zip(matching.rooms.tolist(), matching.probability, strict=True)
    ]
    drawn = lay_out_pair(a, b, matching.transform)
    shades = [_compute_shades(m, matching.rooms[:, k], matching.probability) for k, m in enumerate((a, b))]
    views = []
    for name, m, (sheet, plans), colours in zip("ab", (a, b), drawn, shades, strict=True):
        head = build_element("h3", f"{name}: {m.title} ", build_element("small", f"{len(m.rooms)} rooms"))
        views.append(build_element("div", head, render_plan_view(m, sheet, plans, colours)))
    text = "Green rooms have a match (greener: more probable), grey ones none. Click a room to compare the surroundings."
    compared = [
        build_element("p", text, class_="note"),
        build_element("div", *views, class_="pair"),
        build_element("div", *_render_pairs(matches, a, b), class_="places"),
    ]
    sections = [
        _render_summary(matches, a, b),
        render_section("The two maps", join(compared), "places"),
        render_section(
            "Room matches",
            build_element("div", render_lines((a, b), drawn, matches, shades), class_="sheet"),
            "lines",
        ),
        render_section("Matched rooms", render_scroller(_render_table(matches, a, b)), "matches"),
        render_section("How it was made", _render_provenance(matching, a, b), "made"),
    ]
    names = " + ".join(m.title for m in (a, b))
    return render_page(names, "Rooms of two maps", sections, {"mates": _collect_partners(matches)})


def _render_summary(matches: Sequence[RoomMatch], a: TopometricMap, b: TopometricMap) -> Markup:
    sure = sum(match.probability >= 0.5 for match in matches)
    figures = [
        (len(a.rooms), "rooms of a"),
        (len(b.rooms), "rooms of b"),
        (len(matches), "matches"),
        (sure, "with probability 0.5 or more"),
    ]
    items = [build_element("li", build_element("b", str(value)), build_element("span", name)) for value, name in figures]
    return build_element("ul", *items, class_="summary")


def _compute_shades(map: TopometricMap, rooms: Array, probability: Array) -> Array:
    """(R, 3) uint8, from grey (no match) to green (sure)."""
    sure = np.zeros(len(map.rooms))
    np.maximum.at(sure, rooms, probability)
    return np.round(SILENT + sure[:, None] * (FOR - SILENT)).astype(np.uint8)


def _render_pairs(matches: Sequence[RoomMatch], a: TopometricMap, b: TopometricMap) -> list[Markup]:
    """What stands around the rooms of each match, folded."""
    if not matches:
        return []
    around_a, around_b = (cut_crops(build_sheet_arrays(m)) for m in (a, b))
    rooms = np.array([match.rooms for match in matches])
    turned = np.rot90(around_b, find_aligning_quarters(around_a[rooms[:, 0]], around_b[rooms[:, 1]]), (1, 2))
    out = []
    for match in matches:
        i, j = match.rooms
        images = [
            build_element(
                "img",
                src=encode_png_uri(draw_surroundings(crop)),
                alt=f"room {r} of {name} from above",
                width="192",
                height="192",
            )
            for name, r, crop in (("a", i, around_a[i]), ("b", j, turned[j]))
        ]
        text = f"{CROP * SHEET_PIXEL:g} m around room {i} of a and room {j} of b, turned alike"
        cards = build_element("div", build_element("figure", *images, build_element("figcaption", text)), class_="cards")
        head = build_element(
            "summary", render_room_link("a", i), " matches ", render_room_link("b", j), f", probability {match.probability:.2f}"
        )
        out.append(build_element("details", head, cards, data_room_of_a=i, data_room_of_b=j))
    return out


def find_aligning_quarters(a: Array, b: Array) -> int:
    """Quarter turns, counter-clockwise, after which most walls around rooms of b are where they are around their partners in a.

    Args:
        a, b: (M, CROP, CROP, len(CROP_PLANES)) of `crops`, a row for each match.
    """
    wall = CROP_PLANES.index("wall")
    first, second = a[..., wall].astype(np.float32), b[..., wall].astype(np.float32)
    return int(np.argmax([(first * np.rot90(second, k, (1, 2))).sum() for k in range(4)]))


def draw_surroundings(crop: Array) -> Array:
    """Draw (CROP, CROP, 3) uint8 picture of what stands around a room, up where y is large."""
    of = dict(zip(CROP_PLANES, np.moveaxis(crop, -1, 0), strict=True))
    image = np.full((*crop.shape[:2], 3), UNKNOWN, np.uint8)
    image[(of["explored"] >= PRESENT) | (of["floor"] >= PRESENT)] = PIXEL_COLOURS["free"]
    image[of["room"] > 0] = ROOM_TINT
    image[np.maximum(of["low"], of["high"]) >= PRESENT] = PIXEL_COLOURS["clutter"]
    image[of["wall"] >= PRESENT] = PIXEL_COLOURS["wall"]
    return flip_north_up(image)


def _render_table(matches: Sequence[RoomMatch], a: TopometricMap, b: TopometricMap) -> Markup:
    columns = [(name, "number") for name in ("room of a", "area m²", "room of b", "area m²")] + [("probability", "text")]
    rows = []
    for match in matches:
        cells = []
        for key, m, room in zip("ab", (a, b), match.rooms, strict=True):
            area = float(m.rooms["area"][room])
            cells += [render_cell(render_room_link(key, room), room), render_cell(f"{area:.1f}", area)]
        rows.append(build_element("tr", *cells, render_cell(render_share_bar(match.probability), match.probability, kind="text")))
    return render_table(columns, rows, "Matched rooms")


def _render_provenance(matching: Matching, a: TopometricMap, b: TopometricMap) -> Markup:
    sources = {name: m.source or "–" for name, m in zip("ab", (a, b), strict=True)}
    poses = {
        f"{k + 1}": f"probability {h.probability:.2f}, {len(h.rooms)} matches, rotation {np.degrees(h.transform.yaw):.1f}°"
        for k, h in enumerate(matching.alternatives[:5])
    }
    return build_element(
        "div",
        render_properties(sources, "Maps"),
        render_properties(poses or {"poses": "none needed"}, "Poses of b"),
        class_="facts-row",
    )


def _collect_partners(matches: Sequence[RoomMatch]) -> dict[str, Any]:
    """Room as the page calls it -> its partners."""
    mates: dict[str, list[str]] = {}
    for match in matches:
        one, other = (f"{name}{room}" for name, room in zip("ab", match.rooms, strict=True))
        mates.setdefault(one, []).append(other)
        mates.setdefault(other, []).append(one)
    return dict(sorted(mates.items()))
