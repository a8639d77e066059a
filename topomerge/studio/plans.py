"""Drawings of a map for the page: plans of its storeys as outlines, doors and labels, on a paper in cm."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from topomerge.io.rooms_ply import PALETTE, WALL_BETWEEN, assign_colour_numbers
from topomerge.structure.floors import compute_jambs
from topomerge.types import LANDMARK_KINDS, Array, TopometricMap, classify_door_state, find_room_names
from topomerge.viz.plan import (
    StoreyCells,
    StoreyView,
    compute_frame,
    find_label_place,
    format_hex_colour,
    locate_storey_cells,
    paint_rooms,
)
from topomerge.viz.svg import Sheet, build_sheet, fill_rooms, trace_observed_floor, trace_room, trace_walls

DRAWN_KINDS = ("text", "tag", "object", "name")  # of landmarks: radio and the like are many, use and area belong to rooms
MOST_LANDMARKS = 2000  # of a storey, the surest
PASSED = ("door", "opening")  # kinds of edges that stand in walls


class Outline(NamedTuple):
    """A room on paper, cm: the `d` of its path, where its name stands, and how much space is about it."""

    d: str
    x: int
    y: int
    clear: int


Outlines = dict[bytes, Outline]  # digest of the pixels of a room -> its outline


@dataclass(frozen=True, eq=False)
class DrawnPlan:
    """How a map was drawn, so that what it becomes is drawn in the same place, in the same colours and in less time.

    Args:
        sheet: the paper.
        cells: of each storey.
        walked: (m,) int32 storey of each navigable cell: while these stay, so do `cells`.
        walls: outlines of the walls of each storey; None of those that were not traced.
        rooms: (nx, ny) int32 room of each pixel, -1 none, of each storey.
        colours: (R,) int64 numbers in `PALETTE`.
        outlines: of its rooms.
    """

    sheet: Sheet
    cells: list[StoreyCells]
    walked: Array
    walls: tuple[str | None, ...]
    rooms: tuple[Array, ...]
    colours: Array
    outlines: Outlines


def build_plan_data(
    map: TopometricMap, before: DrawnPlan | None = None, most: int | None = None
) -> tuple[dict[str, Any], DrawnPlan]:
    """Build the plans of all storeys, as plain values.

    Args:
        map: any map.
        before: how it was drawn before it was corrected; None: on new paper.
        most: storeys from the lowest on that are traced; of the others there are no outlines. None: all.

    Returns:
        `back` (a, b, c, d, e, f: paper to m, as `Sheet.back`), `size` (cm), `turn` (rad), `low` and `high` (m), `rooms` (their
        number), `storeys`, lowest first, each with `floor` (m), `rooms`, `walls`, `seen`, `doors`, `stairs`, `windows`,
        `narrows`, `landmarks`; and how it is drawn.
    """
    walked = np.append(map.rooms["storey"], -1)[map.navigable_room].astype(np.int32)
    frame = compute_frame(map) if before is None else before.sheet.frame
    stays = before is not None and np.array_equal(walked, before.walked)
    cells = before.cells if before is not None and stays else locate_storey_cells(map, frame)
    plans = [paint_rooms(map, one) for one in cells]
    sheet = build_sheet(plans, frame) if before is None else before.sheet
    rasters = tuple(plan.room for plan in plans)
    colours = assign_colours(len(map.rooms), _find_neighbours(map, rasters, sheet.frame.size), _find_old_colours(rasters, before))
    about, known = _describe_rooms(map, PALETTE[colours].reshape(-1, 3)), before.outlines if before is not None else {}
    kept: Outlines = {}
    storeys, walls = [], []
    for s, plan in enumerate(plans):
        wall = before.walls[s] if before is not None and stays else None
        rooms: list[dict[str, Any]] = []
        if most is None or s < most:
            wall = trace_walls(plan, sheet) if wall is None else wall
            outlines = _trace_storey(plan, sheet, known, kept)
            rooms = [{**about[i], "d": o.d, "x": o.x, "y": o.y, "clear": o.clear} for i, o in outlines.items()]
        walls.append(wall)
        outside = {"walls": wall or "", "seen": trace_observed_floor(plan, sheet) if rooms else ""}
        storeys.append({"rooms": rooms, **outside, **_list_parts(map, sheet, s)})
    low, high = map.grid.bounds if len(map.grid) else (np.zeros(3), np.zeros(3))
    listing = {
        "back": [round(v, 9) for v in sheet.back],
        "size": list(sheet.size),
        "turn": sheet.turn,
        "low": _round_place(low),
        "high": _round_place(high),
        "rooms": len(map.rooms),
        "storeys": storeys,
    }
    return listing, DrawnPlan(sheet, cells, walked, tuple(walls), rasters, colours, kept)


def _trace_storey(
    plan: StoreyView, sheet: Sheet, known: Mapping[bytes, Outline], kept: dict[bytes, Outline]
) -> dict[int, Outline]:
    """Map each room to its outline; one whose pixels are known is not traced again. All go to `kept`."""
    room = fill_rooms(plan, sheet.frame)
    outlines = {}
    for i, box in enumerate(ndimage.find_objects(room + 1)):
        if box is None:
            continue
        filled, own = room[box] == i, plan.room[box] == i
        place = np.array([[side.start, side.stop] for side in box])
        key = hashlib.blake2b(
            place.tobytes() + np.packbits(filled).tobytes() + np.packbits(own).tobytes(), digest_size=16
        ).digest()
        if (outline := known.get(key)) is None:
            name = find_label_place(own, plan.wall[box], box, sheet.frame)
            x, y = sheet.locate((name.x, name.y))
            outline = Outline(trace_room(filled, sheet, box), x, y, round(100 * name.clear))
        outlines[i] = kept[key] = outline
    return outlines


def _find_neighbours(map: TopometricMap, rasters: Sequence[Array], size: float) -> Array:
    """Return (k, 2) int64 pairs of rooms, ascending, that a door or a wall's thickness parts; told by the plans, in a tenth of
    the time that all cells of the floors would take."""
    count = max(len(map.rooms), 1)
    codes = [map.edges["rooms"].astype(np.int64) @ (count, 1)]
    for room in rasters:
        for step in range(1, round(WALL_BETWEEN / size) + 2):
            for one, other in ((room[:-step], room[step:]), (room[:, :-step], room[:, step:])):
                met = (one != other) & (one >= 0) & (other >= 0)
                codes.append(one[met].astype(np.int64) * count + other[met])
    unique = np.unique(np.concatenate(codes))
    out: Array = np.unique(np.sort(np.stack([unique // count, unique % count], axis=1), axis=1), axis=0)
    return out


def _find_old_colours(rasters: Sequence[Array], before: DrawnPlan | None) -> dict[int, int]:
    """Map each room to the colour that most of its floor had, those with the most floor first."""
    if before is None or not len(before.colours):
        return {}
    count = len(before.colours)
    codes = []
    for new, old in zip(rasters, before.rooms, strict=True):
        both = (new >= 0) & (old >= 0)
        codes.append(new[both].astype(np.int64) * count + old[both])
    met = np.bincount(np.concatenate(codes)) if codes else np.zeros(0, np.int64)
    ranked = np.flatnonzero(met)
    found: dict[int, int] = {}
    for code in ranked[np.argsort(-met[ranked], kind="stable")].tolist():
        found.setdefault(code // count, int(before.colours[code % count]))
    return found


def assign_colours(rooms: int, pairs: Array, old: Mapping[int, int]) -> Array:
    """Assign (rooms,) int64 numbers in `PALETTE`: neighbours differ, and rooms keep their colours where that allows it.

    Args:
        rooms: how many there are.
        pairs: (k, 2) of rooms that are neighbours.
        old: room -> its colour before, in the order in which they may keep it.
    """
    if not old:
        return assign_colour_numbers(rooms, pairs)
    around: list[set[int]] = [set() for _ in range(rooms)]
    for a, b in pairs.tolist():
        around[a].add(b)
        around[b].add(a)
    colours = np.full(rooms, -1)
    for room in [*old, *(r for r in range(rooms) if r not in old)]:
        taken = {int(colours[other]) for other in around[room]}
        free = [c for c in (old.get(room, -1), *range(len(PALETTE))) if c >= 0 and c not in taken]
        colours[room] = free[0] if free else 0
    return colours


def _describe_rooms(map: TopometricMap, colours: Array) -> list[dict[str, Any]]:
    """Describe each room, without its outline."""
    names = find_room_names(map.landmarks, len(map.rooms))
    texts = {kind: _find_room_words(map, kind) for kind in ("use", "area") if kind in LANDMARK_KINDS}
    described = []
    for i, room in enumerate(map.rooms):
        about = {"i": i, "colour": format_hex_colour(colours[i]), "area": round(float(room["area"]), 2), "name": names[i]}
        about |= {"height": round(float(room["height"]), 2), "looked": bool(room["glimpsed"])}
        about |= {"outside": bool(room["outside"] >= 0.5), "sure": round(float(room["confidence"]), 2)}
        described.append({**about, "kind": texts.get("use", {}).get(i, ""), "group": texts.get("area", {}).get(i, "")})
    return described


def _find_room_words(map: TopometricMap, kind: str) -> dict[int, str]:
    """Map each room to the value of its landmark of a kind, of several the last."""
    table = map.landmarks.table[map.landmarks.is_kind(kind)]
    return {int(row["room"]): map.landmarks.values[row["value"]] for row in table if row["room"] >= 0}


def _list_parts(map: TopometricMap, sheet: Sheet, storey: int) -> dict[str, Any]:
    """List the doors, stairs, windows, narrowings and landmarks of a storey."""
    of_storey = map.rooms["storey"] == storey if len(map.rooms) else np.zeros(0, bool)
    edges = np.flatnonzero(of_storey[map.edges["rooms"]].any(axis=1)).tolist() if len(map.edges) else []
    windows = map.windows[of_storey[map.windows["rooms"][:, 0]]] if len(map.windows) else map.windows
    narrows = [n for n in map.narrows if of_storey[map.areas["room"][n["rooms"][0]]]]
    return {
        "floor": round(float(map.storeys["floor"][storey]), 3) if len(map.storeys) else 0.0,
        "doors": [_describe_door(map, sheet, k) for k in edges if map.edges["kind"][k] in PASSED],
        "stairs": [_describe_stairs(map, sheet, k, storey) for k in edges if map.edges["kind"][k] not in PASSED],
        "windows": [_describe_window(sheet, window) for window in windows],
        "narrows": [_locate_jambs(sheet, n) for n in narrows],
        "landmarks": _describe_landmarks(map, sheet, storey),
    }


def _locate_jambs(sheet: Sheet, edge: Any) -> list[int]:
    out: list[int] = sheet.convert_to_cm(compute_jambs(edge)).ravel().tolist()
    return out


def _round_place(place: Array) -> list[float]:
    return [round(float(v), 3) for v in place]


def _describe_door(map: TopometricMap, sheet: Sheet, k: int) -> dict[str, Any]:
    edge = map.edges[k]
    about = {"i": k, "rooms": edge["rooms"].tolist(), "kind": str(edge["kind"]), "state": classify_door_state(edge)}
    sizes = {"width": round(float(edge["width"]), 2), "sure": round(float(edge["confidence"]), 2)}
    return {**about, **sizes, "at": _round_place(edge["centre"]), "line": _locate_jambs(sheet, edge)}


def _describe_stairs(map: TopometricMap, sheet: Sheet, k: int, storey: int) -> dict[str, Any]:
    edge = map.edges[k]
    a, b = edge["rooms"].tolist()
    other = b if map.rooms["storey"][a] == storey else a
    level = int(map.rooms["storey"][other])
    way = "up" if level > storey else "down" if level < storey else ""
    line = sheet.convert_to_cm(np.stack([edge["lower"], edge["upper"]])).ravel().tolist()
    return {"i": k, "kind": str(edge["kind"]), "line": line, "to": other, "way": way, "width": round(float(edge["width"]), 2)}


def _describe_window(sheet: Sheet, window: Any) -> dict[str, Any]:
    heights = {name: round(float(window[name]), 2) if np.isfinite(window[name]) else None for name in ("sill", "head")}
    about = {"rooms": window["rooms"].tolist(), "width": round(float(window["width"]), 2), **heights}
    return {**about, "at": _round_place(window["centre"]), "line": _locate_jambs(sheet, window)}


def _describe_landmarks(map: TopometricMap, sheet: Sheet, storey: int) -> list[dict[str, Any]]:
    table = map.landmarks.table
    placed = map.landmarks.is_kind(*DRAWN_KINDS) & np.isfinite(table["position"]).all(axis=1) & (table["storey"] == storey)
    rows = np.flatnonzero(placed)
    rows = np.sort(rows[np.argsort(-table["confidence"][rows], kind="stable")[:MOST_LANDMARKS]])
    return [
        {
            "kind": LANDMARK_KINDS[row["kind"]],
            "value": map.landmarks.values[row["value"]],
            "at": _round_place(row["position"]),
            "x": x,
            "y": y,
        }
        for row, (x, y) in zip(table[rows], sheet.convert_to_cm(table["position"][rows]).tolist(), strict=True)
    ]


def lift_places(map: TopometricMap, places: Array, storey: int) -> Array:
    """Lift places (n, 2) m of a plan onto the floor of a storey: (n, 3) m."""
    room = map.navigable_room
    rows = np.flatnonzero((room >= 0) & (map.rooms["storey"][room] == storey)) if len(map.rooms) else np.zeros(0, np.int64)
    if not len(rows):
        rows = np.arange(len(map.navigable))
    if not len(rows):
        return np.column_stack([places, np.full(len(places), map.grid.origin[2])])
    centres = map.navigable.compute_centroids(map.navigable.cells[rows])
    nearest = [int(np.argmin(((centres[:, :2] - place) ** 2).sum(axis=1))) for place in places]
    return np.column_stack([places, centres[nearest, 2]])
