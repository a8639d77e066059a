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
