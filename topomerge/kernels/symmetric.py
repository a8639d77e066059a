"""Small symmetric systems. `np.linalg` gives the same in compiled code, but takes seconds to compile, for which whoever runs the
program for the first time waits."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def solved(h, g, count):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(F,) x of H x = g in the first `count` of F unknowns, 0 in the others: by Cholesky's factor.

    Args:
        h: (F, F) positive definite; only its upper half is read.
        g: (F,).
    """
    low, x = np.zeros((len(g), len(g))), np.zeros(len(g))
    for a in range(count):
        for b in range(a + 1):
            left = h[b, a]
            for k in range(b):
                left -= low[a, k] * low[b, k]
            low[a, b] = np.sqrt(left) if a == b else left / low[b, b]
    for a in range(count):
        left = g[a]
        for k in range(a):
            left -= low[a, k] * x[k]
        x[a] = left / low[a, a]
    for a in range(count - 1, -1, -1):
        left = x[a]
        for k in range(a + 1, count):
            left -= low[k, a] * x[k]
        x[a] = left / low[a, a]
    return x
