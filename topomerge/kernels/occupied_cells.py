"""Compiled loops that lay points into cells: each chunk of points is counted in a table of bricks of 8 x 8 x 8 cells."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, uint64
from numpy.typing import NDArray

from topomerge.kernels import compile_ahead, run_in_slices
from topomerge.kernels.voxels import AXIS_LIMIT, decode, encode

TABLE_REACH = 1 << 10  # cells around the median point that `_split` puts into a table, which is then small enough
OFFSET_STEPS = 256  # in which the way through a cell is divided
LEAST_POINTS = 1 << 16  # of a slice of a chunk
SLAB = 1 << 20  # points that are sorted at a time
BIN_BITS = 10  # bins of cells: 1024, each of which fits into the second-level cache
LEAST_BINS = 64  # of a slice
MAX_TABLE = 1 << 26  # bricks of the dense table; larger extents are sorted instead


@compile_ahead("i8, i8, f4[:,::1], f8[::1], f8[::1]")
def _compute_bounds(first, last, points, low, high):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    bad = 0
    for i in range(first, last):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
            bad += 1
            continue
        for k in range(3):
            low[k], high[k] = min(low[k], points[i, k]), max(high[k], points[i, k])
    return bad


def compute_bounds(points: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Return the lowest and highest finite coordinates of (N, 3) points and the number of points that are not finite."""

    def compute(first: int, last: int) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        return low, high, int(_compute_bounds(first, last, points, low, high))

    lows, highs, bad = zip(*run_in_slices(compute, len(points), LEAST_POINTS), strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0), sum(bad)


@compile_ahead("f4[:,::1], i8, f8[::1], f8", error_model="numpy")
def _locate_cell(points, i, shift, edge):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return whether point i is finite, and its lattice cell floor((p + shift) / edge)."""
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
        return False, 0, 0, 0
    return (
        True,
        np.int64(np.floor((x + shift[0]) / edge)),
        np.int64(np.floor((y + shift[1]) / edge)),
        np.int64(np.floor((z + shift[2]) / edge)),
    )


@njit(cache=True, inline="always")
def _find_part(place):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return which of the `OFFSET_STEPS` parts of its cell a place, in cells, lies in: exact: a power of 2."""
    return np.int64(np.floor(place * OFFSET_STEPS)) & (OFFSET_STEPS - 1)


@njit(cache=True, nogil=True, error_model="numpy")
def convert_to_lattice(points, shift, edge, out, parts):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the lattice cell of each point, and its part of the cell; points that are not finite get the lowest integer."""
    for i in range(len(points)):
        finite, x, y, z = _locate_cell(points, i, shift, edge)
        if finite:
            out[i, 0], out[i, 1], out[i, 2] = x, y, z
            for k in range(3):
                parts[i, k] = _find_part((points[i, k] + shift[k]) / edge)
        else:
            out[i, 0] = out[i, 1] = out[i, 2] = np.iinfo(np.int64).min


@compile_ahead("i8, i8, f4[:,::1], f8[::1], f8, i8[::1], i4[:,:,::1]", error_model="numpy")
def mark(first, last, points, shift, edge, base, table):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Set, in a first pass, 1 in `table` for each brick that holds a point. Threads may write the same 1 twice."""
    for i in range(first, last):
        finite, x, y, z = _locate_cell(points, i, shift, edge)
        if finite:
            table[(x - base[0]) >> 3, (y - base[1]) >> 3, (z - base[2]) >> 3] = 1


