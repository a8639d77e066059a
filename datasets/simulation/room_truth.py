"""What is true about each room of a map of a simulated scan: is it one, as a whole, was the sensor in it, is it out of doors?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from topomerge.datasets.simulation.floor_truth import TRUTH_CELL, Truth, draw_rooms, said

from topomerge.metrics import HALF, overlaps
from topomerge.types import Array, TopometricMap, TrueRoom

WHOLE_SHARE = 0.8  # of a true room's floor, from which on it was seen as a whole
LEAST_JUDGED_AREA = 0.5  # m2 of a map's room on judged floor, from which on something is true about it


@dataclass(frozen=True, eq=False)
class RoomTruth:
    """Of each room of a map, (R,) bool.

    Args:
        one: has it an IoU of a half with what was seen of a true room?
        whole: does it cover `WHOLE_SHARE` of a true room?
        entered: does most of it lie in rooms that the surveyor was in?
        outside: does most of it lie outside of all true rooms?
        judged: is enough of it on judged floor?
    """

    one: Array
    whole: Array
    entered: Array
    outside: Array
    judged: Array


def room_truth(map: TopometricMap, truth: Truth, rooms: Sequence[TrueRoom], columns: Array | None = None) -> RoomTruth:
    """What is true about the rooms of a map.

    Args:
        rooms: the true ones, in the building's frame.
        columns: `said(map, truth)` where it is at hand already.
    """
    columns = said(map, truth) if columns is None else columns
    count, trues = len(map.rooms), len(truth.visited)
    judged = columns[(columns >= 0) & (truth.raster >= -1)], truth.raster[(columns >= 0) & (truth.raster >= -1)]
    of_room = np.bincount(judged[0], minlength=count)
    visited = np.bincount(judged[0], np.append(truth.visited, False)[judged[1]], minlength=count)
    outside = np.bincount(judged[0], judged[1] < 0, minlength=count)
    place = (truth.raster >= 0) | ((truth.raster == -1) & (columns >= 0))
    iou = overlaps(truth.raster[place], columns[place], trues, count)[0].max(axis=0, initial=0.0)
    full = draw_rooms(tuple(rooms), truth.floors)[0]
    both = (columns >= 0) & (full >= 0)
    shares = np.bincount(columns[both].astype(np.int64) * trues + full[both], minlength=count * trues).reshape(count, trues)
    floors = np.maximum(np.bincount(full[full >= 0], minlength=trues), 1)
    return RoomTruth(
        one=iou >= HALF,
        whole=(shares / floors).max(axis=1, initial=0.0) >= WHOLE_SHARE,
        entered=2 * visited > of_room,
        outside=2 * outside > of_room,
        judged=of_room * TRUTH_CELL**2 >= LEAST_JUDGED_AREA,
    )
