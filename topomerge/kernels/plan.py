"""What stands in each column of a map: a bit for each band of heights."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def column_bits(ix, iy, z, base, low, band):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(H, W) uint32: bit k is set where a cell lies between low + k * band and low + (k + 1) * band above `base` (H, W)."""
    out = np.zeros(base.shape, np.uint32)
    for i in range(len(z)):
        x, y = ix[i], iy[i]
        if np.isnan(z[i]) or x < 0 or y < 0 or x >= base.shape[0] or y >= base.shape[1]:
            continue
        k = int(np.floor((z[i] - base[x, y] - low) / band))
        if 0 <= k < 32:
            out[x, y] |= np.uint32(1) << np.uint32(k)
    return out


@njit(cache=True, nogil=True)
def on_lines(mask, cosines, sines, long, least, beside):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(H, W) bool: the columns of a mask in, or at an end of, a straight run of `long` columns of which `least` are in it, with a
    parallel run, `beside` columns away to the left or to the right, of which a fifth at most is in it."""
    out = np.zeros(mask.shape, np.bool_)
    height, width = mask.shape
    for x in range(height):
        for y in range(width):
            if not mask[x, y]:
                continue
            for k in range(len(cosines)):
                ahead, behind, near = 0, 0, 0  # hits over the whole length ahead, behind, and over half of it both ways
                for d in range(1, long):
                    u, v = x + int(np.rint(d * cosines[k])), y + int(np.rint(d * sines[k]))
                    if u >= 0 and v >= 0 and u < height and v < width and mask[u, v]:
                        ahead += 1
                        near += d <= long // 2
                    u, v = x - int(np.rint(d * cosines[k])), y - int(np.rint(d * sines[k]))
                    if u >= 0 and v >= 0 and u < height and v < width and mask[u, v]:
                        behind += 1
                        near += d <= long // 2
                if 1 + max(ahead, behind, near) < least:
                    continue
                first, last = -(long // 2), long // 2 + 1
                if 1 + ahead >= least:
                    first, last = 0, long
                elif 1 + behind >= least:
                    first, last = 1 - long, 1
                for side in (-beside, beside):
                    hits = 0
                    for d in range(first, last):
                        u = x + int(np.rint(d * cosines[k] - side * sines[k]))
                        v = y + int(np.rint(d * sines[k] + side * cosines[k]))
                        hits += u >= 0 and v >= 0 and u < height and v < width and mask[u, v]
                    if 5 * hits <= last - first:
                        out[x, y] = True
                if out[x, y]:
                    break
    return out