@njit(cache=True, inline="always")
def _encode_place(x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the place of a cell in its brick, in Morton order."""
    x3, y3, z3 = x & 7, y & 7, z & 7
    code = (x3 & 1) | (y3 & 1) << 1 | (z3 & 1) << 2
    code |= (x3 & 2) << 2 | (y3 & 2) << 3 | (z3 & 2) << 4
    return code | (x3 & 4) << 4 | (y3 & 4) << 5 | (z3 & 4) << 6


@compile_ahead("i8, i8, f4[:,::1], f8[::1], f8, i8[::1], i4[:,:,::1], i8, i8[::1], i8[:,::1]", error_model="numpy")
def sort_places(first, last, points, shift, edge, base, table, bits, places, starts):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Write, in a second pass, of slabs of `SLAB` points, the place of each point's cell in the bricks in use, with the parts of
    its cell in the 24 lowest bits, in order of bins of ``2**bits`` places; and the starts (slabs, bins + 1) of the bins in
    `places`."""
    buffer = np.empty(min(SLAB, len(points)), np.int64)
    ends = np.empty(starts.shape[1], np.int64)
    for slab in range(first, last):
        start, stop = slab * SLAB, min((slab + 1) * SLAB, len(points))
        ends[:] = 0
        for i in range(start, stop):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            at = -1
            if np.isfinite(x) and np.isfinite(y) and np.isfinite(z):
                u, v, w = (x + shift[0]) / edge, (y + shift[1]) / edge, (z + shift[2]) / edge
                cx, cy, cz = np.int64(np.floor(u)) - base[0], np.int64(np.floor(v)) - base[1], np.int64(np.floor(w)) - base[2]
                at = (np.int64(table[cx >> 3, cy >> 3, cz >> 3]) << 9) + _encode_place(cx, cy, cz)
                ends[at >> bits] += 1
                at = (at << 8) | _find_part(u)
                at = (at << 8) | _find_part(v)
                at = (at << 8) | _find_part(w)
            buffer[i - start] = at
        begin = start
        for k in range(len(ends)):
            starts[slab, k] = begin
            begin += ends[k]
            ends[k] = starts[slab, k]
        for i in range(stop - start):
            at = buffer[i]
            if at >= 0:
                k = at >> (24 + bits)
                places[ends[k]] = at
                ends[k] += 1


@compile_ahead("i8, i8, i8, i8[::1], i8[:,::1], u4[::1], i8[::1]")
def count_cells(first, last, bits, places, starts, counts, occupied):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Count, in a third pass, of bins, the points in each cell, and how many cells of the bin are occupied."""
    for k in range(first, last):
        for slab in range(len(starts)):
            for i in range(starts[slab, k], starts[slab, k + 1]):
                counts[places[i] >> 24] += 1
        for cell in range(k << bits, min((k + 1) << bits, len(counts))):
            occupied[k] += counts[cell] > 0


@compile_ahead("i8, i8, i8, i8[::1], i8[:,::1], u4[::1], i8[::1], i8[::1], i8[::1], i8[:,::1]")
def add_parts(first, last, bits, places, starts, counts, rows, cells, numbers, sums):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Write, in a fourth pass, of bins, whose first cell has the row `rows[bin]`, of each occupied cell its place, its points and
    the sums (n, 3) of the parts of the cell that they lie in, or (n, 6): with how many of them are odd."""
    odd = sums.shape[1] == 6
    for k in range(first, last):
        row = rows[k]
        for cell in range(k << bits, min((k + 1) << bits, len(counts))):
            if counts[cell] > 0:
                cells[row], numbers[row] = cell, counts[cell]
                counts[cell] = row  # where its points are added
                row += 1
        for slab in range(len(starts)):
            for i in range(starts[slab, k], starts[slab, k + 1]):
                place = places[i]
                row = np.int64(counts[place >> 24])
                x, y, z = (place >> 16) & 255, (place >> 8) & 255, place & 255
                sums[row, 0] += x
                sums[row, 1] += y
                sums[row, 2] += z
                if odd:
                    sums[row, 3] += x & 1
                    sums[row, 4] += y & 1
                    sums[row, 5] += z & 1


@compile_ahead("u8[::1], i8[::1], i8[:,::1], u8[::1], i8[::1], i8[:,::1]")
def _double(codes, counts, sums, out, out_counts, out_sums):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    row = -1
    for i in range(len(codes)):
        code = codes[i] >> uint64(3)
        if row < 0 or out[row] != code:
            row += 1
            out[row], out_counts[row] = code, 0
            out_sums[row, 0] = out_sums[row, 1] = out_sums[row, 2] = 0
        out_counts[row] += counts[i]
        for k in range(3):
            upper = np.int64((codes[i] >> uint64(k)) & uint64(1))
            out_sums[row, k] += (sums[i, k] - sums[i, 3 + k]) // 2 + upper * counts[i] * (OFFSET_STEPS // 2)
    return row + 1


@compile_ahead("u8[::1], u8[::1]")
def _count_in_either(first, second):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    i = j = number = 0
    while i < len(first) and j < len(second):
        i, j = i + (first[i] <= second[j]), j + (second[j] <= first[i])
        number += 1
    return number + len(first) - i + len(second) - j


@compile_ahead("u8[::1], i8[::1], i8[:,::1], u8[::1], i8[::1], i8[:,::1], u8[::1], i8[::1], i8[:,::1]")
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


def unite_runs(first: Run, second: Run) -> Run:
    """Return two runs of cells as one: of those in both, counts and sums are added."""
    number = int(_count_in_either(first[0], second[0]))
    out = np.empty(number, np.uint64), np.empty(number, np.int64), np.empty((number, 3), np.int64)
    _unite(*first, *second, *out)
    return out


def double_cells(run: Run) -> Run:
    """Return the run of cells twice as long, to the bit that of their points: half a part of a cell is a whole one of its half.

    Args:
        run: about an even origin; sums (n, 6), with how many parts are odd.
    """
    out = np.empty(len(run[0]), np.uint64), np.empty(len(run[0]), np.int64), np.empty((len(run[0]), 3), np.int64)
    count = int(_double(*run, *out))
    return out[0][:count], out[1][:count], out[2][:count]


Occupied = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]


