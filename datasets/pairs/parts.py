"""Which rooms two partial maps visit: connected parts of a building with a controlled share of rooms in common."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations

import numpy as np
import shapely
from topomerge.datasets.core.building import Building

from topomerge.errors import InputError
from topomerge.types import Array

PARTS_TRIED = 40
LEAST_ROOMS_A_PART = 3  # rooms a part
SAME_PLAN, SAME_CORRIDOR = 0.8, 0.3  # IoU of two rooms of the same plan, and of two that connect the others
CONNECTING = ("corridor", "hall", "lobby", "stairs")
CLOSE = 0.1  # an overlap may miss what was asked for by so much, or by half a room

Neighbours = dict[int, set[int]]


def room_graph(building: Building, among: Iterable[int] | None = None) -> Neighbours:
    """Room -> rooms that a door, an opening or stairs lead to; lifts, and rooms that are not `among` the given, left out."""
    fits = set(range(len(building.rooms)) if among is None else map(int, among))
    fits -= {i for i, room in enumerate(building.rooms) if room.kind == "lift"}
    neighbours: Neighbours = {i: set() for i in sorted(fits)}
    for a, b in building.edges().tolist():
        if a in fits and b in fits and a != b:
            neighbours[a].add(b)
            neighbours[b].add(a)
    return neighbours


def two_parts(
    building: Building,
    rooms: int,
    overlap: float,
    rng: np.random.Generator,
    among: Iterable[int] | None = None,
    over_stairs: bool = False,
) -> tuple[Array, Array]:
    """Two connected parts of up to `rooms` rooms, ascending (n,) int64, with a share of rooms in common (see `share`).

    Args:
        overlap: 0 to 1; what comes out differs by `CLOSE` at most.
        among: only these rooms.
        over_stairs: grow them from both ends of stairs, if the building has any: a part of which all is in common, and otherwise
            the first part, goes over them; without overlap there is one part at each end.

    Raises:
        InputError: the building has no such parts.
    """
    if not 0 <= overlap <= 1 or rooms < LEAST_ROOMS_A_PART:
        raise InputError(f"overlap must be 0 to 1 and rooms {LEAST_ROOMS_A_PART} or more, not {overlap:g} and {rooms}")
    neighbours = room_graph(building, among)
    count = min(rooms, int(len(neighbours) / (2 - overlap)))
    flights = building.stairs["rooms"][building.stairs["kind"] != "lift"]
    flights = [f for f in flights.tolist() if f[1] in neighbours.get(f[0], ())] if over_stairs else []
    best, least = None, np.inf
    for _ in range(PARTS_TRIED if count >= LEAST_ROOMS_A_PART else 0):
        ends = rng.permutation(flights[int(rng.integers(len(flights)))]).tolist() if flights else []
        a, b = _grow(neighbours, count, round(overlap * count), ends, rng)
        miss = abs(share(a, b) - overlap) + 0.02 * (2 * count - len(a) - len(b))
        if min(len(a), len(b)) >= LEAST_ROOMS_A_PART and miss < least:
            best, least = (a, b), miss
    if best is None or abs(share(*best) - overlap) > max(CLOSE, 0.5 / len(best[0])):
        raise InputError(
            f"{building.name} has no two connected parts of {LEAST_ROOMS_A_PART} rooms or more with {100 * overlap:.0f} % of "
            "them in common; take another overlap, another seed or more storeys"
        )
    return np.array(sorted(best[0]), np.int64), np.array(sorted(best[1]), np.int64)


def share(a: Iterable[int], b: Iterable[int]) -> float:
    """Rooms in common, of the mean number of rooms (Dice)."""
    a, b = set(a), set(b)
    return 2 * len(a & b) / max(len(a) + len(b), 1)


def _grow(
    neighbours: Neighbours, count: int, common: int, ends: list[int], rng: np.random.Generator
) -> tuple[set[int], set[int]]:
    """Grow what both have, then each in turn where the other is not; from two rooms that are drawn, or from those given."""
    rooms = list(neighbours)
    degree = np.array([len(neighbours[r]) + 0.1 for r in rooms])
    first, second = ends or rng.choice(rooms, 2, replace=False, p=degree / degree.sum()).tolist()
    if common:
        a = {first, second} if ends and common > 1 else {first}
        while len(a) < common and _step(a, set(), neighbours, rng):
            pass
        b = set(a)
        a |= set(ends)
    else:
        a, b = {first}, {second}
    grown = True
    while grown:
        grown = len(a) < count and _step(a, b, neighbours, rng)
        grown = (len(b) < count and _step(b, a, neighbours, rng)) or grown
    return a, b


def _step(part: set[int], other: set[int], neighbours: Neighbours, rng: np.random.Generator) -> bool:
    """Add one room beside the part that the other doesn't have; False: there is none."""
    edge = sorted({n for r in part for n in neighbours[r]} - part - other)
    if edge:
        part.add(edge[int(rng.integers(len(edge)))])
    return bool(edge)


def twin_rooms(building: Building) -> dict[int, int]:
    """Rooms of one storey -> the rooms over them with the same plan (IoU above `SAME_PLAN`): of the two storeys that share most.

    Corridors, halls and stairwells need to have less in common (`SAME_CORRIDOR`): they lead from room to room, also where
    they differ.

    Raises:
        InputError: no two storeys have the same plan.
    """
    shapes = np.array([shapely.Polygon(room.polygon) for room in building.rooms])
    storey = np.array([room.storey for room in building.rooms])
    fits = np.array([room.kind not in ("lift", "void") for room in building.rooms])
    best: dict[int, int] = {}
    for low, high in combinations(range(len(building.storeys)), 2):
        room_over_room = _over(building, shapes, np.flatnonzero(fits & (storey == low)), np.flatnonzero(fits & (storey == high)))
        best = max(best, room_over_room, key=len)
    if len(best) < LEAST_ROOMS_A_PART:
        raise InputError(f"{building.name}: no two of its storeys have the same plan")
    return best


def _over(building: Building, shapes: Array, low: Array, high: Array) -> dict[int, int]:
    """Rooms -> the rooms over them that are alike, best pairs first, each room once."""
    if not len(low) or not len(high):
        return {}
    i, j = shapely.STRtree(shapes[high]).query(shapes[low], predicate="intersects")
    i, j = low[i], high[j]
    both = shapely.area(shapely.intersection(shapes[i], shapes[j]))
    iou = both / (shapely.area(shapes[i]) + shapely.area(shapes[j]) - both)
    out: dict[int, int] = {}
    for k in np.argsort(-iou, kind="stable").tolist():
        a, b = int(i[k]), int(j[k])
        joins = building.rooms[a].kind == building.rooms[b].kind and building.rooms[a].kind in CONNECTING
        if iou[k] > (SAME_CORRIDOR if joins else SAME_PLAN) and a not in out and b not in out.values():
            out[a] = b
    return dict(sorted(out.items()))
