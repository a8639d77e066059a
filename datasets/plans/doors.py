"""Where doors go: which rooms a segment joins, and where two rooms face each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import shapely
from topomerge.datasets.core.plan import Opening

from topomerge.types import Array

LEAF_WIDTH = 1.4  # m; wider doorways have no leaf
PROBE_STEP = 0.05  # m, between the samples along an edge
DOOR_MARGIN = 0.1  # m, that a door keeps from the corners, where there is room
DOOR_SPARE = 0.3  # m, that an opening is thicker than the gap between the rooms: walls may be set into them


def doorway(kind: str, start: Array, end: Array, thickness: float) -> Opening:
    """An opening from two points; a door that is too wide for a leaf becomes a plain opening."""
    width = float(np.hypot(*(np.asarray(end) - np.asarray(start))))
    if kind == "door" and width > LEAF_WIDTH:
        kind = "opening"
    return Opening(kind, (float(start[0]), float(start[1])), (float(end[0]), float(end[1])), thickness)


def window(opening: Opening, bottom: float, top: float) -> Opening:
    """The same hole, glazed."""
    return replace(opening, kind="window", bottom=bottom, top=top)


def sides(start: Array, end: Array, shapes: Sequence[shapely.Polygon], reach: float | Array) -> Array:
    """Which shapes lie on the two sides of segments.

    Args:
        start, end: (n, 2).
        reach: m, or (n,), how far from the middle of the segment a shape is looked for.

    Returns:
        (n, 2) index of the first shape on the left and on the right, -1: none.
    """
    along = (end - start) / np.maximum(np.linalg.norm(end - start, axis=1), 1e-9)[:, None]
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    steps = np.arange(0.02, float(np.max(reach, initial=0)), PROBE_STEP)
    offsets = np.stack([steps, -steps])[None, :, :, None] * normal[:, None, None]  # (n, 2, s, 2)
    points = ((start + end) / 2)[:, None, None] + offsets
    which = np.full(points.shape[:-1], -1)
    point, shape = shapely.STRtree(shapes).query(shapely.points(points.reshape(-1, 2)), predicate="within")
    order = np.argsort([-shapes[i].area for i in shape], kind="stable")  # where shapes overlap, the smaller one counts
    which.reshape(-1)[point[order]] = shape[order]
    which[np.broadcast_to(steps > np.reshape(reach, (-1, 1, 1)), which.shape)] = -1
    first = np.argmax(which >= 0, axis=2)
    nearest_room: Array = np.take_along_axis(which, first[..., None], axis=2)[..., 0]
    return nearest_room


def facing(a: shapely.Polygon, b: shapely.Polygon, reach: float) -> list[Array]:
    """Runs along the outline of `a` that look straight at `b` from at most `reach` m.

    Returns:
        One (n, 5) array a run: point on the outline of `a`, outward normal, and gap to `b`, m; points are `PROBE_STEP` apart.
    """
    ring = np.asarray(shapely.orient_polygons(a).exterior.coords)[:, :2]
    rings = [ring, *(np.asarray(r.coords)[:, :2] for r in shapely.orient_polygons(a).interiors)]
    low, high = np.array(a.bounds).reshape(2, 2) + [[-reach - 1], [reach + 1]]
    b = shapely.intersection(b, shapely.box(*low, *high))  # b may be a hall that is much larger
    near = b.buffer(reach + PROBE_STEP)
    runs = []
    for corners in rings:
        for start, end in pairwise(corners):
            length = float(np.hypot(*(end - start)))
            if length > PROBE_STEP and near.intersects(shapely.LineString([start, end])):
                runs += _runs(start, (end - start) / length, length, b, reach)
    return runs


def _runs(start: Array, along: Array, length: float, b: shapely.Polygon, reach: float) -> list[Array]:
    t = np.linspace(0, length, max(int(length / PROBE_STEP), 2) + 1)
    t = np.clip(t, 1e-3, length - 1e-3)
    points = start + t[:, None] * along
    normal = np.array([along[1], -along[0]])  # outward of a counter-clockwise outline
    back = points - normal * 0.1  # b may overlap a little
    rays = shapely.linestrings(np.stack([back, points + normal * (reach + 1e-6)], axis=1))
    hits = shapely.intersection(rays, b)
    gaps = np.maximum(shapely.distance(hits, shapely.points(back)) - 0.1, 0.0)
    seen = ~shapely.is_empty(hits) & np.isfinite(gaps)
    rows = np.column_stack([points, np.broadcast_to(normal, points.shape), gaps])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(int), [0]])))
    return [rows[i:j] for i, j in edges.reshape(-1, 2) if j - i > 1]


def place_door(
    a: shapely.Polygon, b: shapely.Polygon, width: float, reach: float, near: Array | None = None, kind: str = "door"
) -> Opening | None:
    """A door between two rooms whose outlines run along the wall's faces.

    Args:
        width: m; made narrower, down to 0.6 m, where the rooms do not face each other for so long.
        reach: m, how far apart the outlines may be.
        near: (2,) where the door should be; None: in the middle of the longest stretch that the rooms share.

    Returns:
        None where the rooms face each other nowhere for 0.6 m.
    """
    best: tuple[float, Array] | None = None
    for run in facing(a, b, reach):
        length = float(np.hypot(*(run[-1, :2] - run[0, :2])))
        if length < 0.6:
            continue
        cost = -length if near is None else float(np.linalg.norm(run[:, :2] - near, axis=1).min())
        if best is None or cost < best[0] - 1e-6:
            best = (cost, run)
    if best is None:
        return None
    return _cut_out(best[1], width, near, kind)


def _cut_out(run: Array, width: float, near: Array | None, kind: str) -> Opening:
    first, last = run[0, :2], run[-1, :2]
    length = float(np.hypot(*(last - first)))
    along = (last - first) / length
    margin = float(np.clip((length - width) / 2, 0, DOOR_MARGIN))
    width = min(width, length - 2 * margin)
    wanted = length / 2 if near is None else float((np.asarray(near) - first) @ along)
    middle = float(np.clip(wanted, margin + width / 2, length - margin - width / 2))
    t = (run[:, :2] - first) @ along
    gaps = run[np.abs(t - middle) <= width / 2 + PROBE_STEP, 4]
    depth = float(gaps.max())
    start, end = (first + along * (middle + s * width / 2) + run[0, 2:4] * depth / 2 for s in (-1, 1))
    return doorway(kind, start, end, depth + DOOR_SPARE)
