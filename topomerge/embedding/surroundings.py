"""What stands around a room: its storey seen from above, turned into the direction of the walls, and crops about each room.

All storeys of a map lie on one *sheet* of pixels (`embedding.sheets`) with an empty strip between them, so that no crop shows
two. A crop has a room's middle in its own, reaches past the room's borders, and is empty where the map saw nothing. Walls without
right angles are turned like others, by the direction in which most of them line up; two maps of such a place may be turned by
different ones, and their crops are hardly alike then.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from topomerge.types import Array

CROP_PART = "surroundings"  # part of a geometry that reads crops, and the name of the crops among the tensors of a graph
SHEET_PIXEL = 0.25  # m
CROP = 64  # pixels, side of a crop
GAP = 48  # pixels between two storeys: more than half a crop, that may be shifted
SHEET_PLANES = ("wall", "floor", "low", "high", "explored", "ceiling", "door")
CROP_PLANES = (*SHEET_PLANES, "room")  # the room in the middle
CEILING_UNIT = 0.02  # m over the floor for each step of a pixel's value
TIE = 1e-3  # pixels: what lies on a border falls to the same side wherever a map's origin is


def crops(map_sheet: Mapping[str, Array]) -> Array:
    """(R, CROP, CROP, len(CROP_PLANES)) uint8: the surroundings of each room.

    Args:
        map_sheet: what `sheets.sheet_arrays` gave.
    """
    planes, room, anchor = (map_sheet[name] for name in ("sheet", "sheet_room", "anchor"))
    half = CROP // 2
    middles = np.clip(np.floor(anchor + (0.5 + TIE)).astype(int), 0, room.shape)
    planes, room = np.pad(planes, ((half, half), (half, half), (0, 0))), np.pad(room, half, constant_values=-1)
    out = np.zeros((len(anchor), CROP, CROP, len(CROP_PLANES)), np.uint8)
    for r, (x, y) in enumerate(middles):
        at = np.s_[x : x + CROP, y : y + CROP]
        out[r, ..., :-1] = planes[at]
        out[r, ..., -1] = 255 * (room[at] == r)
    return out
