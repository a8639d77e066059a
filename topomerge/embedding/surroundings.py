"""What stands around a room: its storey seen from above, turned into the direction of the walls, and crops about each room.

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


def crops(map_sheet: Mapping[str, Array], part: str = CROP_PART) -> Array:
    """(R, *CROP_SHAPES[part]) uint8: the surroundings of each room; of doors that it does not have, nothing.

    Args:
        map_sheet: what `sheets.sheet_arrays` gave; "door_anchor" is read for crops of doors only.
    """
    anchor = np.asarray(map_sheet["anchor"])
    number = np.arange(len(anchor))
    if part == CROP_PART:
        return _cut(map_sheet, anchor, number, CROP)
    if part == WIDE_PART:
        return _cut(map_sheet, anchor, number, WIDE_CROP, WIDE_STEP)
    doors = np.asarray(map_sheet["door_anchor"])[:, :DOOR_CROPS]
    there = np.isfinite(doors).all(axis=2)
    out = np.zeros((len(anchor), *CROP_SHAPES[DOOR_PART]), np.uint8)
    out[there] = _cut(map_sheet, doors[there], np.nonzero(there)[0], DOOR_CROP)
    return out


def _cut(map_sheet: Mapping[str, Array], middles: Array, number: Array, side: int, step: int = 1) -> Array:
    """(n, side, side, len(CROP_PLANES)) uint8 crops about places (n, 2) of the sheet, pixels, that show the rooms (n,).

    Args:
        step: pixels of the sheet on a side of each of theirs, which are means.
    """
    planes, room, reach = map_sheet["sheet"], map_sheet["sheet_room"], side * step
    middles = np.clip(np.floor(middles + (0.5 + TIE)).astype(int), 0, room.shape)
    half = reach // 2
    planes, room = np.pad(planes, ((half, half), (half, half), (0, 0))), np.pad(room, half, constant_values=-1)
    planes = _means(planes, step)
    out = np.zeros((len(middles), side, side, len(CROP_PLANES)), np.uint8)
    for k, (x, y) in enumerate(middles):
        out[k, ..., :-1] = planes[x : x + reach : step, y : y + reach : step]
        own = (room[x : x + reach, y : y + reach] == number[k]).astype(np.uint16)
        parts = [own[i::step, j::step] for i in range(step) for j in range(step)]
        out[k, ..., -1] = sum(parts[1:], parts[0]) * 255 // step**2
    return out


def _means(planes: Array, step: int) -> Array:
    """(H - step + 1, W - step + 1, n) uint8 means of the squares that begin at each pixel of planes (H, W, n)."""
    if step == 1:
        return planes
    total = planes.astype(np.uint16)
    for _ in (0, 1):
        parts = [total[k : len(total) - step + 1 + k] for k in range(step)]
        total = sum(parts[1:], parts[0]).swapaxes(0, 1)
    return np.asarray(total // step**2, np.uint8)


def quarter_turned_crops(part: str, shown: Array, turns: int) -> Array:
    """Crops of a map that is turned by so many quarter turns, counter-clockwise seen from above."""
    axes = (1, 2) if len(CROP_SHAPES[part]) == 3 else (2, 3)
    return np.rot90(shown, turns, axes)
