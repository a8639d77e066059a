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
    """How many points each element of strips along lines holds; between two elements across they count for both, in proportion.

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
    pairs = [
        (i * columns[1] + j, line)
        for line in range(len(frames))
        for i, j in _tiles(frames[line], float(along[line]), across, low, tile)
        if 0 <= i < columns[0] and 0 <= j < columns[1]
    ]
    table = np.array(sorted(pairs), np.int64)
    first = np.searchsorted(table[:, 0], np.arange(int(columns.prod()) + 1))
    lines = np.ascontiguousarray(table[:, 1])
    _fill(points, frames, sizes, starts, low, tile, columns, first, lines, step, out)
    return out


def _tiles(frame: Floats, along: float, across: float, low: Floats, tile: float) -> set[tuple[int, int]]:
    """The squares that a strip touches: those of places in it that are closer to each other than a square is wide."""
    t, d = (np.linspace(0, length, int(np.ceil(4 * length / tile)) + 2) for length in (along, across))
    places = frame[:2] + t[:, None, None] * frame[2:4] + d[:, None] * frame[4:6]
    near = places.reshape(-1, 2)[:, None] + tile / 4 * np.array([(u, v) for u in (-1, 0, 1) for v in (-1, 0, 1)])
    return set(map(tuple, np.floor((near.reshape(-1, 2) - low) / tile).astype(np.int64).tolist()))
