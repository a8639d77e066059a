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
def on_lines(mask, cosines, sines, long, least):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(H, W) bool: the columns of a mask in, or at an end of, a straight run of `long` columns of which `least` are in it."""
    out = np.zeros(mask.shape, np.bool_)
    for x in range(mask.shape[0]):
        for y in range(mask.shape[1]):
            if not mask[x, y]:
                continue
            for k in range(len(cosines)):
                far = np.zeros(2, np.int64)  # hits ahead and behind, over the whole length
                near = 0  # and over half of it both ways
                for d in range(1, long):
                    for side in range(2):
                        s = d if side == 0 else -d
                        u, v = x + int(np.rint(s * cosines[k])), y + int(np.rint(s * sines[k]))
                        if u >= 0 and v >= 0 and u < mask.shape[0] and v < mask.shape[1] and mask[u, v]:
                            far[side] += 1
                            near += d <= long // 2
                if 1 + max(far[0], far[1], near) >= least:
                    out[x, y] = True
                    break
    return out
