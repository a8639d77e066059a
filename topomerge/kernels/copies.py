"""Cells of a wall that stands there a second time, beside the one that another map shows."""

from __future__ import annotations

import numpy as np
from numba import njit

from topomerge.kernels.lookup import row

UP, LEAST_UP = 2, 4  # of a cell's wall: of so many cells above it and below it, itself included, these many are occupied


@njit(cache=True)
def _upright(table, bricks, x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    count = 0
    for w in range(z - UP, z + UP + 1):
        if row(table, bricks, x, y, w) >= 0:
            count += 1
    return count >= LEAST_UP


@njit(cache=True)
def _seen_through(free, x, y, z, u, v):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Is the first or second place of free space behind (x, y, z), in the direction (u, v), known to be empty?"""
    for step in (1.5, 2.5, 3.5):
        p, q = int(np.floor(x + 0.5 + step * u)), int(np.floor(y + 0.5 + step * v))
        if row(free[0], free[1], p >> 1, q >> 1, z >> 1) >= 0:
            return True
    return False


@njit(cache=True)
def copied(cells, offsets, first, second, first_free, second_free):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(n,) int64 row of the first map's cell of which each of the second one's is a copy, -1 none.

    A copy is a cell of a wall, beside one of a wall of the first map, where that is not occupied itself: and either the first map
    saw through where it stands, or the second one through where the other stands. Else the two are the faces of a thick wall.

    Args:
        cells: (n, 3) int64 of the second map.
        offsets: (k, 2) int64 steps to the cells beside, the nearest first.
        first, second: table and bricks of their cells (`kernels.lookup`).
        first_free, second_free: of their free cells, which are twice as long.
    """
    out = np.full(len(cells), -1, np.int64)
    for i in range(len(cells)):
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        if row(first[0], first[1], x, y, z) >= 0 or not _upright(second[0], second[1], x, y, z):
            continue
        for k in range(len(offsets)):
            dx, dy = offsets[k, 0], offsets[k, 1]
            other = row(first[0], first[1], x + dx, y + dy, z)
            if other < 0 or not _upright(first[0], first[1], x + dx, y + dy, z):
                continue
            length = np.sqrt(float(dx * dx + dy * dy))
            u, v = dx / length, dy / length
            if _seen_through(first_free, x, y, z, -u, -v) or _seen_through(second_free, x + dx, y + dy, z, u, v):
                out[i] = other
            break
    return out
