"""What can be seen over the floor of a plan."""

from __future__ import annotations

import numpy as np
from numba import njit, prange


@njit(cache=True, parallel=True)
def seen_from(free, targets, starts, reach):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(t,) bool: does a straight line over columns that are `free` (nx, ny) lead from any start to each target, at most `reach`
    columns long?

    `targets` (t, 2) and `starts` (s, 2) int64 columns.
    """
    out = np.zeros(len(targets), np.bool_)
    for i in prange(len(targets)):
        x, y = targets[i, 0], targets[i, 1]
        for k in range(len(starts)):
            dx, dy = starts[k, 0] - x, starts[k, 1] - y
            if dx * dx + dy * dy > reach * reach:
                continue
            steps = max(abs(dx), abs(dy))
            clear = True
            for s in range(1, steps):
                if not free[int(np.rint(x + dx * s / steps)), int(np.rint(y + dy * s / steps))]:
                    clear = False
                    break
            if clear:
                out[i] = True
                break
    return out
