"""Rooms and doors out of a raster of labels. Row 0 is the lowest y; label 0 is no room."""

from __future__ import annotations

import numpy as np
import shapely
from scipy import ndimage
from topomerge.datasets.plans.sketch import Sketch, build_opening

from topomerge.types import Array

ROUGH = 1.2  # cells, tolerance of outlines
BENT = 0.35  # m, that the points of a doorway may lie aside of its line
NARROW_CONTACT = 0.65  # m; narrower contacts of two rooms are no doors
DOORWAY_THICKNESS = 0.4  # m, thickness given to a doorway found in a raster
BUSY = 5  # doors from which on a room is a corridor


def flood(labels: Array, free: Array, height: Array | None = None) -> Array:
    """Labels spread over free cells, highest first, never across a wall: two regions meet where the way between them is lowest.

    Args:
        labels: (h, w) int32, 0 where nothing is yet.
        free: (h, w) bool.
        height: (h, w), for instance the distance to the nearest wall; None: all the same.
    """
    wide = np.pad(np.where(free, labels, 0), 1)
    flat = wide.ravel()
    todo = np.flatnonzero(np.pad(free, 1).ravel() & (flat == 0))
    levels = np.zeros(len(todo)) if height is None else np.pad(height, 1).ravel()[todo]
    steps = np.array([-1, 1, -wide.shape[1], wide.shape[1]])
    for level in np.unique(levels)[::-1]:
        active = todo[levels >= level]
        active = active[flat[active] == 0]
        while len(active):
            spread = flat[active[:, None] + steps].max(axis=1)
            reached = spread > 0
            if not reached.any():
                break
            flat[active[reached]] = spread[reached]
            active = active[~reached]
    return np.ascontiguousarray(wide[1:-1, 1:-1])


def trace_outline(mask: Array, resolution: float, origin: Array, thin: float = 0.0) -> shapely.Polygon:
    """Trace the outline of the largest part of a mask, m; smoothed, and without what is narrower than twice `thin` m."""
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return shapely.Polygon()
    start = np.ones(len(rows), bool)
    start[1:] = (rows[1:] != rows[:-1]) | (columns[1:] != columns[:-1] + 1)
    first, last = np.flatnonzero(start), np.append(np.flatnonzero(start)[1:] - 1, len(rows) - 1)
    boxes = shapely.box(columns[first], rows[first], columns[last] + 1, rows[first] + 1)
    whole = shapely.union_all(boxes)
    if thin:
        off = thin / resolution
        whole = whole.buffer(-off, join_style="mitre").buffer(off, join_style="mitre").intersection(whole)
    whole = whole.simplify(ROUGH)
    parts = [p for p in shapely.get_parts(shapely.make_valid(whole)) if p.geom_type == "Polygon"]
    best = max(parts, key=lambda p: p.area, default=shapely.Polygon())
    return shapely.transform(best, lambda points: points * resolution + origin)


def find_contacts(labels: Array, resolution: float, origin: Array) -> list[tuple[int, int, Array]]:
    """Find where regions touch: two labels and the ends (2, 2), m, of the contact's line; bent contacts are no doorways."""
    touching = []
    pairs: dict[tuple[int, int], list[Array]] = {}
    for axis in (0, 1):
        a, b = (labels[:-1], labels[1:]) if axis == 0 else (labels[:, :-1], labels[:, 1:])
        rows, columns = np.nonzero((a != b) & (a > 0) & (b > 0))
        middle = np.column_stack([columns, rows]) + ([0.5, 1.0] if axis == 0 else [1.0, 0.5])
        low, high = np.minimum(a, b)[rows, columns], np.maximum(a, b)[rows, columns]
        for pair in np.unique(np.column_stack([low, high]), axis=0).tolist():
            pairs.setdefault((pair[0], pair[1]), []).append(middle[(low == pair[0]) & (high == pair[1])])
    for (first, second), parts in sorted(pairs.items()):
        points = np.concatenate(parts)
        for cluster in _cluster_points(points):
            line = _fit_line(cluster)
            along = (line[1] - line[0]) / max(float(np.hypot(*(line[1] - line[0]))), 1e-9)
            if np.ptp(cluster @ np.array([-along[1], along[0]])) * resolution <= BENT:
                touching.append((first, second, line * resolution + origin))
    return touching


def _cluster_points(points: Array) -> list[Array]:
    """Points that are at most two cells apart belong together."""
    low = np.floor(points.min(axis=0)).astype(int) - 2
    image = np.zeros(np.floor(points.max(axis=0)).astype(int) - low + 3, bool)
    cells = np.floor(points).astype(int) - low
    image[cells[:, 0], cells[:, 1]] = True
    numbers = ndimage.label(ndimage.binary_dilation(image, np.ones((3, 3))), np.ones((3, 3)))[0]
    which = numbers[cells[:, 0], cells[:, 1]]
    return [points[which == k] for k in np.unique(which)]


def _fit_line(points: Array) -> Array:
    """(2, 2) ends of the points along their main direction, which is an axis where that is nearly right."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    along = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0] if len(points) > 1 else np.array([1.0, 0])
    if np.abs(along).max() > 0.97:
        along = np.round(np.abs(along))
    t = (points - centre) @ along
    aside = np.array([-along[1], along[0]])
    middle = np.abs(t) <= np.abs(t).min() + max(np.ptp(t) / 4, 1.0)
    centre = centre + aside * float(np.mean((points[middle] - centre) @ aside))  # on the contact itself, where it is curved
    return np.asarray(centre + np.array([[t.min() - 0.5], [t.max() + 0.5]]) * along)


def add_rooms(
    result: Sketch,
    labels: Array,
    names: dict[int, str],
    resolution: float,
    origin: Array,
    smallest: float,
    thin: float = 0.0,
) -> dict[int, int]:
    """Add a room for each label whose outline has at least `smallest` m2; returns its index by label."""
    index = {}
    for label, place in enumerate(ndimage.find_objects(labels), 1):
        if place is None:
            continue
        corner = origin + np.array([place[1].start, place[0].start]) * resolution
        shape = trace_outline(labels[place] == label, resolution, corner, thin)
        if shape.area >= smallest:
            index[label] = result.add_room(names.get(label, f"room {label}"), "", shape)
    return index


def add_contacts(result: Sketch, doorways: list[tuple[int, int, Array]], index: dict[int, int], kind: str) -> None:
    """Add a doorway for each contact of two rooms."""
    for a, b, ends in doorways:
        if a in index and b in index and np.hypot(*(ends[1] - ends[0])) >= NARROW_CONTACT:
            result.add_opening(build_opening(kind, ends[0], ends[1], DOORWAY_THICKNESS), (index[a], index[b]))


def guess_kinds(result: Sketch, usual: str) -> None:
    """Guess the kinds of rooms: those with many doors are corridors, the others `usual`."""
    doors = np.bincount(np.array([e for ends in result.ends for e in ends if e >= 0], int), minlength=len(result.shapes))
    result.kinds = ["corridor" if n >= BUSY else usual for n in doors]
