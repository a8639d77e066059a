"""Points -> occupied lattice cells with counts and sums, in three passes over a coarse table of bricks (8 x 8 x 8 cells)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from topomerge.kernels import morton

TABLE_REACH = 1 << 10  # cells around the median point that `_split` puts into a table, which is then small enough
OFFSET_STEPS = 256  # in which the way through a cell is divided
MAX_TABLE = 1 << 26  # bricks of the dense table; larger extents are sorted instead


@njit(cache=True, parallel=True)
def bounds(points):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Lowest and highest finite coordinates of (N, 3) points and the number of points that are not finite."""
    parts = 16
    low = np.full((parts, 3), np.inf)
    high = np.full((parts, 3), -np.inf)
    bad = np.zeros(parts, np.int64)
    n = len(points)
    for p in prange(parts):
        for i in range(n * p // parts, n * (p + 1) // parts):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
                bad[p] += 1
                continue
            low[p, 0], high[p, 0] = min(low[p, 0], x), max(high[p, 0], x)
            low[p, 1], high[p, 1] = min(low[p, 1], y), max(high[p, 1], y)
            low[p, 2], high[p, 2] = min(low[p, 2], z), max(high[p, 2], z)
    for p in range(1, parts):
        for a in range(3):
            low[0, a], high[0, a] = min(low[0, a], low[p, a]), max(high[0, a], high[p, a])
    return low[0], high[0], bad.sum()


@njit(cache=True, error_model="numpy")
def _cell(points, i, shift, edge):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Is point i finite, and its lattice cell floor((p + shift) / edge)."""
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
        return False, 0, 0, 0
    return (
        True,
        np.int64(np.floor((x + shift[0]) / edge)),
        np.int64(np.floor((y + shift[1]) / edge)),
        np.int64(np.floor((z + shift[2]) / edge)),
    )


@njit(cache=True, error_model="numpy")
def _part(points, i, shift, edge, axis):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Which of the `OFFSET_STEPS` parts of its cell the finite point i lies in, along an axis: exact: a power of 2."""
    return np.int64(np.floor((points[i, axis] + shift[axis]) / edge * OFFSET_STEPS)) & (OFFSET_STEPS - 1)


@njit(cache=True, parallel=True, error_model="numpy")
def to_lattice(points, shift, edge, out, parts):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Lattice cell of each point, and its part of the cell; points that are not finite get the lowest integer."""
    for i in prange(len(points)):
        finite, x, y, z = _cell(points, i, shift, edge)
        if finite:
            out[i, 0], out[i, 1], out[i, 2] = x, y, z
            for k in range(3):
                parts[i, k] = _part(points, i, shift, edge, k)
        else:
            out[i, 0] = out[i, 1] = out[i, 2] = np.iinfo(np.int64).min


@njit(cache=True, parallel=True, error_model="numpy")
def mark(points, shift, edge, base, table):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """First pass: 1 in `table` for each brick that holds a point. Threads may write the same 1 twice."""
    for i in prange(len(points)):
        finite, x, y, z = _cell(points, i, shift, edge)
        if finite:
            table[(x - base[0]) >> 3, (y - base[1]) >> 3, (z - base[2]) >> 3] = 1


@njit(cache=True)
def _code(x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Place of a cell in its brick, in Morton order."""
    x3, y3, z3 = x & 7, y & 7, z & 7
    code = (x3 & 1) | (y3 & 1) << 1 | (z3 & 1) << 2
    code |= (x3 & 2) << 2 | (y3 & 2) << 3 | (z3 & 2) << 4
    return code | (x3 & 4) << 4 | (y3 & 4) << 5 | (z3 & 4) << 6


@njit(cache=True, error_model="numpy")
def count(points, shift, edge, base, table, counts, places):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Second pass: points in each cell of the bricks in use; of each point where in `counts` (flat) it is counted (-1 nowhere),
    with the parts of its cell in the 24 lowest bits."""
    for i in range(len(points)):
        finite, x, y, z = _cell(points, i, shift, edge)
        if finite:
            cx, cy, cz = x - base[0], y - base[1], z - base[2]
            at = (np.int64(table[cx >> 3, cy >> 3, cz >> 3]) << 9) + _code(cx, cy, cz)
            counts[at] += 1
            for k in range(3):
                at = (at << 8) | _part(points, i, shift, edge, k)
            places[i] = at
        else:
            places[i] = -1


@njit(cache=True, error_model="numpy")
def add_parts(places, rows, sums):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Third pass: sums (n, 3) of the parts of their cells that points lie in; rows: number of the cell at each place."""
    for place in places:
        if place >= 0:
            row = rows[place >> 24]
            sums[row, 0] += (place >> 16) & 255
            sums[row, 1] += (place >> 8) & 255
            sums[row, 2] += place & 255


@njit(cache=True)
def _in_either(first, second):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    i = j = number = 0
    while i < len(first) and j < len(second):
        i, j = i + (first[i] <= second[j]), j + (second[j] <= first[i])
        number += 1
    return number + len(first) - i + len(second) - j


@njit(cache=True)
def _unite(codes, counts, sums, others, other_counts, other_sums, out, out_counts, out_sums):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    i = j = 0
    for row in range(len(out)):
        mine = j == len(others) or (i < len(codes) and codes[i] <= others[j])
        both = mine and i < len(codes) and j < len(others) and codes[i] == others[j]
        if mine:
            out[row], out_counts[row] = codes[i], counts[i]
            for k in range(3):
                out_sums[row, k] = sums[i, k]
            i += 1
        if both:
            out_counts[row] += other_counts[j]
            for k in range(3):
                out_sums[row, k] += other_sums[j, k]
            j += 1
        elif not mine:
            out[row], out_counts[row] = others[j], other_counts[j]
            for k in range(3):
                out_sums[row, k] = other_sums[j, k]
            j += 1


Run = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]  # codes (n,) uint64, ascending; counts (n,) and sums (n, 3) int64


