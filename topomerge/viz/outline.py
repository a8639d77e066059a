"""Outlines of what a plan shows: rasters of cells into few, smooth polygons."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import ndimage

from topomerge.types import Array
from topomerge.viz.plan import Frame, StoreyPlan
from topomerge.viz.sheet import Sheet

CLOSED = 0.3  # m: gaps in a room's cells up to twice this are closed: scan lines on a floor, legs of tables
ROOM_HOLE = 6.0  # m2: holes in a room up to this are furniture or shadows, larger ones are courtyards and cores
SMOOTH = 0.8  # pixels: standard deviation of the blur before an outline is traced
TOLERANCE = 0.5  # pixels that an outline may be off for having fewer corners
WALL_TRACE = (0.6, 0.36)  # blur and level for walls: lines of one pixel stay whole, single pixels go
DRAWN_AGAIN = 8  # plans whose outlines are kept: a report draws those of two maps several times
SPECK = 0.3  # m2: smaller patches of what was seen outside rooms are left out


@lru_cache(maxsize=DRAWN_AGAIN)
def whole_rooms(plan: StoreyPlan, frame: Frame) -> Array:
    """(nx, ny) int32 room of each pixel, -1 none, with small gaps and holes filled; no pixel changes from room to room."""
    reach = max(round(CLOSED / frame.size), 1)
    room = plan.room.copy()
    for i, box in enumerate(ndimage.find_objects(plan.room + 1)):
        if box is None:
            continue
        low = [max(s.start - reach - 1, 0) for s in box]
        wide = tuple(slice(a, s.stop + reach + 1) for a, s in zip(low, box, strict=True))
        mask = np.pad(plan.room[wide] == i, reach)  # away from the rim, where closing would eat the mask
        closed = ndimage.binary_closing(mask, ndimage.generate_binary_structure(2, 1), iterations=reach)
        inner = _without_holes(closed, ROOM_HOLE / frame.size**2)[reach:-reach, reach:-reach]
        part = room[wide]
        part[inner & (part < 0)] = i
    return room


def _without_holes(mask: Array, most: float) -> Array:
    holes, count = ndimage.label(ndimage.binary_fill_holes(mask) & ~mask)
    small = np.bincount(holes.ravel(), minlength=count + 1) <= most
    small[0] = False
    return mask | small[holes]


@lru_cache(maxsize=DRAWN_AGAIN)
def room_outlines(plan: StoreyPlan, sheet: Sheet) -> dict[int, str]:
    """Room -> its outline as the `d` of an SVG path."""
    room = whole_rooms(plan, sheet.frame)
    outlines = {}
    for i, box in enumerate(ndimage.find_objects(room + 1)):
        if box is not None:
            start = np.array([s.start for s in box])
            share = (room[box] == i).astype(np.float32)
            outlines[i] = trace(share, sheet, start) or trace(share, sheet, start, blur=0.0)
    return outlines


@lru_cache(maxsize=DRAWN_AGAIN)
def wall_outline(plan: StoreyPlan, sheet: Sheet) -> str:
    """Walls as the `d` of an SVG path; the two faces of a thin wall are drawn as one."""
    near = round(0.1 / sheet.frame.size)
    wall = plan.wall
    if near:
        padded = np.pad(wall, near)
        wall = ndimage.binary_closing(padded, np.ones((3, 3), bool), iterations=near)[near:-near, near:-near]
    blur, level = WALL_TRACE
    return trace(wall.astype(np.float32), sheet, blur=blur, level=level)


def seen_outline(plan: StoreyPlan, sheet: Sheet) -> str:
    """What was seen of the storey outside rooms, as the `d` of an SVG path."""
    patches, count = ndimage.label(plan.floor & (whole_rooms(plan, sheet.frame) < 0))
    large = np.bincount(patches.ravel(), minlength=count + 1) >= SPECK / sheet.frame.size**2
    large[0] = False
    return trace(large[patches].astype(np.float32), sheet)


def trace(
    share: Array, sheet: Sheet, start: Array | None = None, blur: float = SMOOTH, level: float = 0.5, tolerance: float = TOLERANCE
) -> str:
    """The `d` of an SVG path around the pixels of which a share above `level` is filled; "" where there are none.

    Args:
        share: (nx, ny) float, of the frame's pixels from `start` on.
        sheet: the paper and the pixels' place.
        start: (2,) pixel at share[0, 0], by default (0, 0).
        blur: standard deviation of the blur before, in pixels.
        level: above this is inside.
        tolerance: how far the path may be off, in pixels (Douglas and Peucker 1973).
    """
    import contourpy
    import shapely

    pad = int(np.ceil(3 * blur)) + 1
    field = ndimage.gaussian_filter(np.pad(share, pad), blur) if blur else np.pad(share, pad)
    lines = contourpy.contour_generator(z=field.T).lines(level)  # closed: the padding is outside
    rings = [shapely.LinearRing(line) for line in lines if len(line) > 3]
    offset = (np.zeros(2) if start is None else start) - pad + 0.5
    return "".join(_ring(np.asarray(r.coords)[:-1] + offset, sheet) for r in shapely.simplify(rings, tolerance))


def _ring(pixels: Array, sheet: Sheet) -> str:
    """One closed ring, as steps in cm."""
    cm = sheet.cm(sheet.frame.low + pixels * sheet.frame.size)
    first, steps = cm[0].tolist(), np.diff(cm, axis=0)
    steps = steps[(steps != 0).any(axis=1)].tolist()
    return f"M{first[0]} {first[1]}l{' '.join(f'{x} {y}' for x, y in steps)}z" if len(steps) > 1 else ""
