"""Small rooms of slices and grid maps that no door parts from their neighbour: parts of that one (beyond the thesis:
docs/adr/0018).

Legs of furniture and sights past it cut slices into more rooms than there are. The plans were cut by what a narrowing looks
like; what the plan network sees there is weighed later, with the doors, and says of many that they are none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from topomerge.extraction.elevations.wall_doors import flat_door_chance
from topomerge.extraction.floor import Floor
from topomerge.extraction.plans.partition import Pair, pair_of
from topomerge.extraction.topology import rooms_with_floor
from topomerge.types import Array, TopometricMap

SMALL_AREA = 6.0  # m2: larger rooms stay what they are
NO_DOOR = 0.3  # probability of a door below which the likeliest passage of two rooms is none
LIKELY_DOOR = 0.5  # two rooms that such a door parts stay two


def without_small_rooms(floor: Floor, map: TopometricMap) -> Floor:
    """The floor of a slice or a grid map, in which small rooms are parts of the neighbours that no door parts them from; itself
    where there are none.

    Args:
        map: of the floor.
    """
    level = map.edges[np.isin(map.edges["kind"], ("door", "opening"))]
    number = rooms_with_floor(floor)
    chance: dict[Pair, float] = {}
    for edge, likely in zip(level, flat_door_chance(map, floor.classified_storeys, level).tolist(), strict=True):
        pair = pair_of(*number[edge["rooms"]].tolist())
        chance[pair] = max(chance.get(pair, 0.0), likely)
    area = dict(zip(number.tolist(), map.rooms["area"].tolist(), strict=True))
    group = np.arange(int(number.max(initial=-1)) + 1)
    for likely, (a, b) in sorted((likely, pair) for pair, likely in chance.items()):
        if likely < NO_DOOR and min(area[a], area[b]) < SMALL_AREA and not _parted(chance, group, a, b):
            group[group == group[b]] = group[a]
    return floor if (group == np.arange(len(group))).all() else gathered(floor, group)


def _parted(chance: Mapping[Pair, float], group: Array, a: int, b: int) -> bool:
    """Does a likely door part what two rooms have become?"""
    ends = {int(group[a]), int(group[b])}
    return any(likely >= LIKELY_DOOR and {int(group[x]), int(group[y])} == ends for (x, y), likely in chance.items())


def gathered(floor: Floor, group: Array) -> Floor:
    """The floor whose rooms are those of each group.

    Args:
        group: (R,) the room of the floor that each of them is part of.
    """
    named = [room for pair in floor.door_probability for room in pair]
    largest = max(int(rooms.max(initial=-1)) for rooms in (floor.room, floor.label, floor.room_of_area, np.array(named, int)))
    complete = floor.completeness
    count = max(largest + 1, 0 if complete is None else len(complete))
    whole = np.arange(count)
    whole[: len(group)] = group
    number = np.append(whole, -1).astype(np.int32)
    doors: dict[Pair, float] = {}
    for (a, b), likely in floor.door_probability.items():
        pair = pair_of(int(whole[a]), int(whole[b]))
        if pair[0] != pair[1]:
            doors[pair] = max(doors.get(pair, 0.0), likely)
    if complete is not None:
        size = np.bincount(floor.room[floor.room >= 0], minlength=len(complete)) + 1e-9
        of = whole[: len(complete)]
        sums = (np.bincount(of, size * complete, len(complete)), np.bincount(of, size, len(complete)))
        complete = np.where(sums[1] > 0, sums[0] / np.where(sums[1] > 0, sums[1], 1.0), complete)
    return replace(
        floor,
        room=number[floor.room],
        label=number[floor.label],
        room_of_area=number[floor.room_of_area],
        door_probability=doors,
        completeness=complete,
    )