def united(first: Run, second: Run) -> Run:
    """Two runs of cells as one: of those in both, counts and sums are added."""
    number = int(_in_either(first[0], second[0]))
    out = np.empty(number, np.uint64), np.empty(number, np.int64), np.empty((number, 3), np.int64)
    _unite(*first, *second, *out)
    return out


Occupied = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]


def occupied(points: NDArray[Any], shift: NDArray[Any], edge: float) -> Occupied:
    """Occupied lattice cells of one chunk of points.

    Args:
        points: (N, 3) float; points that are not finite are left out.
        shift: (3,) float64, added to the points.
        edge: edge length of a cell, m.

    Returns:
        base (3,) int64; cells (n, 3) int64 relative to it, not negative; their counts (n,) int64; (n, 3) int64 sums over their
        points of which of `OFFSET_STEPS` parts of the cell they lie in: whole numbers, so that no order of points matters.
    """
    low, high, _ = bounds(points)
    if not np.isfinite(low).all():
        return np.zeros(3, np.int64), np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros((0, 3), np.int64)
    first = np.floor((low + shift) / edge).astype(np.int64)
    last = np.floor((high + shift) / edge).astype(np.int64)
    base = (first >> 3) << 3
    size = ((last - base) >> 3) + 1
    if float(np.prod(size.astype(np.float64))) > MAX_TABLE:
        return _split(points, shift, edge)
    table = np.zeros(tuple(size), np.int32)
    mark(points, shift, edge, base, table)
    bricks = np.argwhere(table)
    bricks = bricks[np.argsort(morton.encode(bricks), kind="stable")]
    table[tuple(bricks.T)] = np.arange(len(bricks))
    counts = np.zeros(len(bricks) * 512, np.uint32)
    places = np.empty(len(points), np.int64)
    count(points, shift, edge, base, table, counts, places)
    filled = np.flatnonzero(counts)
    cells = (bricks[filled >> 9] << 3) + morton.decode(filled & 511)
    numbers = counts[filled].astype(np.int64)
    counts[filled] = np.arange(len(filled))
    sums = np.zeros((len(filled), 3), np.int64)
    add_parts(places, counts, sums)
    return base, cells, numbers, sums


def _split(points: NDArray[Any], shift: NDArray[Any], edge: float) -> Occupied:
    """`occupied` for an extent too large for a table: a table around the median point, the points far from it sorted."""
    cells, parts = np.empty((len(points), 3), np.int64), np.zeros((len(points), 3), np.uint8)
    to_lattice(points, shift, edge, cells, parts)
    finite = cells[:, 0] != np.iinfo(np.int64).min
    cells, parts = cells[finite], parts[finite]
    middle = np.median(cells[:: max(len(cells) // 100_000, 1)], axis=0).astype(np.int64)
    near = (np.abs(cells - middle) < TABLE_REACH).all(axis=1)
    occupied_cells, row, counts = np.unique(cells[~near], axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(occupied_cells), 3), np.int64)
    np.add.at(sums, row.ravel(), parts[~near])
    if near.any():
        points_near = (cells[near] - middle + (parts[near] + 0.5) / OFFSET_STEPS).astype(np.float32)
        base, inner, inner_counts, inner_sums = occupied(points_near, np.zeros(3), 1.0)
        occupied_cells = np.concatenate([inner + base + middle, occupied_cells])
        counts, sums = np.concatenate([inner_counts, counts]), np.concatenate([inner_sums, sums])
    low = occupied_cells.min(axis=0)
    return low, occupied_cells - low, counts, sums
