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


@njit(cache=True, nogil=True)
def lit(opaque, starts, reach):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(nx, ny) bool: pixels that a straight line from any start (n, 2) int64 reaches, at most `reach` pixels long, with the
    `opaque` (nx, ny) pixel that ends it. A start may stand on an opaque pixel."""
    nx, ny = opaque.shape
    out = np.zeros((nx, ny), np.bool_)
    rays = int(2 * np.pi * reach) + 8
    for k in range(len(starts)):
        for ray in range(rays):
            angle = 2 * np.pi * ray / rays
            dx, dy = np.cos(angle) / 2, np.sin(angle) / 2
            x, y = starts[k, 0] + 0.5, starts[k, 1] + 0.5
            for step in range(int(2 * reach)):
                i, j = int(np.floor(x)), int(np.floor(y))
                if i < 0 or j < 0 or i >= nx or j >= ny:
                    break
                out[i, j] = True
                if opaque[i, j] and step > 3:
                    break
                x += dx
                y += dy
    return out
