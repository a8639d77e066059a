"""Moving a stencil over cells: compiled loops behind `extraction.convolution`.

A stencil that only asks "is there a cell?" reads occupancy bits, eight cells of a column at a time: a body of 1.75 m is
then three reads a column and not 18. What needs the rows themselves goes through the brick lookup.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, uint64
from numpy.typing import NDArray

from topomerge.kernels import compile_ahead, run_in_slices
from topomerge.kernels.voxels import find_row

LEAST_CELLS = 2048  # of a slice
Arrays2 = tuple[NDArray[Any], NDArray[Any]]  # table and bricks of `voxels.build`; offsets and weights of a stencil
_ONES = np.array([bin(i).count("1") for i in range(256)], np.int64)


@compile_ahead("i4[:,::1], i4[:,:,::1], u1[:,::1]")
def _fill_columns(cells, table, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    for i in range(len(cells)):
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        out[table[x >> 3, y >> 3, z >> 3], ((x & 7) << 3) | (y & 7)] |= np.uint8(1 << (z & 7))


def build_columns(cells: NDArray[Any], table: NDArray[Any], bricks: NDArray[Any]) -> NDArray[np.uint8]:
    """Return (bricks, 64) uint8: bit z of column 8 x + y is set where cell (x, y, z) of the brick is occupied."""
    out = np.zeros((len(bricks), 64), np.uint8)
    _fill_columns(cells, table, out)
    return out


@compile_ahead("i4[:,:,::1], u1[:,::1], i8, i8, i8, i8", error_model="numpy")
def _count_in_column(table, bits, x, y, low, high):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Count the occupied cells (x, y, low .. high)."""
    low, high = max(low, 0), min(high, table.shape[2] * 8 - 1)
    if x < 0 or y < 0 or (x >> 3) >= table.shape[0] or (y >> 3) >= table.shape[1] or low > high:
        return 0
    count, column = 0, ((x & 7) << 3) | (y & 7)
    for bz in range(low >> 3, (high >> 3) + 1):
        brick = table[x >> 3, y >> 3, bz]
        if brick < 0:
            continue
        mask = 255
        if bz == low >> 3:
            mask &= 255 << (low & 7)
        if bz == high >> 3:
            mask &= 255 >> (7 - (high & 7))
        count += _ONES[bits[brick, column] & mask]
    return count


