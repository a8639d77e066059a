"""Free space: the cells that rays crossed (method.md, section 1: the evidence that later rejects a wrong merge)."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.distance_field import horizontal_distance_field
from topomerge.extraction.views.views import best_of_tiles, raise_views
from topomerge.kernels.carve import carve, sweep
from topomerge.types import Array, VoxelGrid

COARSER = 2  # free cells are that many times longer than occupied ones: a wall is thinner than what it bounds
MARGIN = 0.5  # of a free cell's length: a ray ends that far before what it met
RAYS = 2000  # of a view: 0.25 m apart at 3.5 m
SPACING = 2.0  # m between the views that carve where the sensor's places are unknown
LARGEST = 400_000_000  # cells of the volume


def carve_rays(grid: VoxelGrid, starts: Array, ends: Array) -> VoxelGrid | None:
    """The cells, twice as long as those of the grid, that rays crossed and in which nothing is occupied.

    Args:
        grid: occupied cells.
        starts, ends: (k, 3) m, places of the sensor and of what it saw.

    Returns:
        None where the volume is too large to be carved.
    """
    crossed = _volume(grid)
    if crossed is None:
        return None
    edge = grid.edge * COARSER
    at, to = (np.ascontiguousarray((np.asarray(p, np.float64) - grid.origin) / edge) for p in (starts, ends))
    carve(at, to, MARGIN, crossed)
    return _free(grid, crossed)


def carve_views(grid: VoxelGrid, navigable: VoxelGrid, height: float, reach: float) -> VoxelGrid | None:
    """The same for a map whose sensor's places are unknown: what lies between a view above the floor and the first thing in each
    direction. A direction in which nothing is seen tells nothing.

    Args:
        height: of the views above the floor, m.
        reach: how far they see, m.
    """
    crossed = _volume(grid)
    if crossed is None:
        return None
    rows = best_of_tiles(navigable, horizontal_distance_field(navigable), SPACING)
    views = raise_views(grid, navigable.cells[rows], height, 0.3)
    starts = np.ascontiguousarray((views - grid.origin) / grid.edge)
    sweep(*grid._bricks, starts, _sphere(RAYS), reach / grid.edge, COARSER, crossed)
    return _free(grid, crossed)


def _volume(grid: VoxelGrid) -> Array | None:
    shape = tuple(-(-s // COARSER) for s in grid.shape)
    return np.zeros(shape, bool) if int(np.prod(shape, dtype=np.float64)) <= LARGEST else None


def _free(grid: VoxelGrid, crossed: Array) -> VoxelGrid:
    crossed[tuple((grid.cells // COARSER).T)] = False
    return VoxelGrid.from_cells(np.argwhere(crossed), grid.origin, grid.edge * COARSER, crossed.shape)


def _sphere(count: int) -> Array:
    """(count, 3) directions spread evenly: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    turn = np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
