"""What the page draws of a map: plans of its storeys as outlines, doors and labels, on a paper in cm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from topomerge.io.rooms_ply import PALETTE, WALL_BETWEEN, assign_colour_numbers
from topomerge.structure.floors import compute_jambs
from topomerge.types import LANDMARK_KINDS, Array, TopometricMap, classify_door_state, find_room_names
from topomerge.viz.plan import StoreyPlan, find_label_places, format_hex_colour, rasterize_storeys
from topomerge.viz.svg import Sheet, lay_out, trace_observed_floor, trace_rooms, trace_walls

DRAWN_KINDS = ("text", "tag", "object", "name")  # of landmarks: radio and the like are many, use and area belong to rooms
MOST_LANDMARKS = 2000  # of a storey, the surest
PASSED = ("door", "opening")  # kinds of edges that stand in walls


@dataclass(frozen=True, eq=False)
class DrawnPlan:
    """How a map was drawn, so that what it becomes is drawn in the same place and in the same colours.

    Args:
        sheet: the paper.
        rooms: (nx, ny) int32 room of each pixel, -1 none, of each storey.
        colours: (R,) int64 numbers in `PALETTE`.
    """

    sheet: Sheet
    rooms: tuple[Array, ...]
    colours: Array


def build_plan_data(map: TopometricMap, before: DrawnPlan | None = None) -> tuple[dict[str, Any], DrawnPlan]:
    """Build the plans of all storeys, as plain values.

    Args:
        map: any map.
        before: how it was drawn before it was corrected; None: on new paper.

    Returns:
        `back` (a, b, c, d, e, f: paper to m, as `Sheet.back`), `size` (cm), `turn` (rad), `low` and `high` (m), `rooms` (their
        number), `storeys`, lowest first, each with `floor` (m), `rooms`, `walls`, `seen`, `doors`, `stairs`, `windows`,
        `narrows`, `landmarks`; and how it is drawn.
    """
    if before is None:
        sheet, plans = lay_out(map)
    else:
        sheet, plans = before.sheet, rasterize_storeys(map, before.sheet.frame)
    rasters = tuple(plan.room for plan in plans)
    colours = assign_colours(len(map.rooms), _find_neighbours(map, rasters, sheet.frame.size), _find_old_colours(rasters, before))
    rooms = _describe_rooms(map, PALETTE[colours].reshape(-1, 3))
    low, high = map.grid.bounds if len(map.grid) else (np.zeros(3), np.zeros(3))
    listing = {
        "back": [round(v, 9) for v in sheet.back],
        "size": list(sheet.size),
        "turn": sheet.turn,
        "low": _round_place(low),
        "high": _round_place(high),
        "rooms": len(map.rooms),
        "storeys": [_build_storey(map, sheet, plan, s, rooms) for s, plan in enumerate(plans)],
    }
    return listing, DrawnPlan(sheet, rasters, colours)


def _find_neighbours(map: TopometricMap, rasters: Sequence[Array], size: float) -> Array:
    """(k, 2) int64 pairs of rooms, ascending, that a door or a wall's thickness parts; told by the plans, in a tenth of the time
    that all cells of the floors would take."""
    pairs = [map.edges["rooms"].astype(np.int64)]
    for room in rasters:
        for step in range(1, round(WALL_BETWEEN / size) + 2):
            for one, other in ((room[:-step], room[step:]), (room[:, :-step], room[:, step:])):
                met = (one != other) & (one >= 0) & (other >= 0)
                pairs.append(np.unique(np.stack([one[met], other[met]], axis=1), axis=0))
    unique: Array = np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)
    return unique


def _find_old_colours(rasters: Sequence[Array], before: DrawnPlan | None) -> dict[int, int]:
    """Room -> the colour that most of its floor had, those with the most floor first."""
    if before is None:
        return {}
    met = [np.stack([new, old])[:, (new >= 0) & (old >= 0)] for new, old in zip(rasters, before.rooms, strict=True)]
    both, count = np.unique(np.concatenate(met, axis=1), axis=1, return_counts=True)
    found: dict[int, int] = {}
    for k in np.argsort(-count, kind="stable").tolist():
        found.setdefault(int(both[0, k]), int(before.colours[both[1, k]]))
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
    """What is known of each room, without its outline."""
    names = find_room_names(map.landmarks, len(map.rooms))
    words = {kind: _find_room_words(map, kind) for kind in ("use", "area") if kind in LANDMARK_KINDS}
    described = []
    for i, room in enumerate(map.rooms):
        about = {"i": i, "colour": format_hex_colour(colours[i]), "area": round(float(room["area"]), 2), "name": names[i]}
        about |= {"height": round(float(room["height"]), 2), "looked": bool(room["glimpsed"])}
        about |= {"outside": bool(room["outside"] >= 0.5), "sure": round(float(room["confidence"]), 2)}
        described.append({**about, "kind": words.get("use", {}).get(i, ""), "group": words.get("area", {}).get(i, "")})
    return described


def _find_room_words(map: TopometricMap, kind: str) -> dict[int, str]:
    """Room -> the value of its landmark of a kind, of several the last."""
    table = map.landmarks.table[map.landmarks.is_kind(kind)]
    return {int(row["room"]): map.landmarks.values[row["value"]] for row in table if row["room"] >= 0}


def _build_storey(map: TopometricMap, sheet: Sheet, plan: StoreyPlan, storey: int, about: list[dict[str, Any]]) -> dict[str, Any]:
    outlines, places = trace_rooms(plan, sheet), find_label_places(plan, sheet.frame)
    rooms = []
    for i, d in outlines.items():
        if i in places:
            x, y = sheet.locate((places[i].x, places[i].y))
            rooms.append({**about[i], "d": d, "x": x, "y": y, "clear": round(100 * places[i].clear)})
    of_storey = map.rooms["storey"] == storey if len(map.rooms) else np.zeros(0, bool)
    edges = [k for k in range(len(map.edges)) if of_storey[map.edges["rooms"][k]].any()]
    windows = map.windows[of_storey[map.windows["rooms"][:, 0]]] if len(map.windows) else map.windows
    narrows = [n for n in map.narrows if of_storey[map.areas["room"][n["rooms"][0]]]]
    return {
        "floor": round(float(map.storeys["floor"][storey]), 3) if len(map.storeys) else 0.0,
        "rooms": rooms,
        "walls": trace_walls(plan, sheet),
        "seen": trace_observed_floor(plan, sheet),
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
