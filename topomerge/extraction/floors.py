"""Which connected parts of the navigable cells are floors."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from topomerge.extraction.components import connected_components
from topomerge.extraction.distance_field import on_all_sides
from topomerge.kernels.columns import first_occupied
from topomerge.types import Array, VoxelGrid

FLOOR_LEAST_AREA = 1.0  # m2
FLOOR_LEAST_HALF_WIDTH = 0.2  # m: a wall's top is narrower, a floor on which somebody stands is not
FURNITURE_AREA = 15.0  # m2: the largest table, stage or bed
BESIDE, BESIDE_UNCOVERED = 1.0, 4.0  # m: so near the floor lies beside furniture; likewise where nothing was seen above that
CEILING_FROM, HIGHEST_CEILING = 1.0, 8.0  # m above a floor, between which a ceiling is looked for
COVERED_SHARE = 0.1  # of what stands below a ceiling, over which something was seen: lamps, and walls that reach higher
FURNITURE_HEIGHT = (0.25, 1.3)  # m over the floor beside it


def largest_component(grid: VoxelGrid) -> VoxelGrid:
    """The connected component with the most cells (seeds 2.3.3)."""
    if not len(grid):
        return grid
    component = connected_components(grid)
    return grid.subset(component == np.bincount(component).argmax())


def floor_components(grid: VoxelGrid, occupied: VoxelGrid | None = None) -> VoxelGrid:
    """The connected components that are floors.

    Args:
        grid: navigable cells.
        occupied: what was seen. Where that ends below the ceiling, a body fits on every worktop, bed and island, however far from
            the floor that was seen.

    Beyond the thesis, which keeps the largest: a partial map may hold rooms whose connection was not seen, and ten rooms apart
    are ten rooms. Left out are wall tops (too narrow), scraps (too small) and the tops of furniture (a small area a step above
    a larger one).
    """
    if not len(grid):
        return grid
    component = connected_components(grid)
    count = int(component.max()) + 1
    area = _columns(grid, component, count) * grid.edge**2
    inner = on_all_sides(grid, grid.cells, int(np.ceil(FLOOR_LEAST_HALF_WIDTH / grid.edge - 0.5 - 1e-9)))
    floor = (area >= FLOOR_LEAST_AREA) & (np.bincount(component, inner, count) > 0)
    suspects = np.flatnonzero(floor & (area <= FURNITURE_AREA))
    if len(suspects):
        large = grid.cells[(floor & (area > 2 * area[suspects].min()))[component]] * grid.edge
        below = cKDTree(large[:, :2]) if len(large) else None
        order = np.argsort(component, kind="stable")
        begin = np.searchsorted(component[order], np.arange(count + 1))
        for c in suspects:
            rows = order[begin[c] : begin[c + 1]]
            top = grid.cells[rows] * grid.edge
            reach = BESIDE if occupied is None or _has_ceiling(occupied, grid.cells[rows]) else BESIDE_UNCOVERED
            if below is not None and _on_furniture(top, large, below, reach):
                floor[c] = False
    return grid.subset(floor[component])


def _columns(grid: VoxelGrid, component: Array, count: int) -> Array:
    """Number of columns (x, y) that each component covers."""
    columns = grid.shape[0] * grid.shape[1]
    keys = np.unique((component * grid.shape[0] + grid.cells[:, 0]) * grid.shape[1] + grid.cells[:, 1])
    return np.bincount(keys // columns, minlength=count)


def _has_ceiling(occupied: VoxelGrid, cells: Array) -> bool:
    """Was something seen above much of a floor (k, 3)?"""
    start, far = max(int(CEILING_FROM / occupied.edge), 1), int(HIGHEST_CEILING / occupied.edge)
    above = first_occupied(*occupied._bricks, np.ascontiguousarray(cells, np.int64), start, 1, far)
    return bool((above > 0).mean() > COVERED_SHARE)


def _on_furniture(top: Array, floors: Array, below: cKDTree, reach: float) -> bool:
    """Do the cells `top` (k, 3) lie a table's height above the floor around them, at most `reach` away? All in m; `below`
    searches the floors' plan.

    Only a floor that is larger than the top counts: it is the one that goes around it.
    """
    around = below.query_ball_point(top[:, :2].mean(axis=0), float(np.ptp(top[:, :2], axis=0).max()) / 2 + reach)
    near = floors[around]
    near = near[(near[:, 2] < top[:, 2].min() - 1e-6) & (near[:, 2] > top[:, 2].min() - FURNITURE_HEIGHT[1] - 0.3)]
    if len(near) <= len(top):
        return False
    distance, nearest = cKDTree(near[:, :2]).query(top[:, :2], distance_upper_bound=reach)
    beside_floor = np.isfinite(distance)
    if beside_floor.mean() < 0.3:
        return False
    rise = float(np.median(top[beside_floor, 2] - near[nearest[beside_floor], 2]))
    return FURNITURE_HEIGHT[0] <= rise <= FURNITURE_HEIGHT[1]