def find_occupied_codes(
    points: NDArray[Any], shift: NDArray[Any], edge: float, origin: NDArray[np.int64], odd: bool = False
) -> Run | None:
    """Return the occupied lattice cells of one chunk of points, by Morton codes; None where these do not reach, or the extent is
    too large.

    Args:
        points, shift, edge: as of `find_occupied_cells`.
        origin: (3,) cell that codes are about, multiples of 8.
        odd: count odd parts, too: sums are (n, 6).
    """
    base, size = _find_brick_box(points, shift, edge)
    first = (base - origin) >> 3
    fits = float(np.prod(size.astype(np.float64))) <= MAX_TABLE
    if not fits or (first < 0).any() or (first + size > AXIS_LIMIT >> 3).any():
        return None
    _, codes, filled, counts, sums = _count_in_bricks(points, shift, edge, base, size, first, 6 if odd else 3)
    return (codes[filled >> 9] << np.uint64(9)) | (filled & 511).astype(np.uint64), counts, sums


def find_occupied_cells(points: NDArray[Any], shift: NDArray[Any], edge: float) -> Occupied:
    """Return the occupied lattice cells of one chunk of points.

    Args:
        points: (N, 3) float; points that are not finite are left out.
        shift: (3,) float64, added to the points.
        edge: edge length of a cell, m.

    Returns:
        base (3,) int64; cells (n, 3) int64 relative to it, not negative; their counts (n,) int64; (n, 3) int64 sums over their
        points of which of `OFFSET_STEPS` parts of the cell they lie in: whole numbers, so that no order of points matters.
    """
    base, size = _find_brick_box(points, shift, edge)
    if float(np.prod(size.astype(np.float64))) > MAX_TABLE:
        return _split(points, shift, edge)
    bricks, _, filled, counts, sums = _count_in_bricks(points, shift, edge, base, size, np.zeros(3, np.int64), 3)
    return base, (bricks[filled >> 9] << 3) + decode(filled & 511), counts, sums


