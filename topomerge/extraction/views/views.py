"""Where to look from: local maxima of the horizontal distance field, raised to eye height (seeds 2.4.1)."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.convolution import convolve, sphere
from topomerge.kernels.columns import first_occupied
from topomerge.types import Array, VoxelGrid


def local_maxima(grid: VoxelGrid, distance: Array, radius: float) -> Array:
    """Ascending rows of cells whose distance is not below that of any cell within `radius` m (seeds 2.4.1, HDF_max)."""
    highest = convolve(grid, sphere(radius, grid.edge), "max", np.asarray(distance, np.int64))
    return np.flatnonzero(distance >= highest)


def best_of_tiles(grid: VoxelGrid, distance: Array, spacing: float) -> Array:
    """Ascending rows of one cell for each `spacing` x `spacing` m tile and storey-high layer: the farthest from the boundary.

    A regular net of views sees rooms evenly, whatever the shape of their medial axis (deviation from the thesis: findings.md).
    """
    size = max(round(spacing / grid.edge), 1)
    layer = max(round(2.0 / grid.edge), 1)
    tile = grid.cells // (size, size, layer)
    order = np.lexsort((grid.cells[:, 2], -np.asarray(distance), tile[:, 2], tile[:, 1], tile[:, 0]))
    sorted_tiles = tile[order]
    first = np.ones(len(order), bool)
    first[1:] = (sorted_tiles[1:] != sorted_tiles[:-1]).any(axis=1)
    return np.sort(order[first])


def raise_views(grid: VoxelGrid, cells: Array, height: float, clearance: float | None = None) -> Array:
    """Centroids of `cells` raised by `height` m (seeds 2.4.1, views).

    Args:
        grid: the occupied cells.
        cells: (v, 3) cells to stand on.
        height: m above the cell.
        clearance: if given, a view stays this far (m) below the first occupied cell above it, so that none ends up in a ceiling.

    Returns:
        (v, 3) float64 positions, m.
    """
    raised = np.full(len(cells), float(height))
    if clearance is not None:
        start = int(np.ceil(1.0 / grid.edge))
        limit = int(np.ceil((height + clearance) / grid.edge)) + 1
        above = first_occupied(*grid._bricks, np.asarray(cells, np.int64), start, 1, limit)
        raised = np.where(above > 0, np.minimum(raised, above * grid.edge - clearance), raised)
    views = grid.centroids(cells)
    views[:, 2] += raised
    return views
