"""Which connected parts of the navigable cells are floors."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from topomerge.extraction.components import connected_components
from topomerge.extraction.distance_field import horizontal_distance_field
from topomerge.types import Array, VoxelGrid

LEAST_AREA = 1.0  # m2
LEAST_HALF_WIDTH = 0.2  # m: a wall's top is narrower, a floor on which somebody stands is not
FURNITURE_AREA = 15.0  # m2: the largest table, stage or bed
FURNITURE_HEIGHT = (0.25, 1.3)  # m over the floor beside it


def largest_component(grid: VoxelGrid) -> VoxelGrid:
    """The connected component with the most cells (seeds 2.3.3)."""
    if not len(grid):
        return grid
    component = connected_components(grid)
    return grid.subset(component == np.bincount(component).argmax())


def floor_components(grid: VoxelGrid) -> VoxelGrid:
    """The connected components that are floors.

    Beyond the thesis, which keeps the largest: a partial map may hold rooms whose connection was not seen, and ten rooms apart
    are ten rooms. Left out are wall tops (too narrow), scraps (too small) and the tops of furniture (a small area a step above
    a larger one).
    """
    if not len(grid):
        return grid
    component = connected_components(grid)
    count = int(component.max()) + 1
    area = _columns(grid, component, count) * grid.edge**2
    widest = np.zeros(count, np.int64)
    np.maximum.at(widest, component, horizontal_distance_field(grid))
    floor = (area >= LEAST_AREA) & ((widest + 0.5) * grid.edge >= LEAST_HALF_WIDTH)
    for c in np.flatnonzero(floor & (area <= FURNITURE_AREA)):
        if _on_furniture(grid, component, area, floor, int(c)):
            floor[c] = False
    return grid.subset(floor[component])


def _columns(grid: VoxelGrid, component: Array, count: int) -> Array:
    """Number of columns (x, y) that each component covers."""
    keys = np.unique(np.column_stack([component, grid.cells[:, :2]]), axis=0)
    return np.bincount(keys[:, 0], minlength=count)


def _on_furniture(grid: VoxelGrid, component: Array, area: Array, floor: Array, c: int) -> bool:
    """Does component `c` lie a table's height above the larger floor around it?"""
    top = grid.cells[component == c] * grid.edge
    near = floor[component] & (area[component] > 2 * area[c])
    near &= (np.abs(grid.cells * grid.edge - top.mean(axis=0)) < np.ptp(top, axis=0) / 2 + (1.0, 1.0, 1.6)).all(axis=1)
    if not near.any():
        return False
    around = grid.cells[near] * grid.edge
    distance, nearest = cKDTree(around[:, :2]).query(top[:, :2], distance_upper_bound=1.0)
    found = np.isfinite(distance)
    if found.mean() < 0.3:
        return False
    rise = float(np.median(top[found, 2] - around[nearest[found], 2]))
    return FURNITURE_HEIGHT[0] <= rise <= FURNITURE_HEIGHT[1]
