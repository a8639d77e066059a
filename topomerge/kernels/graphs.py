"""Compiled loops over sparse matrices and sets: Markov clustering, selected inverse, bit sets."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from topomerge.kernels import compile_ahead, run_in_slices

Ints = NDArray[Any]
LEAST_SETS = 64  # of a slice


@njit(cache=True, nogil=True, error_model="numpy")
def run_mcl_step(indptr, indices, values, inflation, threshold, most):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Expand (M @ M), inflate, and prune below `threshold` and to the `most` largest entries; return also the largest "chaos" of
    a column (its maximum minus its sum of squares: 0 once the column is settled). Columns in CSC form."""
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


@compile_ahead("i4[::1], i4[::1], f8[::1], f8[::1]")
def compute_selected_inverse(indptr, rows, values, diagonal):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Compute the lower half of the inverse of L D L^T on the entries of L; nan at its first entry if those do not close under
    elimination.

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


@intrinsic
def count_bits(typingctx, value):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Count the ones in a uint64: the processor has an instruction for it."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.ctpop(args[0])

    return types.uint64(types.uint64), codegen


def count_intersections(indptr: Ints, words: Ints, masks: Ints, first: Ints, second: Ints) -> Ints:
    """Return the (p,) size of the intersection of sets first[k] and second[k]."""
    out = np.zeros(len(first), np.int64)
    run_in_slices(_count_intersections, len(first), LEAST_SETS, indptr, words, masks, first, second, out)
    return out


@njit(cache=True, nogil=True)
def _count_intersections(begin, end, indptr, words, masks, first, second, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    for k in range(begin, end):
        i, i_end = indptr[first[k]], indptr[first[k] + 1]
        j, j_end = indptr[second[k]], indptr[second[k] + 1]
        total = np.uint64(0)
        while i < i_end and j < j_end:
            a, b = words[i], words[j]
            if a == b:
                total += count_bits(masks[i] & masks[j])
            i += a <= b
            j += b <= a
        out[k] = total


def compute_extents(indptr: Ints, words: Ints, masks: Ints, values: Ints) -> Ints:
    """Return the (s, 2) smallest and largest of the rows' values in each set; (largest, smallest) integers for an empty one."""
    out = np.empty((len(indptr) - 1, 2), np.int64)
    run_in_slices(_compute_extents, len(out), LEAST_SETS, indptr, words, masks, values, out)
    return out


@njit(cache=True, nogil=True)
def _compute_extents(first, last, indptr, words, masks, values, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    for s in range(first, last):
        low, high = np.iinfo(np.int64).max, np.iinfo(np.int64).min
        for k in range(indptr[s], indptr[s + 1]):
            mask, base = masks[k], np.int64(words[k]) << 6
            while mask != 0:
                lowest = mask & (~mask + np.uint64(1))
                value = np.int64(values[base + np.int64(count_bits(lowest - np.uint64(1)))])
                mask ^= lowest
                low, high = min(low, value), max(high, value)
        out[s, 0], out[s, 1] = low, high


@njit(cache=True)
def find_most_voted(indptr, words, masks, order, cluster, winner):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Find for each row the cluster with the most sets that hold it, in place; ties go to the smaller cluster number.

    `order` lists the sets cluster by cluster, in ascending order of `cluster`.
    """
    votes = np.zeros(len(winner), np.int32)
    best = np.zeros(len(winner), np.int32)
    begin = 0
    while begin < len(order):
        label = cluster[order[begin]]
        end = begin
        while end < len(order) and cluster[order[end]] == label:
            end += 1
        for count in (True, False):  # count the votes of this cluster, then compare and clear them
            for s in range(begin, end):
                for k in range(indptr[order[s]], indptr[order[s] + 1]):
                    mask, base = masks[k], np.int64(words[k]) << 6
                    while mask != 0:
                        lowest = mask & (~mask + np.uint64(1))
                        row = base + np.int64(count_bits(lowest - np.uint64(1)))
                        mask ^= lowest
                        if count:
                            votes[row] += 1
                        else:
                            if votes[row] > best[row]:
                                best[row], winner[row] = votes[row], label
                            votes[row] = 0
        begin = end
