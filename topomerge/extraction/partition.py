"""Which segments of a storey are one room: merged, best first, until only doors part them (beyond the thesis)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from topomerge.extraction.plans.passages import Pair, pair_of
from topomerge.extraction.plans.storey_plan import ClassifiedStorey, StoreyPlan
from topomerge.extraction.segment import GrowingRooms, Scorer, SegmentedStorey
from topomerge.types import Array

SURE_PARTED = 0.8  # probability of a door from which on what is small, but not tiny, stays a room: toilets and stores
SURE_SHOWN = 2.3  # log odds, on average along a doorway that walls show: likewise (as `walls.SURE_WITHIN`)
NO_DOOR = -0.85  # log odds of a door below which there is probably none
CRACK = 0.45  # m: nobody walks through less; a room behind a crack, of a door that is ajar, stays one


@dataclass(frozen=True)
class LeastSize:
    """What is too small for a room of its own.

    Args:
        tiny: m2 of floor that was seen; smaller ones are parts of a neighbour, or of no room.
        small: m2, smaller ones are parts of a neighbour where no door surely parts them from it.
        open: m2, smaller ones likewise where there is probably no door.
        half_width: m, what is nowhere farther from a wall is none.
    """

    tiny: float
    small: float
    open: float
    half_width: float


ROOM_LEAST = LeastSize(0.3, 0.8, 0.0, 0.2)  # narrower ones are the edge of a facade or of a slab
FLAT_LEAST = LeastSize(0.8, 0.8, 6.0, 0.35)  # in slices, where legs look like walls


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


def partition_rooms(storey: SegmentedStorey, score: Scorer, door: float, least: LeastSize = ROOM_LEAST) -> PartitionedStorey:
    """Merge the segments of a storey, the least likely door first, until only likely doors part them: this cuts the rooms, once.

    Args:
        score: tells doors from narrowings of a room, by all evidence.
        door: probability from which on two rooms stay apart.
        least: what is smaller is given to a neighbour.
    """
    segment, edge = storey.segment, storey.plan.edge
    rooms = GrowingRooms(segment, storey.clearance, storey.passages, edge, score)
    while rooms.door_probability and rooms.door_probability[pair := rooms.weakest()] <= door:
        rooms.merge(pair)
    while (small := find_too_small(rooms, least)) is not None:
        rooms.merge(small)
    large = np.unique(rooms.of_region)
    large = large[(rooms.area[large] >= least.tiny) & (rooms.peak[large] >= least.half_width)]
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


def find_too_small(rooms: GrowingRooms, least: LeastSize) -> Pair | None:
    """Find the least surely parted two rooms of which one is too small; None: none is."""
    found: list[tuple[int, float, Pair]] = []
    for pair, probability in rooms.door_probability.items():
        size = min(rooms.area[pair[0]], rooms.area[pair[1]])
        shown, _, door = rooms.passages[pair].evidence or (0.0, 0.0, 0.0)
        parted = probability >= SURE_PARTED or shown >= SURE_SHOWN
        if size < least.tiny or (size < least.small and not parted):
            found.append((0, probability, pair))
        elif size < least.open and door < NO_DOOR and rooms.passages[pair].width >= CRACK:
            found.append((1, door, pair))
    return min(found)[2] if found else None


def find_rooms_of_segments(storeys: Sequence[PartitionedStorey], numbers: Array) -> Array:
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