def _find_brick_box(points: NDArray[Any], shift: NDArray[Any], edge: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the lowest cell of the bricks that hold all finite points, and how many bricks lie along each axis."""
    low, high, _ = compute_bounds(points)
    if not np.isfinite(low).all():
        return np.zeros(3, np.int64), np.zeros(3, np.int64)
    first = np.floor((low + shift) / edge).astype(np.int64)
    last = np.floor((high + shift) / edge).astype(np.int64)
    base = (first >> 3) << 3
    return base, ((last - base) >> 3) + 1


def _count_in_bricks(
    points: NDArray[Any],
    shift: NDArray[Any],
    edge: float,
    base: NDArray[np.int64],
    size: NDArray[np.int64],
    first: NDArray[np.int64],
    columns: int,
) -> tuple[NDArray[np.int64], NDArray[np.uint64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the bricks (b, 3) that hold points, by their Morton codes (b,) about a brick `first` steps before; places (n,) in
    them of their occupied cells, in Morton order; of these the counts (n,) and sums (n, columns)."""
    table = np.zeros(tuple(size), np.int32)
    if not table.size:
        none = np.zeros(0, np.int64)
        return np.zeros((0, 3), np.int64), none.astype(np.uint64), none, none, np.zeros((0, columns), np.int64)
    run_in_slices(mark, len(points), LEAST_POINTS, points, shift, edge, base, table)
    bricks = np.argwhere(table)
    # About the lattice's origin: so cells come in the order of their codes, without a sort of their own (docs/adr/0044).
    codes = encode(bricks + first)
    order = np.argsort(codes, kind="stable")
    bricks, codes = bricks[order], codes[order]
    table[tuple(bricks.T)] = np.arange(len(bricks))
    # Points in any order miss the caches at every cell; sorted into bins that fit there, they take a quarter of the time.
    counts = np.zeros(len(bricks) * 512, np.uint32)
    bits = max((len(counts) - 1).bit_length() - BIN_BITS, 9)
    slabs, bins = -(-len(points) // SLAB), ((len(counts) - 1) >> bits) + 1
    places, starts = np.empty(len(points), np.int64), np.empty((slabs, bins + 1), np.int64)
    run_in_slices(sort_places, slabs, 1, points, shift, edge, base, table, bits, places, starts)
    occupied = np.zeros(bins, np.int64)
    run_in_slices(count_cells, bins, LEAST_BINS, bits, places, starts, counts, occupied)
    rows, total = np.cumsum(occupied) - occupied, int(occupied.sum())
    filled, numbers, sums = np.empty(total, np.int64), np.empty(total, np.int64), np.zeros((total, columns), np.int64)
    run_in_slices(add_parts, bins, LEAST_BINS, bits, places, starts, counts, rows, filled, numbers, sums)
    return bricks, codes, filled, numbers, sums


def _split(points: NDArray[Any], shift: NDArray[Any], edge: float) -> Occupied:
    """Return what `find_occupied_cells` does for an extent too large for a table: a table around the median point, the points far
    from it sorted."""
    cells, parts = np.empty((len(points), 3), np.int64), np.zeros((len(points), 3), np.uint8)
    convert_to_lattice(points, shift, edge, cells, parts)
    finite = cells[:, 0] != np.iinfo(np.int64).min
    cells, parts = cells[finite], parts[finite]
    middle = np.median(cells[:: max(len(cells) // 100_000, 1)], axis=0).astype(np.int64)
    near = (np.abs(cells - middle) < TABLE_REACH).all(axis=1)
    occupied_cells, row, counts = np.unique(cells[~near], axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(occupied_cells), 3), np.int64)
    np.add.at(sums, row.ravel(), parts[~near])
    if near.any():
        points_near = (cells[near] - middle + (parts[near] + 0.5) / OFFSET_STEPS).astype(np.float32)
        base, inner, inner_counts, inner_sums = find_occupied_cells(points_near, np.zeros(3), 1.0)
        occupied_cells = np.concatenate([inner + base + middle, occupied_cells])
        counts, sums = np.concatenate([inner_counts, counts]), np.concatenate([inner_sums, sums])
    low = occupied_cells.min(axis=0)
    return low, occupied_cells - low, counts, sums
