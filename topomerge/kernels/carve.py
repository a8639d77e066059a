"""Marking and counting the cells that rays cross."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from topomerge.kernels.lookup import row


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


@njit(cache=True, parallel=True)
def sweep(table, bricks, starts, directions, reach, coarser, crossed):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Sets `crossed` in every cell, `coarser` times as long as those of the grid, that lies between a start and the first
    occupied cell in each direction; nothing for a ray that meets none within `reach` cells.

    `starts` (v, 3) in cells, `directions` (d, 3) unit vectors.
    """
    nx, ny, nz = crossed.shape
    for i in prange(len(starts)):
        for d in range(len(directions)):
            dx, dy, dz = directions[d, 0], directions[d, 1], directions[d, 2]
            met = -1.0
            t = 1.0
            while t < reach:
                u, v, w = starts[i, 0] + t * dx, starts[i, 1] + t * dy, starts[i, 2] + t * dz
                if row(table, bricks, int(np.floor(u)), int(np.floor(v)), int(np.floor(w))) >= 0:
                    met = t
                    break
                t += 0.7
            t = 0.0
            while t < met - coarser / 2:
                x = int(np.floor((starts[i, 0] + t * dx) / coarser))
                y = int(np.floor((starts[i, 1] + t * dy) / coarser))
                z = int(np.floor((starts[i, 2] + t * dz) / coarser))
                if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
                    crossed[x, y, z] = True
                t += coarser / 2


@njit(cache=True)
def count_rays(starts, ends, margin, passed, met):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Adds to `passed` and `met` (nx, ny) int32 how many rays go through each column, from `starts` until `margin` columns before
    `ends` ((k, 2) float64, in columns), and how many end in it: as `carve`, in the plane."""
    nx, ny = passed.shape
    for i in range(len(starts)):
        dx, dy = ends[i, 0] - starts[i, 0], ends[i, 1] - starts[i, 1]
        x, y = int(np.floor(ends[i, 0])), int(np.floor(ends[i, 1]))
        if 0 <= x < nx and 0 <= y < ny:
            met[x, y] += 1
        length = np.sqrt(dx**2 + dy**2)
        if not length > margin:
            continue
        stop = (length - margin) / length
        x, y = int(np.floor(starts[i, 0])), int(np.floor(starts[i, 1]))
        sx, sy = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        tx = (x + (sx > 0) - starts[i, 0]) / dx if dx != 0 else np.inf
        ty = (y + (sy > 0) - starts[i, 1]) / dy if dy != 0 else np.inf
        ux, uy = (abs(1 / dx) if dx != 0 else np.inf), (abs(1 / dy) if dy != 0 else np.inf)
        t = 0.0
        while t < stop:
            if 0 <= x < nx and 0 <= y < ny:
                passed[x, y] += 1
            if tx <= ty:
                t, tx, x = tx, tx + ux, x + sx
            else:
                t, ty, y = ty, ty + uy, y + sy
