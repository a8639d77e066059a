"""What stands in a column of cells: its profile, a bit a level."""

from __future__ import annotations

import numpy as np
from numba import njit

PROFILE_LEVELS = 64
PROFILE_BELOW = 4  # levels below the floor that a profile begins with


@njit(cache=True)
def profiles(cells, low, base, top, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Sets in `out` (nx, ny) uint64 bit b where cell (x, y, base - PROFILE_BELOW + b) is occupied, up to the level `top`.

    `low` (2,) is the column of out[0, 0]; a `base` below -PROFILE_BELOW means that the column has no floor.
    """
    nx, ny = base.shape
    for i in range(len(cells)):
        x, y = cells[i, 0] - low[0], cells[i, 1] - low[1]
        if 0 <= x < nx and 0 <= y < ny and base[x, y] >= -PROFILE_BELOW and cells[i, 2] <= top[x, y]:
            b = cells[i, 2] - base[x, y] + PROFILE_BELOW
            if 0 <= b < PROFILE_LEVELS:
                out[x, y] |= np.uint64(1) << np.uint64(b)


@njit(cache=True)
def lowest_bit(profile, begin):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(n,) first set bit of each profile from bit `begin` on; -1: none."""
    out = np.full(len(profile), -1, np.int64)
    for i in range(len(profile)):
        word = profile[i]
        for b in range(begin, PROFILE_LEVELS):
            if (word >> np.uint64(b)) & np.uint64(1):
                out[i] = b
                break
    return out
