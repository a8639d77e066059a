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
        if x < 0 or y < 0 or x >= base.shape[0] or y >= base.shape[1]:
            continue
        k = int(np.floor((z[i] - base[x, y] - low) / band))
        if 0 <= k < 32:
            out[x, y] |= np.uint32(1) << np.uint32(k)
    return out
