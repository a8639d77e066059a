"""Sets of rows kept as words of 64 bits: intersections and votes (behind `extraction.similarity` and `extraction.votes`)."""

from __future__ import annotations

import numpy as np
from numba import njit, prange, types
from numba.extending import intrinsic


@intrinsic
def popcount(typingctx, value):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Number of ones in a uint64: the processor has an instruction for it."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.ctpop(args[0])

    return types.uint64(types.uint64), codegen


@njit(cache=True, parallel=True)
def intersections(indptr, words, masks, first, second):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(p,) size of the intersection of sets first[k] and second[k]."""
    out = np.zeros(len(first), np.int64)
    for k in prange(len(first)):
        i, i_end = indptr[first[k]], indptr[first[k] + 1]
        j, j_end = indptr[second[k]], indptr[second[k] + 1]
        total = np.uint64(0)
        while i < i_end and j < j_end:
            a, b = words[i], words[j]
            if a == b:
                total += popcount(masks[i] & masks[j])
            i += a <= b
            j += b <= a
        out[k] = total
    return out


@njit(cache=True, parallel=True)
def extents(indptr, words, masks, values):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(s, 2) smallest and largest of the rows' values in each set; (largest, smallest) integers for an empty one."""
    out = np.empty((len(indptr) - 1, 2), np.int64)
    for s in prange(len(indptr) - 1):
        low, high = np.iinfo(np.int64).max, np.iinfo(np.int64).min
        for k in range(indptr[s], indptr[s + 1]):
            mask, base = masks[k], np.int64(words[k]) << 6
            while mask != 0:
                lowest = mask & (~mask + np.uint64(1))
                value = np.int64(values[base + np.int64(popcount(lowest - np.uint64(1)))])
                mask ^= lowest
                low, high = min(low, value), max(high, value)
        out[s, 0], out[s, 1] = low, high
    return out


@njit(cache=True)
def most_votes(indptr, words, masks, order, cluster, winner):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """For each row the cluster with the most sets that hold it, in place; ties go to the smaller cluster number.

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
                        row = base + np.int64(popcount(lowest - np.uint64(1)))
                        mask ^= lowest
                        if count:
                            votes[row] += 1
                        else:
                            if votes[row] > best[row]:
                                best[row], winner[row] = votes[row], label
                            votes[row] = 0
        begin = end
