"""One step of the Markov cluster algorithm on a sparse column-stochastic matrix."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def step(indptr, indices, values, inflation, threshold, most):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Expansion (M @ M), inflation, pruning below `threshold` and to the `most` largest entries; also the largest "chaos" of a
    column (its maximum minus its sum of squares: 0 once the column is settled). Columns in CSC form."""
    n = len(indptr) - 1
    counts = np.zeros(n, np.int64)
    rows = np.zeros((n, most), np.int32)
    cells = np.zeros((n, most))
    chaos = 0.0
    total = np.zeros(n)
    touched = np.empty(n, np.int32)
    met = np.full(n, -1, np.int64)  # the last column in which a row was met
    for j in range(n):
        m = 0
        for a in range(indptr[j], indptr[j + 1]):
            k, w = indices[a], values[a]
            for b in range(indptr[k], indptr[k + 1]):
                i = indices[b]
                if met[i] != j:
                    met[i] = j
                    touched[m] = i
                    m += 1
                total[i] += w * values[b]
        mass, highest, entries = 0.0, 0.0, 0
        for t in range(m):
            mass += total[touched[t]] ** inflation
        cut = threshold
        for t in range(m):
            i = touched[t]
            total[i] = total[i] ** inflation / mass
            highest = max(highest, total[i])
            entries += total[i] >= threshold
        if entries > most:
            ordered = np.sort(total[touched[:m]])
            cut = max(threshold, ordered[m - most])
        cut = min(cut, highest)  # a column never loses its largest entry
        mass, entries = 0.0, 0
        ascending = np.sort(touched[:m])
        for t in range(m):
            i = ascending[t]
            if total[i] >= cut and entries < most:
                rows[j, entries], cells[j, entries] = i, total[i]
                mass += total[i]
                entries += 1
            total[i] = 0.0
        squares, top = 0.0, 0.0
        for t in range(entries):
            cells[j, t] /= mass
            squares += cells[j, t] ** 2
            top = max(top, cells[j, t])
        chaos = max(chaos, top - squares)
        counts[j] = entries
    out = np.zeros(n + 1, np.int64)
    for j in range(n):
        out[j + 1] = out[j] + counts[j]
    new_indices, new_values = np.empty(out[n], np.int32), np.empty(out[n])
    for j in range(n):
        for t in range(counts[j]):
            new_indices[out[j] + t], new_values[out[j] + t] = rows[j, t], cells[j, t]
    return out, new_indices, new_values, chaos
