"""Points -> strips along walls: how much stands at each place along, across and above each of many lines."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@njit(cache=True)
def _fill(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    points, frames, sizes, starts, low, tile, columns, first, lines, step, out
):
    for p in range(len(points)):
        i, j = int((points[p, 0] - low[0]) // tile), int((points[p, 1] - low[1]) // tile)
        if i < 0 or j < 0 or i >= columns[0] or j >= columns[1]:
            continue
        at = i * columns[1] + j
        for k in range(first[at], first[at + 1]):
            line = lines[k]
            x, y = points[p, 0] - frames[line, 0], points[p, 1] - frames[line, 1]
            ax, ay = frames[line, 2], frames[line, 3]
            ox, oy = frames[line, 4], frames[line, 5]
            u = int((x * ax + y * ay) // step[0])
            v = (x * ox + y * oy) / step[1] - 0.5
            w = int((points[p, 2] - frames[line, 6]) // step[2])
            if u < 0 or u >= sizes[line] or w < 0 or w >= out.shape[2]:
                continue
            near = int(np.floor(v))
            far = v - near
            row = starts[line] + u
            if 0 <= near < out.shape[1]:
                out[row, near, w] += 1.0 - far
            if 0 <= near + 1 < out.shape[1]:
                out[row, near + 1, w] += far


def fill_strips(
    points: Floats, frames: Floats, sizes: Ints, shape: tuple[int, int], step: Floats, tile: float
) -> NDArray[np.float32]:
    """Count the points in each element of strips along lines; between two elements across they count for both, in proportion.

    Args:
        points: (n, 3) m.
        frames: (L, 7) lower corner of each strip from above (2), unit vectors along (2) and across (2), and its lower height.
        sizes: (L,) elements along each strip.
        shape: elements across, and above each other.
        step: (3,) m along, across and up of an element.
        tile: m, of the squares in which lines are looked up.

    Returns:
        (sizes.sum(), *shape) float32, one strip after the other.
    """
    starts = np.concatenate([[0], np.cumsum(sizes)])
    out = np.zeros((int(starts[-1]), *shape), np.float32)
    if not len(frames) or not len(points):
        return out
    along, across = sizes * step[0], shape[0] * step[1]
    corners = frames[:, None, :2] + np.array([0.0, 1.0])[:, None] * (along[:, None] * frames[:, 2:4])[:, None]
    corners = np.concatenate([corners, corners + across * frames[:, None, 4:6]], axis=1)
    low = corners.min(axis=(0, 1))
    columns = ((corners.max(axis=(0, 1)) - low) // tile).astype(np.int64) + 1
    table = _touched(frames, along, across, low, tile, columns)
    first = np.searchsorted(table[:, 0], np.arange(int(columns.prod()) + 1))
    lines = np.ascontiguousarray(table[:, 1])
    _fill(points, frames, sizes, starts, low, tile, columns, first, lines, step, out)
    return out


def _touched(frames: Floats, along: Floats, across: float, low: Floats, tile: float, columns: Ints) -> Ints:
    """(n, 2) square and strip of all that touch each other, ascending: squares of places in a strip that are closer to each other
    than a square is wide."""
    d = np.linspace(0, across, int(np.ceil(4 * across / tile)) + 2)
    aside = tile / 4 * np.array([(u, v) for u in (-1, 0, 1) for v in (-1, 0, 1)])
    parts = []
    for line, frame in enumerate(frames):
        t = np.linspace(0, along[line], int(np.ceil(4 * along[line] / tile)) + 2)
        places = frame[:2] + t[:, None, None] * frame[2:4] + d[:, None] * frame[4:6]
        near = np.floor(((places.reshape(-1, 1, 2) + aside).reshape(-1, 2) - low) / tile).astype(np.int64)
        near = near[((near >= 0) & (near < columns)).all(axis=1)]
        square = np.unique(near[:, 0] * columns[1] + near[:, 1])
        parts.append(np.column_stack([square, np.full(len(square), line)]))
    table = np.concatenate(parts)
    return np.asarray(table[np.lexsort((table[:, 1], table[:, 0]))])
