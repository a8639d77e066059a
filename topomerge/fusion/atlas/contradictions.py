"""Where two maps contradict each other under a pose: places at which walls of the one stand on free floor of the other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from topomerge.kernels import align
from topomerge.matching.plan_fields import FREE_MARGIN, PlanFields
from topomerge.matching.refinement import storeys_at
from topomerge.types import Array, Sim3, TopometricMap

PLACE_REACH = 3.0  # m: what contradicts within this of one spot is one place, about as wide as a room
LEAST_CONFLICT = 0.3  # m2 of walls on free floor of one place, below which it may be noise
SPOT = 0.5  # m, side of the squares by which the densest spot is found
ROOM_SHARE = 0.1  # of the walls of a place that stand in a room, below which the room is not named


@dataclass(frozen=True)
class Conflict:
    """A place at which two maps contradict each other.

    Args:
        middle: m, on the floor, in the frame of the first map.
        area: m2 of walls that stand on free floor of the other map.
    """

    middle: tuple[float, float, float]
    area: float

    def moved(self, pose: Sim3) -> Conflict:
        """The same place in another frame."""
        x, y, z = pose.apply(np.array([self.middle]))[0].tolist()
        return replace(self, middle=(x, y, z))


@dataclass(frozen=True)
class Contradiction:
    """A place at which two maps that were joined contradict each other; both versions are kept.

    Args:
        maps: i and j.
        rooms: of map i and of map j, by their numbers, in which it lies.
        middle: m, in the frame of the component.
        area: m2 of walls that stand on free floor of the other map.
    """

    maps: tuple[int, int]
    rooms: tuple[tuple[int, ...], tuple[int, ...]]
    middle: tuple[float, float, float]
    area: float


def conflict_columns(a: Sequence[PlanFields], b: Sequence[PlanFields], pose: Sim3) -> Array:
    """(n, 4) place in a's frame and area (half of it, as both maps are asked) of the walls on free floor under T_ab, m and m2."""
    rows = [np.zeros((0, 4))]
    for v, w in storeys_at(a, b, pose.translation[2], pose.scale):
        sides = ((w, v, pose, pose.scale**2), (v, w, pose.inverse(), 1.0))
        for n, (source, target, move, grown) in enumerate(sides):
            walls = source.walls
            moved = move.apply(np.column_stack([walls, np.zeros(len(walls))]))[:, :2]
            cells = np.floor((moved - target.plan.origin) / target.plan.edge).astype(np.int64)
            inside = np.asarray(((cells >= 0) & (cells < target.plan.wall.shape)).all(axis=1))
            x, y = np.where(inside[:, None], cells, 0).T
            clash = inside & (target.kind[x, y] == align.FREE_STATE) & (target.to_any[x, y] >= FREE_MARGIN)
            at = (moved if n == 0 else walls)[clash]
            half = np.full(len(at), source.plan.edge**2 * grown / 2)
            rows.append(np.column_stack([at, np.full(len(at), v.plan.floor_guess), half]))
    return np.concatenate(rows)


def find_conflicts(a: Sequence[PlanFields], b: Sequence[PlanFields], pose: Sim3) -> tuple[Conflict, ...]:
    """Places at which maps a and b contradict each other under T_ab, the largest first."""
    columns = conflict_columns(a, b, pose)
    found = []
    while columns[:, 3].sum() >= LEAST_CONFLICT:
        spots, owner = np.unique(np.floor(columns[:, :2] / SPOT), axis=0, return_inverse=True)
        area = np.bincount(owner.reshape(-1), weights=columns[:, 3])
        middles = (spots + 0.5) * SPOT
        near = np.linalg.norm(middles[:, None] - middles, axis=2) <= PLACE_REACH
        best = int((near @ area).argmax())
        taken = near[best][owner.reshape(-1)]
        weight = columns[taken, 3]
        if weight.sum() < LEAST_CONFLICT:
            break
        x, y, z = (columns[taken, :3] * weight[:, None]).sum(axis=0) / weight.sum()
        found.append(Conflict((float(x), float(y), float(z)), float(weight.sum())))
        columns = columns[~taken]
    return tuple(found)


def sum_places(costs: Iterable[tuple[Array, float]]) -> float:
    """The sum of the costs of places (3,), each place once: of those that several pairs show, the highest.

    Args:
        costs: middle of a place, m, in one frame for all, and its cost.
    """
    distinct: list[tuple[Array, float]] = []
    for middle, cost in sorted(costs, key=lambda entry: -entry[1]):
        if all(np.linalg.norm(middle - other) > PLACE_REACH for other, _ in distinct):
            distinct.append((middle, cost))
    return sum(cost for _, cost in distinct)


def locate_contradiction(
    pair: tuple[int, int], conflict: Conflict, maps: tuple[TopometricMap, TopometricMap], pose: Sim3, columns: Array, frame: Sim3
) -> Contradiction:
    """A conflict of two joined maps with the rooms in which it lies.

    Args:
        maps: i and j.
        pose: T_ij.
        columns: of `conflict_columns`.
        frame: of map i in its component.
    """
    near = columns[np.linalg.norm(columns[:, :2] - conflict.middle[:2], axis=1) <= PLACE_REACH, :3]
    rooms = rooms_near(maps[0], near), rooms_near(maps[1], pose.inverse().apply(near))
    return Contradiction(pair, rooms, conflict.moved(frame).middle, conflict.area)


def rooms_near(map: TopometricMap, at: Array) -> tuple[int, ...]:
    """Rooms on whose floor places (n, 3), m, lie, or the nearest floor; those that hold a tenth of the places at least."""
    if not len(at) or not len(map.navigable):
        return ()
    distance, nearest = cKDTree(map.navigable.centroids()).query(at, distance_upper_bound=PLACE_REACH)
    rooms = map.navigable_room[nearest[np.isfinite(distance)]]
    counts = np.bincount(rooms[rooms >= 0], minlength=1)
    return tuple(int(room) for room in np.flatnonzero(counts >= max(ROOM_SHARE * len(at), 1)))


def contradiction_to_json(c: Contradiction) -> dict[str, Any]:
    """A contradiction as plain values: numbers of both maps, rooms of each, its middle, m, and the area of the walls, m2."""
    return {"maps": c.maps, "rooms": c.rooms, "at": [round(v, 2) for v in c.middle], "m2": round(c.area, 2)}
