"""How far one can go in a raster, straight ahead and across."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def run(mask, x, y, dx, dy, limit):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Cells from (x, y) along the unit vector (dx, dy) while `mask` holds, in halves, at most `limit`."""
    length = 0.0
    while length < limit:
        u, v = int(np.rint(x + (length + 0.5) * dx)), int(np.rint(y + (length + 0.5) * dy))
        if not (0 <= u < mask.shape[0] and 0 <= v < mask.shape[1]) or not mask[u, v]:
            break
        length += 0.5
    return length


@njit(cache=True)
def widths(mask, x, y, dx, dy, steps, limit):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(2 steps + 1,) free width (cells) across the direction (dx, dy)'s normal, at -steps..steps cells along that normal from
    (x, y); -1 from where the normal itself is blocked."""
    out = np.full(2 * steps + 1, -1.0)
    for sign in (-1, 1):
        for t in range(steps + 1):
            u, v = x - sign * t * dy, y + sign * t * dx
            i, j = int(np.rint(u)), int(np.rint(v))
            if not (0 <= i < mask.shape[0] and 0 <= j < mask.shape[1]) or not mask[i, j]:
                break
            out[steps + sign * t] = run(mask, u, v, dx, dy, limit) + run(mask, u, v, -dx, -dy, limit) + 1
    return out


@njit(cache=True)
def cover(mask, x, y, dx, dy, before, after, steps):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Greatest share of the cells of a line, from `before` cells behind (x, y) to `after` ahead along (dx, dy), for which `mask`
    holds; the line may be shifted by up to `steps` cells along its normal."""
    best = 0.0
    for t in range(-steps, steps + 1):
        hit, total = 0, 0
        for k in range(-int(before), int(after) + 1):
            u, v = int(np.rint(x + k * dx - t * dy)), int(np.rint(y + k * dy + t * dx))
            if 0 <= u < mask.shape[0] and 0 <= v < mask.shape[1]:
                total += 1
                hit += mask[u, v]
        if total:
            best = max(best, hit / total)
    return best