@compile_ahead("i8, i8, i4[:,:,::1], u1[:,::1], i8[:,::1], i8[:,::1], f8[::1], b1, f8[::1]", error_model="numpy")
def _count(first, last, table, bits, cells, runs, weights, stop, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Count the cells under runs; with `stop` a count ends with the first run that holds a cell."""
    for i in range(first, last):
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        total = 0.0
        for j in range(len(runs)):
            low, high = z + runs[j, 2], z + runs[j, 3]
            total += weights[j] * _count_in_column(table, bits, x + runs[j, 0], y + runs[j, 1], low, high)
            if stop and total > 0:
                break
        out[i] = total


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(first, last, table, bricks, cells, offsets, weights, values, largest, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(first, last):
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        out[i] = -np.inf if largest else 0.0
        for j in range(len(offsets)):
            r = find_row(table, bricks, x + offsets[j, 0], y + offsets[j, 1], z + offsets[j, 2])
            if r < 0:
                continue
            for c in range(values.shape[1]):
                value = weights[j] * values[r, c]
                if not largest:
                    out[i, c] += value
                elif value > out[i, c]:
                    out[i, c] = value


@njit(cache=True, error_model="numpy")
def _find_winner(voted, votes, count, present):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the label with most votes: of several `own`, else the smallest; -1 where nobody voted."""
    best, most = -1, 0.0
    for k in range(count):
        if votes[k] > most or (votes[k] == most and best != present and (voted[k] == present or voted[k] < best)):
            best, most = voted[k], votes[k]
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def _vote(first, last, table, bricks, cells, offsets, weights, labels, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    voted = np.empty(len(offsets), np.int64)  # labels met, in order of appearance: mostly one or two
    votes = np.empty(len(offsets), np.float64)
    for i in range(first, last):
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        count = 0
        for j in range(len(offsets)):
            r = find_row(table, bricks, x + offsets[j, 0], y + offsets[j, 1], z + offsets[j, 2])
            if r < 0 or labels[r] < 0:
                continue
            k = 0
            while k < count and voted[k] != labels[r]:
                k += 1
            if k == count:
                voted[k], votes[k] = labels[r], 0.0
                count += 1
            votes[k] += weights[j]
        out[i] = _find_winner(voted, votes, count, labels[i])


def count(
    table: NDArray[Any], bits: NDArray[Any], cells: NDArray[Any], runs: NDArray[Any], weights: NDArray[Any]
) -> NDArray[np.float64]:
    """Return the (m,) weighted number of cells under runs (dx, dy, lowest, highest dz) placed at each of (m, 3) int64 cells."""
    out = np.empty(len(cells), np.float64)
    run_in_slices(_count, len(cells), LEAST_CELLS, table, bits, cells, runs, weights, False, out)
    return out


def is_any_occupied(table: NDArray[Any], bits: NDArray[Any], cells: NDArray[Any], runs: NDArray[Any]) -> NDArray[np.bool_]:
    """Return (m,) whether any cell under the runs placed at each of (m, 3) int64 cells is occupied."""
    out = np.empty(len(cells), np.float64)
    run_in_slices(_count, len(cells), LEAST_CELLS, table, bits, cells, runs, np.ones(len(runs)), True, out)
    return out > 0


def weigh(bricks: Arrays2, cells: NDArray[Any], stencil: Arrays2, values: NDArray[Any], largest: bool) -> NDArray[np.float64]:
    """Return the (n, c) sum, or `largest`, of weight * value over the cells under (k, 3) int64 offsets; values (n, c) float64."""
    out = np.empty(values.shape, np.float64)
    run_in_slices(_weigh, len(cells), LEAST_CELLS, *bricks, cells, *stencil, values, largest, out)
    return out


def vote(bricks: Arrays2, cells: NDArray[Any], stencil: Arrays2, labels: NDArray[Any]) -> NDArray[np.int64]:
    """Return (n,) most voted of the (n,) int64 labels under the stencil; negative labels do not vote."""
    out = np.empty(len(cells), np.int64)
    run_in_slices(_vote, len(cells), LEAST_CELLS, *bricks, cells, *stencil, labels, out)
    return out


# One pass through a hash table: sorting 300,000 points into cubes took 2.6 times as long (docs/adr/0044).
CUBE_LIMIT = 1 << 20  # cubes to each side of the origin that have codes
HASH_MULTIPLIER, HASH_SHIFT = uint64(0x9E3779B97F4A7C15), uint64(32)  # Knuth's
MOMENTS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # pairs of axes


@compile_ahead("f8[:,::1], f8, i4[::1], i8[::1], f8[:,::1]", error_model="numpy")
def _sum_in_cubes(points, edge, slots, codes, sums):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    last, count = uint64(len(slots) - 1), 0
    for i in range(len(points)):
        cx, cy, cz = np.floor(points[i, 0] / edge), np.floor(points[i, 1] / edge), np.floor(points[i, 2] / edge)
        if not (abs(cx) < CUBE_LIMIT and abs(cy) < CUBE_LIMIT and abs(cz) < CUBE_LIMIT):
            continue
        code = (np.int64(cx) + CUBE_LIMIT) << 42 | (np.int64(cy) + CUBE_LIMIT) << 21 | (np.int64(cz) + CUBE_LIMIT)
        at = ((uint64(code) * HASH_MULTIPLIER) >> HASH_SHIFT) & last
        while slots[at] >= 0 and codes[slots[at]] != code:
            at = (at + uint64(1)) & last
        row = slots[at]
        if row < 0:
            row = slots[at] = count
            codes[row] = code
            for k in range(10):
                sums[row, k] = 0.0
            count += 1
        x, y, z = points[i, 0] - (cx + 0.5) * edge, points[i, 1] - (cy + 0.5) * edge, points[i, 2] - (cz + 0.5) * edge
        sums[row, 0] += 1.0
        sums[row, 1] += x
        sums[row, 2] += y
        sums[row, 3] += z
        sums[row, 4] += x * x
        sums[row, 5] += x * y
        sums[row, 6] += x * z
        sums[row, 7] += y * y
        sums[row, 8] += y * z
        sums[row, 9] += z * z
    return count


def sum_in_cubes(points: NDArray[np.float64], edge: float) -> NDArray[np.float64]:
    """Return (n, 10) of each cube of space that holds points (N, 3), by place: their number, the sums of their places from its
    middle, and those of the products of `MOMENTS`. Points farther than a million cubes from the origin are left out."""
    slots = np.full(1 << max(2 * len(points) - 1, 1).bit_length(), -1, np.int32)
    codes, sums = np.empty(len(points), np.int64), np.empty((len(points), 10))
    count = int(_sum_in_cubes(np.ascontiguousarray(points, np.float64), edge, slots, codes, sums))
    return sums[:count][np.argsort(codes[:count])]
