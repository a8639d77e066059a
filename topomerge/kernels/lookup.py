"""Cell -> row in constant time: a dense table of bricks (8 x 8 x 8 cells) over the volume, rows kept only for bricks in use.

A brick is an octree node three levels above the leaves, so in Morton order its cells are neighbours in memory. Memory grows with
the surface (about 25 bytes a cell), not with the volume (1/128 of a byte a cell for the table).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

MAX_BRICKS = 1 << 27  # 512 MB of table


@njit(cache=True)
def _fill_table(cells, table):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    count = 0
    for i in range(len(cells)):
        x, y, z = cells[i, 0] >> 3, cells[i, 1] >> 3, cells[i, 2] >> 3
        if table[x, y, z] < 0:
            table[x, y, z] = count
            count += 1
    return count


@njit(cache=True)
def _fill_bricks(cells, table, bricks):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    for i in range(len(cells)):
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        bricks[table[x >> 3, y >> 3, z >> 3], ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)] = i


@njit(cache=True, inline="always")
def row(table, bricks, x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
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


@njit(cache=True)
def _rows(table, bricks, cells, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    for i in range(len(cells)):
        out[i] = row(table, bricks, cells[i, 0], cells[i, 1], cells[i, 2])


def build(cells: NDArray[Any], shape: tuple[int, int, int]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Table (bricks along x, y, z) int32 and rows (bricks, 512) int32 for unique (n, 3) cells."""
    size = tuple((s + 7) >> 3 for s in shape)
    if int(np.prod(size, dtype=np.float64)) > MAX_BRICKS:
        extent = " x ".join(str(s) for s in shape)
        raise ValueError(f"the volume of {extent} cells is too large: crop the input or take larger voxels")
    table = np.full(size, -1, np.int32)
    bricks = np.full((_fill_table(cells, table), 512), -1, np.int32)
    _fill_bricks(cells, table, bricks)
    return table, bricks


def rows(table: NDArray[Any], bricks: NDArray[Any], cells: NDArray[Any]) -> NDArray[np.int64]:
    """(m,) row of each (m, 3) cell, -1 where it is not in the grid."""
    out = np.empty(len(cells), np.int64)
    _rows(table, bricks, cells, out)
    return out
