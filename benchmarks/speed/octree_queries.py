"""Radius queries: sparse voxel octree against a KD-tree, Open3D's search and hashing, the thesis' own comparison.

Every method answers the same question, all cells within r of 5000 occupied cells, with the rows as the result; the answers are
compared before anything is timed, and no index is built in the time. All run on all cores. The KD-tree's answers are Python
lists, it has no other; `bricks` is the library's own cell lookup under every cell of a sphere, `hash` the same with a plain
hash table. Run from the root: ``python -m benchmarks.speed.octree_queries [queries]``. Lines: `name ours peer ratio`, see
`bench.print_line`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit, prange
from scipy.spatial import cKDTree

from benchmarks.speed.bench import print_line, time_best
from topomerge.extraction.convolution import build_sphere
from topomerge.extraction.views.visibility import SparseVoxelOctree
from topomerge.kernels.voxels import find_row
from topomerge.types import VoxelGrid

CELL_EDGE = 0.1  # m
RADII = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0)  # m
RADIUS_SLACK = 1e-6 * CELL_EDGE  # m: cells exactly at r count, as they do for the octree
CSR = tuple[np.ndarray, np.ndarray]


def build_floor_grid() -> VoxelGrid:
    """Return a storey of 40 x 40 m: floor, ceiling at 2.8 m, walls around rooms of 5 x 4 m with doors, and furniture."""
    volume = np.zeros((400, 400, 30), bool)
    volume[:, :, [0, 28]] = True
    for x in (*range(0, 400, 50), 399):
        volume[x, :, :29] = True
    for y in (*range(0, 400, 40), 399):
        volume[:, y, :29] = True
    for x in range(50, 399, 50):
        for y in range(0, 400, 40):
            volume[x, y + 15 : y + 24, 1:21] = False  # doors 0.9 x 2 m
    rng = np.random.default_rng(0)
    for x, y in rng.integers(2, 385, (400, 2)):
        volume[x : x + 12, y : y + 6, 7] = True  # tables
    scanned = volume & (rng.random(volume.shape) < 0.95)  # scans have holes
    return VoxelGrid.from_cells(np.argwhere(scanned), edge=CELL_EDGE)


@njit(cache=True, error_model="numpy", parallel=True)
def _query_by_bricks(table, bricks, cells, offsets, indptr, rows, fill):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in prange(len(cells)):
        count = 0
        for j in range(len(offsets)):
            cell_row = find_row(
                table, bricks, cells[i, 0] + offsets[j, 0], cells[i, 1] + offsets[j, 1], cells[i, 2] + offsets[j, 2]
            )
            if cell_row >= 0:
                if fill:
                    rows[indptr[i] + count] = cell_row
                count += 1
        if not fill:
            indptr[i + 1] = count


@njit(cache=True, error_model="numpy", inline="always")
def _encode_key(x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover
    return np.int64((x << 42) | (y << 21) | z)


@njit(cache=True, error_model="numpy", inline="always")
def _find_slot(key, mask):  # type: ignore[no-untyped-def]  # pragma: no cover
    hashed = key * np.int64(0x1E3779B97F4A7C15)  # Fibonacci hashing: the high bits depend on every bit of the key
    return ((hashed >> 36) ^ (hashed >> 20)) & mask


@njit(cache=True, error_model="numpy")
def _hash_key(cells, keys, values):  # type: ignore[no-untyped-def]  # pragma: no cover
    mask = len(keys) - 1
    for i in range(len(cells)):
        key = _encode_key(np.int64(cells[i, 0]), np.int64(cells[i, 1]), np.int64(cells[i, 2]))
        slot = _find_slot(key, mask)
        while keys[slot] >= 0:
            slot = (slot + 1) & mask
        keys[slot], values[slot] = key, i


@njit(cache=True, error_model="numpy", parallel=True)
def _query_by_hash(keys, values, cells, offsets, indptr, rows, fill):  # type: ignore[no-untyped-def]  # pragma: no cover
    mask = len(keys) - 1
    for i in prange(len(cells)):
        count = 0
        for j in range(len(offsets)):
            x, y, z = cells[i, 0] + offsets[j, 0], cells[i, 1] + offsets[j, 1], cells[i, 2] + offsets[j, 2]
            if x < 0 or y < 0 or z < 0:
                continue
            key = _encode_key(x, y, z)
            slot = _find_slot(key, mask)
            while keys[slot] >= 0 and keys[slot] != key:
                slot = (slot + 1) & mask
            if keys[slot] == key:
                if fill:
                    rows[indptr[i] + count] = values[slot]
                count += 1
        if not fill:
            indptr[i + 1] = count


def _run_two_passes(kernel: Callable[..., None], tables: CSR, cells: np.ndarray, radius: float) -> CSR:
    """Count, then fill: as the octree does. Rows stay in the order of the stencil."""
    offsets = build_sphere(radius, CELL_EDGE).offsets
    indptr, rows = np.zeros(len(cells) + 1, np.int64), np.empty(0, np.int64)
    kernel(*tables, cells, offsets, indptr, rows, False)
    np.cumsum(indptr, out=indptr)
    rows = np.empty(indptr[-1], np.int64)
    kernel(*tables, cells, offsets, indptr, rows, True)
    return indptr, rows


def build_methods(grid: VoxelGrid, queries: np.ndarray) -> dict[str, Callable[[float], Any]]:
    """Build the methods, name -> function of a radius; each has its index built already."""
    octree = SparseVoxelOctree(grid)
    centroids, centres, cells = grid.compute_centroids(), grid.compute_centroids(queries), queries.astype(np.int64)
    tree = cKDTree(centroids)
    keys = np.full(1 << int(len(grid) * 2 - 1).bit_length(), -1, np.int64)  # at most half full
    values = np.empty_like(keys)
    _hash_key(grid.cells, keys, values)
    by_name: dict[str, Callable[[float], Any]] = {
        "octree": lambda r: octree.find_in_radius_many(queries, r),
        "kdtree": lambda r: tree.query_ball_point(centres, r + RADIUS_SLACK, workers=2),
        "bricks": lambda r: _run_two_passes(_query_by_bricks, grid._bricks, cells, r),
        "hash": lambda r: _run_two_passes(_query_by_hash, (keys, values), cells, r),
    }
    try:
        import open3d as o3d
    except ImportError:
        return by_name
    points, tensor = o3d.core.Tensor(centroids), o3d.core.Tensor(centres)
    searches: dict[float, Any] = {}

    def by_open3d(r: float) -> Any:
        if r not in searches:  # its index is made for one radius: not timed, as the others' is not
            searches[r] = o3d.core.nns.NearestNeighborSearch(points)
            searches[r].fixed_radius_index(r + RADIUS_SLACK)
        return searches[r].fixed_radius_search(tensor, r + RADIUS_SLACK)

    return {**by_name, "open3d": by_open3d}


def count_found(result: Any) -> np.ndarray:
    """Count the cells found for each query, whatever the method returns."""
    if isinstance(result, np.ndarray):
        return np.array([len(r) for r in result])
    return np.diff(result[0] if len(result) == 2 else result[2].numpy())


def main(queries: int = 5000, radii: tuple[float, ...] = RADII) -> None:
    """Verify, then time."""
    grid = build_floor_grid()
    chosen = np.random.default_rng(1).choice(len(grid), queries, replace=False)
    by_name = build_methods(grid, grid.cells[np.sort(chosen)])
    for radius in radii:
        expected = count_found(by_name["octree"](radius))
        for name, method in by_name.items():
            if not np.array_equal(count_found(method(radius)), expected):
                raise AssertionError(f"{name} and the octree differ at {radius} m")
        seconds = {name: time_best(lambda m=method, r=radius: m(r), 5) for name, method in by_name.items()}  # type: ignore[misc]
        for name in list(by_name)[1:]:
            print_line(f"radius_{radius:g}m_octree_vs_{name}", seconds["octree"], seconds[name])


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:]))
