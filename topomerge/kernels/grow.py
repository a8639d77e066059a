"""Steps from a set of pixels to the others, on foot."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def steps_from(start, way):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(nx, ny) int64 fewest steps, of 8 neighbours and through pixels of `way` only, from a pixel of `start` to each; -1 none.

    Args:
        start, way: (nx, ny) bool.
    """
    nx, ny = start.shape
    steps = np.full((nx, ny), -1, np.int64)
    queue = np.empty(nx * ny, np.int64)
    tail = 0
    for x in range(nx):
        for y in range(ny):
            if start[x, y]:
                steps[x, y] = 0
                queue[tail] = x * ny + y
                tail += 1
    head = 0
    while head < tail:
        x, y = queue[head] // ny, queue[head] % ny
        head += 1
        for u in range(max(x - 1, 0), min(x + 2, nx)):
            for v in range(max(y - 1, 0), min(y + 2, ny)):
                if way[u, v] and steps[u, v] < 0:
                    steps[u, v] = steps[x, y] + 1
                    queue[tail] = u * ny + v
                    tail += 1
    return steps
