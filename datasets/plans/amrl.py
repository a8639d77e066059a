"""Line maps of UT-AMRL (``*.vectormap.json``): segments in metres that show both faces of the walls; doors are gaps.

There are no rooms in the file: the walls are drawn into a raster, gaps up to `DOOR_GAP` are closed, and what stays apart
is rooms.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from scipy import ndimage
from topomerge.datasets.plans.grid import add_contacts, add_rooms, find_contacts, flood, guess_kinds
from topomerge.datasets.plans.sketch import Sketch, read_limited

from topomerge.errors import InputError
from topomerge.types import Array

LINE_MAP_CELL = 0.05  # m
DOOR_GAP = 1.6  # m; wider gaps do not part rooms
FRONT_GAP = 5.0  # m; wider gaps in the outer walls make what lies behind them outside
LINE_MAP_MARGIN = FRONT_GAP  # m of outside around the map
SMALLEST_LINE_ROOM = 1.5  # m2 of a room
LINE_MAP_CAVITY = 0.5  # m; narrower space lies within the walls
LINE_MAP_REACH = 1e9  # m from the origin that a wall may be
LINE_MAP_BYTES, LINE_MAP_CELLS = 50 << 20, 50_000_000


def iter_sketches(path: Path) -> Iterator[tuple[str, Callable[[], Sketch]]]:
    """Yield the name and maker of the one storey."""
    yield path.name.removesuffix(".vectormap.json"), partial(parse_sketch, read_limited(path, LINE_MAP_BYTES))


def parse_sketch(text: bytes) -> Sketch:
    """Return one storey.

    Raises:
        InputError: no JSON, or not a list of segments; larger than 350 m across; walls that enclose nothing.
    """
    lines = _parse_segments(text)
    wall, origin = _rasterize_walls(lines)
    distance = ndimage.distance_transform_edt(~wall) * LINE_MAP_CELL
    free = ~wall & _find_inside(distance)
    seeds = ndimage.label(free & (distance > DOOR_GAP / 2))[0].astype(np.int32)
    labels = flood(seeds, free, np.round(distance / LINE_MAP_CELL))
    labels[np.isin(labels, _find_outdoor_regions(labels, free, wall))] = 0
    result = Sketch(height=3.6, ceiling=2.8, inset=0.02)
    index = add_rooms(result, labels, {}, LINE_MAP_CELL, origin, SMALLEST_LINE_ROOM, LINE_MAP_CAVITY / 2)
    if not index:
        raise InputError("not closed: the walls enclose no room")
    for a, b, ends in find_contacts(labels, LINE_MAP_CELL, origin):
        along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
        add_contacts(
            result, [(a, b, ends + np.stack([-along, along]) * LINE_MAP_CELL)], index, "door"
        )  # walls were drawn thicker
    guess_kinds(result, "office")
    return result


def _parse_segments(text: bytes) -> Array:
    """Parse the segments (n, 2, 2), m."""
    try:
        loaded = json.loads(text)
        lines = np.array([[[s[p]["x"], s[p]["y"]] for p in ("p0", "p1")] for s in loaded], float).reshape(-1, 2, 2)
    except (ValueError, RecursionError) as error:
        raise InputError(f"damaged JSON: {str(error)[:120]}") from error
    except (KeyError, TypeError) as error:
        raise InputError("not a line map: expected a list of {p0: {x, y}, p1: {x, y}}") from error
    lines = lines[np.isfinite(lines).all(axis=(1, 2))]
    if not len(lines):
        raise InputError("no walls: the map has no segment")
    return lines


def _find_inside(distance: Array) -> Array:
    """Return (h, w) bool: the building, after closing gaps of up to `FRONT_GAP` in its outer walls (glass is often not in the
    map)."""
    closed = ndimage.binary_fill_holes(distance <= FRONT_GAP / 2)
    inside: Array = ndimage.distance_transform_edt(closed) * LINE_MAP_CELL > FRONT_GAP / 2
    return inside


def _find_outdoor_regions(labels: Array, free: Array, wall: Array) -> Array:
    """Return the labels of corners between two wings: regions that end without a wall for longer than they are wide."""
    edge = ndimage.binary_dilation(~free & ~wall) & (labels > 0)
    length, area = (np.bincount(labels[where], minlength=labels.max() + 1) for where in (edge, labels > 0))
    return np.flatnonzero(length > 1.2 * np.sqrt(area))


def _rasterize_walls(lines: Array) -> tuple[Array, Array]:
    """Return (h, w) bool raster of the walls, and its origin, m."""
    reach = float(np.abs(lines).max())
    if reach > LINE_MAP_REACH:
        raise InputError(f"absurd scale: a map that reaches {reach:.3g} m")
    low, high = lines.min(axis=(0, 1)) - LINE_MAP_MARGIN, lines.max(axis=(0, 1)) + LINE_MAP_MARGIN
    shape = np.ceil((high - low) / LINE_MAP_CELL).astype(int)
    if shape.astype(float).prod() > LINE_MAP_CELLS:
        raise InputError(f"absurd scale: a map of {high[0] - low[0]:.0f} by {high[1] - low[1]:.0f} m")
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    count = (length / LINE_MAP_CELL * 2).astype(int) + 2
    t = np.concatenate([np.linspace(0, 1, n) for n in count])[:, None]
    points = np.repeat(lines[:, 0], count, axis=0) * (1 - t) + np.repeat(lines[:, 1], count, axis=0) * t
    cells = np.floor((points - low) / LINE_MAP_CELL).astype(int)
    wall = np.zeros((shape[1] + 1, shape[0] + 1), bool)
    wall[cells[:, 1], cells[:, 0]] = True
    return ndimage.binary_dilation(wall), low  # fills the cavity between the two faces of thin walls
