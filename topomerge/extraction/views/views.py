"""Where to look from: local maxima of the horizontal distance field, raised to eye height (seeds 2.4)."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.distance_field import horizontal_distance_field
from topomerge.extraction.octree import SparseVoxelOctree
from topomerge.types import Array, VoxelGrid

CELLS_AT_ONCE = 8192  # whose neighbours are held at a time: some hundred each


def optimal_views(navigable: VoxelGrid, radius: float, height: float) -> Array:
    """(V, 3) positions, m, from which the map is seen best (seeds 2.4).

    Args:
        navigable: the navigable volume.
        radius: m; larger ones give fewer views.
        height: m above the floor.
    """
    distance = horizontal_distance_field(navigable)
    return raise_views(navigable, navigable.cells[local_maxima(navigable, distance, radius)], height)


def local_maxima(grid: VoxelGrid, distance: Array, radius: float) -> Array:
    """Ascending rows of cells whose distance is not below that of any cell within `radius` m (seeds 2.4.1, HDF_max).

    The octree answers radius(v, r) (seeds 2.2.1).
    """
    octree = SparseVoxelOctree(grid)
    highest = np.empty(len(grid), np.asarray(distance).dtype)
    for begin in range(0, len(grid), CELLS_AT_ONCE):
        block = slice(begin, begin + CELLS_AT_ONCE)
        indptr, rows = octree.radius_many(grid.cells[block], radius)
        highest[block] = np.maximum.reduceat(distance[rows], indptr[:-1])  # a cell is near itself: none is without neighbours
    return np.flatnonzero(distance >= highest)


def raise_views(navigable: VoxelGrid, cells: Array, height: float) -> Array:
    """(v, 3) float64 centroids of (v, 3) cells raised by `height` m: out of the floor, to where one looks from (seeds 2.4.1)."""
    views = navigable.centroids(cells)
    views[:, 2] += height
    return views
