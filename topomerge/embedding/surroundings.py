"""Surroundings of a room: its storey seen from above, turned into the direction of the walls, and crops about each room.

All storeys of a map lie on one *sheet* of pixels (`embedding.sheets`) with an empty strip between them, so that no crop shows
two. A crop has a room's middle in its own, reaches past the room's borders, and is empty where the map saw nothing. A wide crop
reaches twice as far, with pixels of a metre; crops of doors have a door in their middle, which stands in the same place in both
maps where the middle of a room that was only looked into does not. Walls without
right angles are turned like others, by the direction in which most of them line up; two maps of such a place may be turned by
different ones, and their crops are hardly alike then.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from topomerge.kernels.images import cut
from topomerge.types import Array

# Parts of a geometry that read crops, and the names of these among the tensors of a graph.
CROP_PART, WIDE_PART, DOOR_PART = "surroundings", "wide_surroundings", "door_surroundings"
SHEET_PIXEL = 0.25  # m
CROP = 64  # pixels, side of a crop
WIDE_CROP, WIDE_STEP = 32, 4  # pixels of a wide crop, and of the sheet on a side of each
DOOR_CROP, DOOR_CROPS = 32, 4  # pixels, side of a door's crop; doors of a room that have one
GAP = 80  # pixels between two storeys: more than half a wide crop, that may be shifted
SHEET_PLANES = ("wall", "floor", "low", "high", "explored", "ceiling", "door")
CROP_PLANES = (*SHEET_PLANES, "room")  # the room in the middle
CEILING_UNIT = 0.02  # m over the floor for each step of a pixel's value
CROP_SHAPES = {  # of each room
    CROP_PART: (CROP, CROP, len(CROP_PLANES)),
    WIDE_PART: (WIDE_CROP, WIDE_CROP, len(CROP_PLANES)),
    DOOR_PART: (DOOR_CROPS, DOOR_CROP, DOOR_CROP, len(CROP_PLANES)),
}
TIE = 1e-3  # pixels: what lies on a border falls to the same side wherever a map's origin is


def cut_crops(map_sheet: Mapping[str, Array], part: str = CROP_PART, rooms: Array | None = None) -> Array:
    """Return (n, *CROP_SHAPES[part]) uint8: the surroundings of rooms; of doors that one does not have, nothing.

    Args:
        map_sheet: what `sheets.build_sheet_arrays` gave; "door_anchor" is read for crops of doors only.
        rooms: (n,) numbers of those that are wanted; all if left out.
    """
    anchor = np.asarray(map_sheet["anchor"])
    number = np.arange(len(anchor)) if rooms is None else np.asarray(rooms)
    if part == CROP_PART:
        return _cut(map_sheet, anchor[number], number, CROP)
    if part == WIDE_PART:
        return _cut(map_sheet, anchor[number], number, WIDE_CROP, WIDE_STEP)
    doors = np.asarray(map_sheet["door_anchor"])[:, :DOOR_CROPS]
    doors = doors if rooms is None else doors[number]
    finite = np.isfinite(doors).all(axis=2)
    out = np.zeros((len(number), *CROP_SHAPES[DOOR_PART]), np.uint8)
    out[finite] = _cut(map_sheet, doors[finite], number[np.nonzero(finite)[0]], DOOR_CROP)
    return out


def _cut(map_sheet: Mapping[str, Array], middles: Array, number: Array, side: int, step: int = 1) -> Array:
    """Cut (n, side, side, len(CROP_PLANES)) uint8 crops about places (n, 2) of the sheet, pixels, that show the rooms (n,).

    Args:
        step: pixels of the sheet on a side of each of theirs, which are means.
    """
    planes, room = (np.ascontiguousarray(map_sheet[name]) for name in ("sheet", "sheet_room"))
    corner = np.clip(np.floor(middles + (0.5 + TIE)).astype(np.int64), 0, room.shape) - side * step // 2
    out: Array = cut(planes, room, corner, np.asarray(number, np.int64), side, step)
    return out


def rotate_crops(part: str, shown: Array, turns: int) -> Array:
    """Return crops of a map that is turned by so many quarter turns, counter-clockwise seen from above."""
    axes = (1, 2) if len(CROP_SHAPES[part]) == 3 else (2, 3)
    return np.rot90(shown, turns, axes)
