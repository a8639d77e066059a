"""Free space: the cells that rays crossed (method 4: what later rejects a wrong merge)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topomerge.extraction.distance_field import horizontal_distance_field
from topomerge.extraction.scan import Scan
from topomerge.kernels.carve import carve, sweep
from topomerge.kernels.columns import first_occupied
from topomerge.types import Array, VoxelGrid

FREE_CELL = 2  # free cells are that many times longer than occupied ones: a wall is thinner than what it bounds
RAY_MARGIN = 0.5  # of a free cell's length: a ray ends that far before what it met
RAYS_OF_VIEW = 2000  # 0.25 m apart at 3.5 m
VIEW_SPACING = 2.0  # m between the views that carve where the sensor's places are unknown
VIEW_HEIGHT, VIEW_CLEARANCE = 1.5, 0.3  # m: above the floor, and below what is above
LARGEST_VOLUME = 400_000_000  # free cells


def free_space(scan: Scan, navigable: VoxelGrid, range: float) -> VoxelGrid | None:
    """Cells that are empty: by the file, crossed by the sensor's rays, or where its places are unknown, seen through from views.

    Args:
        scan: occupied cells, with the rays and the free cells that its file knows.
        navigable: the navigable volume.
        range: m, how far views see.

    Returns:
        Cells twice as long as those of the grid; None where the volume is too large to be carved.
    """
    if scan.free is not None:
        return scan.free
    scan = with_crossed_cells(scan)
    if scan.rays is not None:
        return scan.crossed
    crossed = _nothing_crossed(scan.grid)
    if crossed is None:
        return None
    _carve_views(scan.grid, navigable, range, crossed)
    return _empty_cells(scan.grid, crossed)


def with_crossed_cells(scan: Scan) -> Scan:
    """The scan with the cells that its rays crossed, twice as long as those of its grid, where the places of the sensor are known
    and the volume is not too large to be carved."""
    if scan.rays is None or scan.crossed is not None:
        return scan
    crossed = _nothing_crossed(scan.grid)
    if crossed is None:
        return scan
    _carve_rays(scan.grid, *scan.rays, crossed)
    return replace(scan, crossed=_empty_cells(scan.grid, crossed))


def _nothing_crossed(grid: VoxelGrid) -> Array | None:
    """(nx, ny, nz) bool of the free cells, none of them crossed; None where there are too many."""
    nx, ny, nz = (-(-s // FREE_CELL) for s in grid.shape)
    return np.zeros((nx, ny, nz), bool) if nx * ny * nz <= LARGEST_VOLUME else None


def _empty_cells(grid: VoxelGrid, crossed: Array) -> VoxelGrid:
    """The crossed cells in which nothing stands."""
    crossed[tuple((grid.cells // FREE_CELL).T)] = False
    nx, ny, nz = crossed.shape
    return VoxelGrid.from_cells(np.argwhere(crossed), grid.origin, grid.edge * FREE_CELL, (nx, ny, nz))


def _carve_rays(grid: VoxelGrid, starts: Array, ends: Array, crossed: Array) -> None:
    """Mark the free cells that rays crossed, from (k, 3) places of the sensor to (k, 3) of what it saw, m."""
    edge = grid.edge * FREE_CELL
    at, to = (np.ascontiguousarray((np.asarray(p, np.float64) - grid.origin) / edge) for p in (starts, ends))
    carve(at, to, RAY_MARGIN, crossed)


def _carve_views(grid: VoxelGrid, navigable: VoxelGrid, reach: float, crossed: Array) -> None:
    """Mark what lies between views above the floor and the first thing in each direction. A direction in which nothing is seen
    tells nothing."""
    views = views_of_tiles(grid, navigable, VIEW_SPACING)
    starts = np.ascontiguousarray((views - grid.origin) / grid.edge)
    sweep(*grid._bricks, starts, _sphere(RAYS_OF_VIEW), reach / grid.edge, FREE_CELL, crossed)


def views_of_tiles(grid: VoxelGrid, navigable: VoxelGrid, spacing: float) -> Array:
    """(v, 3) m, one view for each `spacing` x `spacing` m tile and storey-high layer: where it is farthest from the boundary.

    A regular net of views sees rooms evenly, whatever the shape of their medial axis. None ends up in a ceiling.
    """
    cells = navigable.cells[_best_of_tiles(navigable, horizontal_distance_field(navigable), spacing)]
    start = int(np.ceil(1.0 / grid.edge))
    limit = int(np.ceil((VIEW_HEIGHT + VIEW_CLEARANCE) / grid.edge)) + 1
    above = first_occupied(*grid._bricks, cells.astype(np.int64), start, 1, limit)
    views = grid.centroids(cells)
    views[:, 2] += np.where(above > 0, np.minimum(VIEW_HEIGHT, above * grid.edge - VIEW_CLEARANCE), VIEW_HEIGHT)
    return views


def _best_of_tiles(grid: VoxelGrid, distance: Array, spacing: float) -> Array:
    """Ascending rows of the cell of each tile with the largest distance."""
    size = max(round(spacing / grid.edge), 1)
    layer = max(round(2.0 / grid.edge), 1)
    tile = grid.cells // (size, size, layer)
    order = np.lexsort((grid.cells[:, 2], -np.asarray(distance), tile[:, 2], tile[:, 1], tile[:, 0]))
    sorted_tiles = tile[order]
    first = np.ones(len(order), bool)
    first[1:] = (sorted_tiles[1:] != sorted_tiles[:-1]).any(axis=1)
    return np.sort(order[first])


def _sphere(count: int) -> Array:
    """(count, 3) directions spread evenly: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    turn = np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
