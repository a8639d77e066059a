"""Which segments of a storey are one room: merged, best first, until only doors part them (beyond the thesis)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from topomerge.extraction.plans.passages import Pair, pair_of
from topomerge.extraction.plans.storey_plan import ClassifiedStorey, StoreyPlan
from topomerge.extraction.segment import GrowingRooms, Scorer, SegmentedStorey
from topomerge.types import Array

ROOM_LEAST_AREA = 0.8, 0.3  # m2 of floor that was seen; the second where doors surely part it
ROOM_LEAST_HALF_WIDTH = 0.2  # m: what is nowhere wider is the edge of a facade or of a slab
FLAT_LEAST_AREA, FLAT_LEAST_HALF_WIDTH = (0.8, 0.8), 0.35  # in slices, where legs look like walls
SURE_PARTED = 0.8  # probability of a door from which on what is small, but not tiny, stays a room: toilets and stores


@dataclass(frozen=True, eq=False)
class PartitionedStorey:
    """A storey cut into rooms and areas, both numbered from 0 in the storey; an area is a segment.

    Args:
        number: of the storey.
        plan: the storey seen from above, without furniture.
        classes: what probably stands in its columns.
        room, area: (nx, ny) of each column, -1 none.
        room_of_area: (A,).
        room_of_segment: (n,) -1 none.
        door_probability: that a door parts two neighbouring rooms.
    """

    number: int
    plan: StoreyPlan
    classes: ClassifiedStorey
    room: Array
    area: Array
    room_of_area: Array
    room_of_segment: Array
    door_probability: dict[Pair, float]


def partition_rooms(
    storey: SegmentedStorey,
    score: Scorer,
    door: float,
    least_area: tuple[float, float] = ROOM_LEAST_AREA,
    half_width: float = ROOM_LEAST_HALF_WIDTH,
) -> PartitionedStorey:
    """Merge the segments of a storey, the least likely door first, until only likely doors part them: this cuts the rooms, once.

    Args:
        score: tells doors from narrowings of a room, by all evidence.
        door: probability from which on two rooms stay apart.
        least_area: m2, smaller rooms are given to the neighbour from which the least likely door parts them, and those above the
            second only where that door is less likely than `SURE_PARTED`.
        half_width: m, rooms that are nowhere farther from a wall are none.
    """
    segment, edge = storey.segment, storey.plan.edge
    rooms = GrowingRooms(segment, storey.clearance, storey.passages, edge, score)
    while rooms.door_probability and rooms.door_probability[pair := rooms.weakest()] <= door:
        rooms.merge(pair)
    small = {int(r) for r in np.unique(rooms.of_region) if rooms.area[r] < least_area[0]}
    while small:
        near = [(p, min(rooms.area[r] for r in p)) for p in rooms.door_probability if p[0] in small or p[1] in small]
        near = [(p, size) for p, size in near if size < least_area[1] or rooms.door_probability[p] < SURE_PARTED]
        if not near:
            break
        pair = min((p for p, _ in near), key=lambda p: (rooms.door_probability[p], p))
        rooms.merge(pair)
        small = {r for r in small - {pair[1]} if rooms.area[r] < least_area[0]}
    large = np.unique(rooms.of_region)
    large = large[(rooms.area[large] >= least_area[1]) & (rooms.peak[large] >= half_width)]
    number = np.full(len(rooms.of_region) + 1, -1)
    number[large] = np.arange(len(large))
    room_of_segment = number[rooms.of_region]
    kept = np.flatnonzero(room_of_segment >= 0)
    area_of_segment = np.full(len(room_of_segment) + 1, -1)
    area_of_segment[kept] = np.arange(len(kept))
    doors = {}
    for (a, b), probability in rooms.door_probability.items():
        if number[a] >= 0 and number[b] >= 0:
            doors[pair_of(int(number[a]), int(number[b]))] = probability
    return PartitionedStorey(
        storey.number,
        storey.plan,
        storey.classes,
        np.append(room_of_segment, -1)[segment],
        area_of_segment[segment],
        room_of_segment[kept],
        room_of_segment,
        doors,
    )


def rooms_of_segments(storeys: Sequence[PartitionedStorey], numbers: Array) -> Array:
    """(n,) room of the map of each segment of all storeys, -1 none.

    Args:
        numbers: (R,) of the rooms that have a floor, as they are numbered on from storey to storey (`topology.rooms_with_floor`).
    """
    of, first = [], 0
    for storey in storeys:
        of.append(np.where(storey.room_of_segment >= 0, storey.room_of_segment + first, -1))
        first += int(storey.room.max(initial=-1)) + 1
    number = np.full(first + 1, -1)
    number[numbers] = np.arange(len(numbers))
    out: Array = number[np.concatenate([np.zeros(0, np.int64), *of])]
    return out
