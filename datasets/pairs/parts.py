"""Which rooms partial maps visit, and which true room an extracted room is."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations

import numpy as np
import shapely
from scipy.optimize import linear_sum_assignment
from topomerge.datasets.core.building import Building

from topomerge.errors import InputError
from topomerge.types import Array, PointCloud, TopometricMap

PARTS_TRIED = 40
LEAST_ROOMS_A_PART = 3  # rooms a part
SAME_PLAN, SAME_CORRIDOR = 0.8, 0.3  # IoU of two rooms of the same plan, and of two that connect the others
CONNECTING = ("corridor", "hall", "lobby", "stairs")
CLOSE = 0.1  # an overlap may miss what was asked for by so much, or by half a room
Neighbours = dict[int, set[int]]


def build_room_graph(building: Building, among: Iterable[int] | None = None) -> Neighbours:
    """Map each room to the rooms that a door, an opening or stairs lead to; lifts, and rooms that are not `among` the given, left
    out."""
    fits = set(range(len(building.rooms)) if among is None else map(int, among))
    fits -= {i for i, room in enumerate(building.rooms) if room.kind == "lift"}
    neighbours: Neighbours = {i: set() for i in sorted(fits)}
    for a, b in building.list_edges().tolist():
        if a in fits and b in fits and a != b:
            neighbours[a].add(b)
            neighbours[b].add(a)
    return neighbours


def sample_two_parts(
    building: Building,
    rooms: int,
    overlap: float,
    rng: np.random.Generator,
    among: Iterable[int] | None = None,
    over_stairs: bool = False,
) -> tuple[Array, Array]:
    """Sample two connected parts of up to `rooms` rooms, ascending (n,) int64, with a share of rooms in common (see `share`).

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
    neighbours = build_room_graph(building, among)
    count = min(rooms, int(len(neighbours) / (2 - overlap)))
    flights = building.stairs["rooms"][building.stairs["kind"] != "lift"]
    flights = [f for f in flights.tolist() if f[1] in neighbours.get(f[0], ())] if over_stairs else []
    best, least = None, np.inf
    for _ in range(PARTS_TRIED if count >= LEAST_ROOMS_A_PART else 0):
        ends = rng.permutation(flights[int(rng.integers(len(flights)))]).tolist() if flights else []
        a, b = _grow(neighbours, count, round(overlap * count), ends, rng)
        miss = abs(compute_dice(a, b) - overlap) + 0.02 * (2 * count - len(a) - len(b))
        if min(len(a), len(b)) >= LEAST_ROOMS_A_PART and miss < least:
            best, least = (a, b), miss
    if best is None or abs(compute_dice(*best) - overlap) > max(CLOSE, 0.5 / len(best[0])):
        raise InputError(
            f"{building.name} has no two connected parts of {LEAST_ROOMS_A_PART} rooms or more with {100 * overlap:.0f} % of "
            "them in common; take another overlap, another seed or more storeys"
        )
    return np.array(sorted(best[0]), np.int64), np.array(sorted(best[1]), np.int64)


def compute_dice(a: Iterable[int], b: Iterable[int]) -> float:
    """Return rooms in common, of the mean number of rooms (Dice)."""
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
        while len(a) < common and _add_neighbour(a, set(), neighbours, rng):
            pass
        b = set(a)
        a |= set(ends)
    else:
        a, b = {first}, {second}
    grown = True
    while grown:
        grown = len(a) < count and _add_neighbour(a, b, neighbours, rng)
        grown = (len(b) < count and _add_neighbour(b, a, neighbours, rng)) or grown
    return a, b


def _add_neighbour(part: set[int], other: set[int], neighbours: Neighbours, rng: np.random.Generator) -> bool:
    """Add one room beside the part that the other doesn't have; False: there is none."""
    edge = sorted({n for r in part for n in neighbours[r]} - part - other)
    if edge:
        part.add(edge[int(rng.integers(len(edge)))])
    return bool(edge)


