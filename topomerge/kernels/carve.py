"""Marking the cells that rays cross."""

from __future__ import annotations

import numpy as np
from numba import njit, prange


@njit(cache=True, parallel=True)
def carve(starts, ends, margin, crossed):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Sets `crossed` (nx, ny, nz) bool in every cell that a ray enters between `starts` and `margin` cells before `ends`
    ((k, 3) float64, in cells), by the digital differential analyser of Amanatides and Woo (1987)."""
    nx, ny, nz = crossed.shape
    for i in prange(len(starts)):
        length = 0.0
        for k in range(3):
            length += (ends[i, k] - starts[i, k]) ** 2
        length = np.sqrt(length)
        if not length > margin:
            continue
        stop = (length - margin) / length
        x, y, z = int(np.floor(starts[i, 0])), int(np.floor(starts[i, 1])), int(np.floor(starts[i, 2]))
        dx, dy, dz = ends[i, 0] - starts[i, 0], ends[i, 1] - starts[i, 1], ends[i, 2] - starts[i, 2]
        far = np.inf
        sx, sy, sz = (1 if dx > 0 else -1), (1 if dy > 0 else -1), (1 if dz > 0 else -1)
        tx = (x + (sx > 0) - starts[i, 0]) / dx if dx != 0 else far
        ty = (y + (sy > 0) - starts[i, 1]) / dy if dy != 0 else far
        tz = (z + (sz > 0) - starts[i, 2]) / dz if dz != 0 else far
        ux, uy, uz = (abs(1 / dx) if dx != 0 else far), (abs(1 / dy) if dy != 0 else far), (abs(1 / dz) if dz != 0 else far)
        t = 0.0
        while t < stop:
            if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
                crossed[x, y, z] = True
            if tx <= ty and tx <= tz:
                t, tx, x = tx, tx + ux, x + sx
            elif ty <= tz:
                t, ty, y = ty, ty + uy, y + sy
            else:
                t, tz, z = tz, tz + uz, z + sz
