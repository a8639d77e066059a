"""Small symmetric matrices: systems of a few unknowns and axes of a few points. `np.linalg` gives the same in compiled code, but
takes seconds to compile, which whoever runs the program for the first time waits for."""

from __future__ import annotations

import numpy as np
from numba import njit

SWEEPS = 16  # of rotations at most; five are enough for double precision


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


@njit(cache=True, nogil=True, error_model="numpy")
def axes(square):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(3,) eigenvalues of a symmetric (3, 3) matrix, rising, and (3, 3) their vectors as columns: by Jacobi's rotations."""
    m, v = square.copy(), np.eye(3)
    for _ in range(SWEEPS):
        beside = m[0, 1] ** 2 + m[0, 2] ** 2 + m[1, 2] ** 2
        if beside <= 1e-32 * (m[0, 0] ** 2 + m[1, 1] ** 2 + m[2, 2] ** 2):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if m[p, q] == 0.0:
                    continue
                half = (m[q, q] - m[p, p]) / (2.0 * m[p, q])
                t = 1.0 / (abs(half) + np.sqrt(half * half + 1.0))
                if half < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    m[k, p], m[k, q] = c * m[k, p] - s * m[k, q], s * m[k, p] + c * m[k, q]
                for k in range(3):
                    m[p, k], m[q, k] = c * m[p, k] - s * m[q, k], s * m[p, k] + c * m[q, k]
                for k in range(3):
                    v[k, p], v[k, q] = c * v[k, p] - s * v[k, q], s * v[k, p] + c * v[k, q]
    values = np.array([m[0, 0], m[1, 1], m[2, 2]])
    for a in range(2):  # few enough to be sorted by hand
        for b in range(2 - a):
            if values[b] > values[b + 1]:
                values[b], values[b + 1] = values[b + 1], values[b]
                for k in range(3):
                    v[k, b], v[k, b + 1] = v[k, b + 1], v[k, b]
    return values, v