def find_twin_rooms(building: Building) -> dict[int, int]:
    """Map rooms of one storey to the rooms over them with the same plan (IoU above `SAME_PLAN`): of the two storeys that share
    most.

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
        room_over_room = _match_rooms_above(
            building, shapes, np.flatnonzero(fits & (storey == low)), np.flatnonzero(fits & (storey == high))
        )
        best = max(best, room_over_room, key=len)
    if len(best) < LEAST_ROOMS_A_PART:
        raise InputError(f"{building.name}: no two of its storeys have the same plan")
    return best


def _match_rooms_above(building: Building, shapes: Array, low: Array, high: Array) -> dict[int, int]:
    """Map rooms to the rooms over them that are alike, best pairs first, each room once."""
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


TRUTH_DTYPE = np.dtype(
    [
        ("room", "i4"),  # true room with the largest IoU, -1: none
        ("iou", "f4"),
        ("one", "?"),  # the two are each other's in the best one-to-one assignment
    ]
)
LEAST_IOU = 0.1  # below, an extracted room is no true room
WALL_BESIDE = 0.15  # m: points of a wall lie outside of the room's outline
SLICE_SHARE = 0.5  # of the height of the map: points that span less are a slice, which was made into walls and a floor


def match_true_rooms(map: TopometricMap, cloud: PointCloud) -> Array:
    """Return (R,) TRUTH_DTYPE of each extracted room.

    The IoU counts occupied cells: those of the extracted room, and those in which most labelled points are of the true room. The
    one-to-one assignment has the largest sum of IoU; the others get the true room that they overlap most, several of them perhaps
    the same one, as when a corridor is extracted in pieces.

    Args:
        map: extracted from the cloud, in its frame.
        cloud: with `labels`, or with `rooms` whose outlines give the labels.
    """
    iou = _compute_iou(map, label_cells(map, cloud), len(cloud.rooms))
    out = np.zeros(len(map.rooms), TRUTH_DTYPE)
    out["room"] = -1
    if iou.size:
        best = iou.argmax(axis=1)
        value = iou[np.arange(len(iou)), best]
        i, j = linear_sum_assignment(iou, maximize=True)
        paired = iou[i, j] >= LEAST_IOU
        i, j = i[paired], j[paired]
        best[i], value[i], out["one"][i] = j, iou[i, j], True
        out["room"], out["iou"] = np.where(value >= LEAST_IOU, best, -1), value
    return out


def label_cells(map: TopometricMap, cloud: PointCloud) -> Array:
    """Return (n,) int32 true room of each occupied cell: that of most of its labelled points; -1: none.

    The points of a slice lie in, or below, the walls that the extraction made of it: they label the whole column.
    Its assumed floor has no points and gets its labels from the rooms' outlines.
    """
    if cloud.labels is None:
        return _label_by_outline(map, cloud)
    labelled = np.flatnonzero(cloud.labels >= 0)
    label = cloud.labels[labelled].astype(np.int64)
    places = map.grid.locate(cloud.points[labelled].astype(np.float64) + cloud.shift)
    if not len(labelled) or _measure_height(places) >= SLICE_SHARE * _measure_height(map.grid.cells):
        return _find_most_common(map.grid.find_rows(places), label, len(map.grid), len(cloud.rooms))
    columns, column = np.unique(map.grid.cells[:, :2], axis=0, return_inverse=True)
    number = np.full(map.grid.shape[:2], -1)
    number[tuple(columns.T)] = np.arange(len(columns))
    inside = ((places[:, :2] >= 0) & (places[:, :2] < map.grid.shape[:2])).all(axis=1)
    walls = _find_most_common(number[tuple(places[inside, :2].T)], label[inside], len(columns), len(cloud.rooms))[column.ravel()]
    return np.where(walls >= 0, walls, _label_by_outline(map, cloud))


def _measure_height(cells: Array) -> float:
    """Count the levels between the lowest and the highest cells, but for one in a hundred."""
    low, high = np.percentile(np.unique(cells, axis=0)[:, 2], [1, 99])
    return float(high - low)


def _find_most_common(row: Array, label: Array, count: int, rooms: int) -> Array:
    """Return (count,) int32 label that is commonest in each row; -1: none. Rows below 0 are left out."""
    out = np.full(count, -1, np.int32)
    pair, votes = np.unique(row[row >= 0] * max(rooms, 1) + label[row >= 0], return_counts=True)
    order = np.argsort(votes, kind="stable")  # the last one written has most votes
    cell, room = np.divmod(pair[order], max(rooms, 1))
    out[cell] = room
    return out


def _label_by_outline(map: TopometricMap, cloud: PointCloud) -> Array:
    places = map.grid.compute_centroids()
    out = np.full(len(places), -1, np.int32)
    for i, room in enumerate(cloud.rooms):
        level = (places[:, 2] > room.floor - 2 * WALL_BESIDE) & (places[:, 2] < room.ceiling + 2 * WALL_BESIDE)
        shape = shapely.Polygon(room.polygon).buffer(WALL_BESIDE, join_style="mitre")
        rows = np.flatnonzero(level & (out < 0))
        out[rows[shapely.contains_xy(shape, places[rows, :2])]] = i
    return out


def _compute_iou(map: TopometricMap, label: Array, count: int) -> Array:
    """Return (R, count) IoU of cells."""
    rooms = len(map.rooms)
    inside = (map.room >= 0) & (label >= 0)
    both = np.zeros((rooms, count))
    np.add.at(both, (map.room[inside], label[inside]), 1)
    extracted = np.bincount(map.room[map.room >= 0], minlength=rooms)[:, None]
    true = np.bincount(label[(label >= 0) & (map.room >= 0)], minlength=count)[None]
    return both / np.maximum(extracted + true - both, 1)


def find_true_matches(a: Array, b: Array, shared: Iterable[tuple[int, int]]) -> Array:
    """Find (M, 2) int64 extracted rooms (i of a, j of b), ascending, that are the same true room.

    Args:
        a, b: TRUTH_DTYPE of the two maps.
        shared: true rooms (of a, of b) that are one room.
    """
    pairs = [(int(i), int(j)) for s, t in shared for i in np.flatnonzero(a["room"] == s) for j in np.flatnonzero(b["room"] == t)]
    return np.array(sorted(set(pairs)), np.int64).reshape(-1, 2)
