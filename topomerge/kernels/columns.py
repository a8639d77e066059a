"""Searching up and down the column of a cell."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from topomerge.kernels.lookup import row


@njit(cache=True, parallel=True)
def first_occupied(table, bricks, cells, start, step, limit):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(m,) number of cells from each cell to the first occupied one above (`step` 1) or below (-1) it, beginning `start` cells
    away; 0 where there is none within `limit` cells."""
    out = np.zeros(len(cells), np.int64)
    for i in prange(len(cells)):
        for d in range(start, limit + 1):
            if row(table, bricks, cells[i, 0], cells[i, 1], cells[i, 2] + step * d) >= 0:
                out[i] = d
                break
    return out


@njit(cache=True, inline="always")
def _any_near(table, bricks, x, y, z, reach):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    for dx in range(-reach, reach + 1):
        for dy in range(-reach, reach + 1):
            if row(table, bricks, x + dx, y + dy, z) >= 0:
                return True
    return False


@njit(cache=True, parallel=True)
def hollow_below(table, bricks, cells, reach, thickness, headroom, limit):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(m,) bool: does a run of at least `headroom` empty cells begin within `thickness` cells below each cell, and end at an
    occupied one within `limit` cells? A level is occupied if any cell within `reach` columns is: sparse points leave gaps."""
    out = np.zeros(len(cells), np.bool_)
    for i in prange(len(cells)):
        empty = 0
        for d in range(1, limit + 1):
            if _any_near(table, bricks, cells[i, 0], cells[i, 1], cells[i, 2] - d, reach):
                if empty >= headroom:
                    out[i] = True
                    break
                empty = 0
            else:
                if empty == 0 and d > thickness + 1:
                    break
                empty += 1
    return out


@njit(cache=True, parallel=True)
def levels_below(table, bricks, cells, reach, depth):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(m,) how many of the `depth` levels below each cell are occupied within `reach` columns."""
    out = np.zeros(len(cells), np.int64)
    for i in prange(len(cells)):
        for d in range(1, depth + 1):
            out[i] += _any_near(table, bricks, cells[i, 0], cells[i, 1], cells[i, 2] - d, reach)
    return out
