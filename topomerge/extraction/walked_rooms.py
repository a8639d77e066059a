"""Rooms that are one: somebody walked from the one into the other where neither plan nor walls show a door (beyond the thesis:
docs/adr/0018).

Rows of shelves part the floor of a room as walls do. The plan network says of such a narrowing that it is likelier to part two
rooms than not, but is less sure than of doors; walls show no door. Somebody who went round a shelf would prove a door where there
is none.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from topomerge.extraction.floor import Floor
from topomerge.extraction.plans.partition import Pair, pair_of
from topomerge.extraction.topology import rooms_with_floor
from topomerge.extraction.walked_doors import ONLY_WALKED_CHANCE
from topomerge.types import Array, TopometricMap

NO_DOOR_SHOWN = 0.25  # probability below which the likeliest door that plans and walls show together is none
LARGEST_PART = 12.0  # m2 of the smaller one: shelves cut off a part of a room, what is larger is probably a room
SURE_CUT = 0.85  # probability that two rooms part where a plan narrows: true doors are surer


def walked_rooms(map: TopometricMap, floor: Floor, likeliest: Mapping[Pair, float]) -> Array | None:
    """(R,) which room of the floor each of its rooms is part of, as `small_rooms.gathered` takes it; None: all are rooms.

    Args:
        map: of the floor, with the doors that the sensor was carried through.
        likeliest: how likely the likeliest door of two rooms of the map is, of those that plans and walls show.
    """
    only_walked = map.edges[(map.edges["kind"] == "door") & (map.edges["confidence"] == ONLY_WALKED_CHANCE)]
    number = rooms_with_floor(floor)
    group = np.arange(int(number.max(initial=-1)) + 1)
    for a, b in only_walked["rooms"].tolist():
        cut = floor.door_probability.get(pair_of(int(number[a]), int(number[b])), 1.0)
        part = float(map.rooms["area"][[a, b]].min())
        if likeliest.get(pair_of(a, b), 0.0) < NO_DOOR_SHOWN and cut < SURE_CUT and part < LARGEST_PART:
            first, second = sorted(group[number[[a, b]]].tolist())
            group[group == second] = first
    return None if (group == np.arange(len(group))).all() else group
