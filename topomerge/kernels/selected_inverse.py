"""Entries of the inverse of a sparse symmetric matrix, where its factor has some (`fusion.bend.graph`; Takahashi et al. 1973)."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def inverse_on_factor(indptr, rows, values, diagonal):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Lower half of the inverse of L D L^T on the entries of L; nan at its first entry if those do not close under elimination.

    Args:
        indptr, rows, values: L by columns, rows rising, the ones on its diagonal first.
        diagonal: (n,) of D.
    """
    n = len(indptr) - 1
    out = np.zeros(len(values))
    place = np.full(n, -1, np.int64)  # of a row among those of the column in hand
    for column in range(n - 1, -1, -1):
        first, last = indptr[column] + 1, indptr[column + 1]
        for k in range(first, last):
            place[rows[k]] = k
        for k in range(first, last):
            other, met = rows[k], 0
            for e in range(indptr[other], indptr[other + 1]):
                at = place[rows[e]]
                if at >= 0:
                    met += 1
                    out[at] -= out[e] * values[k]
                    if rows[e] != other:
                        out[k] -= out[e] * values[at]
            if met != last - k:
                out[0] = np.nan
                return out
        out[first - 1] = 1.0 / diagonal[column]
        for k in range(first, last):
            out[first - 1] -= values[k] * out[k]
            place[rows[k]] = -1
    return out
