"""Who was in the rooms of a joined map (method 4): what the maps know that were joined, not what the joined outline looks like.

Of 884 rooms of joined validation maps the outline tells 87 % right, the parts 94 % (`docs/adr/0020`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from topomerge.extraction.distinct_doors import rooms_at
from topomerge.extraction.plans.part_rooms import PartRooms
from topomerge.types import TopometricMap

LEAST_COVER = 0.3  # of a joined room's floor, from which on a part knows who was in it


def with_part_odds(joined: TopometricMap, parts: Sequence[PartRooms]) -> TopometricMap:
    """The joined map with the probability that each room was entered, and with what was only glimpsed, as its parts say: that of
    the part in which somebody was most likely there; as the joined map has it where no part has enough of its floor."""
    if not len(joined.rooms):
        return joined
    count = len(joined.rooms)
    inside = joined.navigable_room >= 0
    area = np.bincount(joined.navigable_room[inside], minlength=count) * joined.navigable.edge**2
    entered = np.full(count, -1.0)
    for part in parts:
        room = rooms_at(joined, part.places)
        there = room >= 0
        places = np.bincount(room[there], minlength=count)
        mean = np.bincount(room[there], part.entered[part.room[there]], count) / np.maximum(places, 1)
        entered = np.where(places * part.area >= LEAST_COVER * area, np.maximum(entered, mean), entered)
    rooms = joined.rooms.copy()
    rooms["entered"] = np.where(entered >= 0, entered, rooms["entered"])
    rooms["glimpsed"] = rooms["entered"] < 0.5
    return replace(joined, rooms=rooms)
