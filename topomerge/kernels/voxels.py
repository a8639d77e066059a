"""Compiled loops over cells: points into cells, Morton codes, constant-time look-up, resampling."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, uint64
from numpy.typing import NDArray

from topomerge.kernels import compile_ahead, run_in_slices

BITS = 21
AXIS_LIMIT = 1 << BITS  # cells along an axis
DIGIT = 11  # bits a pass of the radix sort: its 2048 counters stay in the first-level cache


@njit(cache=True, inline="always")
def spread(value):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the 21 low bits of `value`, two zeros between each."""
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


@compile_ahead("i4[:,::1], u8[::1]")
def _encode(cells, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    for i in range(len(cells)):
        out[i] = spread(cells[i, 0]) | (spread(cells[i, 1]) << uint64(1)) | (spread(cells[i, 2]) << uint64(2))


@compile_ahead("u8[::1], i4[:,::1]")
def _decode(codes, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    for i in range(len(codes)):
        out[i, 0] = gather(codes[i])
        out[i, 1] = gather(codes[i] >> uint64(1))
        out[i, 2] = gather(codes[i] >> uint64(2))


@compile_ahead("u8[::1], i8[::1], u8, u8[::1], i8[::1]")
def _run_radix_pass(keys, rows, shift, keys_out, rows_out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    starts = np.zeros((1 << DIGIT) + 1, np.int64)
    for i in range(len(keys)):
        starts[((keys[i] >> shift) & uint64((1 << DIGIT) - 1)) + uint64(1)] += 1
    for d in range(1 << DIGIT):
        starts[d + 1] += starts[d]
    for i in range(len(keys)):
        d = (keys[i] >> shift) & uint64((1 << DIGIT) - 1)
        keys_out[starts[d]], rows_out[starts[d]] = keys[i], rows[i]
        starts[d] += 1


def find_unique_rows(codes: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Return rows that put (n,) codes in ascending order, each code once at its first mention: `np.unique`'s index.

    A radix sort over the bits in use: five times as fast as `np.unique` on a million codes, and stable.
    """
    if not len(codes) or bool((codes[1:] > codes[:-1]).all()):
        return np.arange(len(codes))
    keys, rows = codes.copy(), np.arange(len(codes))
    other_keys, other_rows = np.empty_like(keys), np.empty_like(rows)
    for shift in range(0, int(codes.max()).bit_length(), DIGIT):
        _run_radix_pass(keys, rows, np.uint64(shift), other_keys, other_rows)
        keys, other_keys, rows, other_rows = other_keys, keys, other_rows, rows
    fresh = np.ones(len(keys), bool)
    np.not_equal(keys[1:], keys[:-1], out=fresh[1:])
    return rows[fresh]


def encode(cells: NDArray[Any]) -> NDArray[np.uint64]:
    """Return (n,) uint64 Morton codes of (n, 3) integer cells in 0 .. 2**21 - 1."""
    out = np.empty(len(cells), np.uint64)
    _encode(np.ascontiguousarray(cells, np.int32), out)
    return out


def decode(codes: NDArray[Any]) -> NDArray[np.int32]:
    """Return (n, 3) int32 cells of Morton codes."""
    out = np.empty((len(codes), 3), np.int32)
    _decode(np.ascontiguousarray(codes, np.uint64), out)
    return out


TABLE_REACH = 1 << 10  # cells around the median point that `_split` puts into a table, which is then small enough
OFFSET_STEPS = 256  # in which the way through a cell is divided
LEAST_POINTS = 1 << 16  # of a slice of a chunk
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
    """Lowest and highest finite coordinates of (N, 3) points and the number of points that are not finite."""

    def compute(first: int, last: int) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        return low, high, int(_compute_bounds(first, last, points, low, high))

    lows, highs, bad = zip(*run_in_slices(compute, len(points), LEAST_POINTS), strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0), sum(bad)


@compile_ahead("f4[:,::1], i8, f8[::1], f8", error_model="numpy")
def _locate_cell(points, i, shift, edge):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
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


@njit(cache=True, inline="always")
def _find_part(place):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Which of the `OFFSET_STEPS` parts of its cell a place, in cells, lies in: exact: a power of 2."""
    return np.int64(np.floor(place * OFFSET_STEPS)) & (OFFSET_STEPS - 1)


@njit(cache=True, nogil=True, error_model="numpy")
def convert_to_lattice(points, shift, edge, out, parts):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Lattice cell of each point, and its part of the cell; points that are not finite get the lowest integer."""
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
    """First pass: 1 in `table` for each brick that holds a point. Threads may write the same 1 twice."""
    for i in range(first, last):
        finite, x, y, z = _locate_cell(points, i, shift, edge)
        if finite:
            table[(x - base[0]) >> 3, (y - base[1]) >> 3, (z - base[2]) >> 3] = 1


@njit(cache=True, inline="always")
def _encode_place(x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Place of a cell in its brick, in Morton order."""
    x3, y3, z3 = x & 7, y & 7, z & 7
    code = (x3 & 1) | (y3 & 1) << 1 | (z3 & 1) << 2
    code |= (x3 & 2) << 2 | (y3 & 2) << 3 | (z3 & 2) << 4
    return code | (x3 & 4) << 4 | (y3 & 4) << 5 | (z3 & 4) << 6


@compile_ahead("f4[:,::1], f8[::1], f8, i8[::1], i4[:,:,::1], u4[::1], i8[::1]", error_model="numpy")
def count(points, shift, edge, base, table, counts, places):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Second pass: points in each cell of the bricks in use; of each point where in `counts` (flat) it is counted (-1 nowhere),
    with the parts of its cell in the 24 lowest bits."""
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if np.isfinite(x) and np.isfinite(y) and np.isfinite(z):
            u, v, w = (x + shift[0]) / edge, (y + shift[1]) / edge, (z + shift[2]) / edge
            cx, cy, cz = np.int64(np.floor(u)) - base[0], np.int64(np.floor(v)) - base[1], np.int64(np.floor(w)) - base[2]
            at = (np.int64(table[cx >> 3, cy >> 3, cz >> 3]) << 9) + _encode_place(cx, cy, cz)
            counts[at] += 1
            at = (at << 8) | _find_part(u)
            at = (at << 8) | _find_part(v)
            at = (at << 8) | _find_part(w)
            places[i] = at
        else:
            places[i] = -1


@compile_ahead("i8[::1], u4[::1], i8[:,::1]", error_model="numpy")
def add_parts(places, rows, sums):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Third pass: sums (n, 3) of the parts of their cells that points lie in, or (n, 6): with how many of them are odd; rows:
    number of the cell at each place."""
    for place in places:
        if place >= 0:
            row = rows[place >> 24]
            x, y, z = (place >> 16) & 255, (place >> 8) & 255, place & 255
            sums[row, 0] += x
            sums[row, 1] += y
            sums[row, 2] += z
            if sums.shape[1] == 6:
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
    """Occupied lattice cells of one chunk of points, by Morton codes; None where these do not reach, or the extent is too large.

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
    """Occupied lattice cells of one chunk of points.

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
    """The lowest cell of the bricks that hold all finite points, and how many bricks lie along each axis."""
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
    """Bricks (b, 3) that hold points, by their Morton codes (b,) about a brick `first` steps before; places (n,) in them of their
    occupied cells, in Morton order; of these the counts (n,) and sums (n, columns)."""
    table = np.zeros(tuple(size), np.int32)
    if not table.size:
        none = np.zeros(0, np.int64)
        return np.zeros((0, 3), np.int64), none.astype(np.uint64), none, none, np.zeros((0, columns), np.int64)
    run_in_slices(mark, len(points), LEAST_POINTS, points, shift, edge, base, table)
    bricks = np.argwhere(table)
    codes = encode(bricks + first)
    order = np.argsort(codes, kind="stable")
    bricks, codes = bricks[order], codes[order]
    table[tuple(bricks.T)] = np.arange(len(bricks))
    counts = np.zeros(len(bricks) * 512, np.uint32)
    places = np.empty(len(points), np.int64)
    count(points, shift, edge, base, table, counts, places)
    filled = np.flatnonzero(counts)
    numbers = counts[filled].astype(np.int64)
    counts[filled] = np.arange(len(filled))
    sums = np.zeros((len(filled), columns), np.int64)
    add_parts(places, counts, sums)
    return bricks, codes, filled, numbers, sums


def _split(points: NDArray[Any], shift: NDArray[Any], edge: float) -> Occupied:
    """`occupied` for an extent too large for a table: a table around the median point, the points far from it sorted."""
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


MAX_BRICKS = 1 << 27  # 512 MB of table


@compile_ahead("i4[:,::1], i4[:,:,::1]")
def _fill_table(cells, table):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    count = 0
    for i in range(len(cells)):
        x, y, z = cells[i, 0] >> 3, cells[i, 1] >> 3, cells[i, 2] >> 3
        if table[x, y, z] < 0:
            table[x, y, z] = count
            count += 1
    return count


@compile_ahead("i4[:,::1], i4[:,:,::1], i4[:,::1]")
def _fill_bricks(cells, table, bricks):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    for i in range(len(cells)):
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        bricks[table[x >> 3, y >> 3, z >> 3], ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)] = i


@compile_ahead("i4[:,:,::1], i4[:,::1], i8, i8, i8")
def find_row(table, bricks, x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Row of cell (x, y, z), -1 where it is empty or outside."""
    if x < 0 or y < 0 or z < 0:
        return -1
    bx, by, bz = x >> 3, y >> 3, z >> 3
    if bx >= table.shape[0] or by >= table.shape[1] or bz >= table.shape[2]:
        return -1
    brick = table[bx, by, bz]
    if brick < 0:
        return -1
    return bricks[brick, ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)]


@compile_ahead("i4[:,:,::1], i4[:,::1], i8[:,::1], i8[::1]")
def _find_rows(table, bricks, cells, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    for i in range(len(cells)):
        out[i] = find_row(table, bricks, cells[i, 0], cells[i, 1], cells[i, 2])


def build(cells: NDArray[Any], shape: tuple[int, int, int]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Table (bricks along x, y, z) int32 and rows (bricks, 512) int32 for unique (n, 3) cells."""
    size = tuple((s + 7) >> 3 for s in shape)
    if int(np.prod(size, dtype=np.float64)) > MAX_BRICKS:
        extent = " x ".join(str(s) for s in shape)
        raise ValueError(f"the volume of {extent} cells is too large: crop the input or take larger voxels")
    table = np.full(size, -1, np.int32)
    cells = np.ascontiguousarray(cells, np.int32)
    bricks = np.full((_fill_table(cells, table), 512), -1, np.int32)
    _fill_bricks(cells, table, bricks)
    return table, bricks


def find_rows(table: NDArray[Any], bricks: NDArray[Any], cells: NDArray[Any]) -> NDArray[np.int64]:
    """Return (m,) row of each (m, 3) cell, -1 where it is not in the grid."""
    out = np.empty(len(cells), np.int64)
    _find_rows(table, bricks, np.ascontiguousarray(cells, np.int64), out)
    return out


@compile_ahead("i4[:,::1], i8[:,::1], f8[:,::1], f8[:,::1], f8, i8, i8")
def find_filled_cells(cells, holding, matrix, local, slack, reach, tall):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(m, 3) int64 cells of the lattice of which the middle lies in a cell of the grid, and (m,) int64 in which one.

    A bent grid is taken as linear in each of its cells: what is bent to p is at middle + J (p - bent) - lean (height of p over
    the middle).

    Args:
        cells: (n, 3) of the grid.
        holding: (n, 3) int64 cells of the lattice in which their middles are laid.
        matrix: (3, 4) places of the lattice in those of the bent grid, both in cells; upright.
        local: (n, 8) of each cell: where its middle is bent to (2, in cells), J (4, row by row) and lean (2); (0, 8): rigid.
        slack: of a cell, by which a place may lie beside it.
        reach, tall: lattice cells around the holding one that are tried, in the plane and up and down.
    """
    most = 2 * len(cells) + 64
    out, rows = np.empty((most, 3), np.int64), np.empty(most, np.int64)
    count = 0
    for i in range(len(cells)):
        for w in range(-tall, tall + 1):
            q = holding[i, 2] + w
            z = matrix[2, 2] * (q + 0.5) + matrix[2, 3]
            if np.floor(z) != cells[i, 2]:
                continue
            up = z - (cells[i, 2] + 0.5)
            for u in range(holding[i, 0] - reach, holding[i, 0] + reach + 1):
                for v in range(holding[i, 1] - reach, holding[i, 1] + reach + 1):
                    x = matrix[0, 0] * (u + 0.5) + matrix[0, 1] * (v + 0.5) + matrix[0, 3] - cells[i, 0]
                    y = matrix[1, 0] * (u + 0.5) + matrix[1, 1] * (v + 0.5) + matrix[1, 3] - cells[i, 1]
                    if len(local):
                        dx, dy = x + cells[i, 0] - local[i, 0], y + cells[i, 1] - local[i, 1]
                        x = 0.5 + local[i, 2] * dx + local[i, 3] * dy - local[i, 6] * up
                        y = 0.5 + local[i, 4] * dx + local[i, 5] * dy - local[i, 7] * up
                    if not (-slack <= x < 1 + slack and -slack <= y < 1 + slack):
                        continue
                    if count == most:
                        most *= 2
                        wider, longer = np.empty((most, 3), np.int64), np.empty(most, np.int64)
                        for k in range(count):
                            longer[k] = rows[k]
                            for a in range(3):
                                wider[k, a] = out[k, a]
                        out, rows = wider, longer
                    out[count, 0], out[count, 1], out[count, 2], rows[count] = u, v, q, i
                    count += 1
    return out[:count], rows[:count]
