"""Which connected parts of the navigable cells are floors, and a floor for scans that have none (beyond the thesis)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from topomerge.extraction.morphology import connected_components, on_all_sides
from topomerge.extraction.storeys import floor_to_ceiling, lowest_of_column
from topomerge.kernels.columns import first_occupied
from topomerge.types import Array, VoxelGrid

# Which connected parts of the navigable cells are floors.

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


# A floor for scans that have none: captures of the upper half of rooms (beyond the thesis).

LEVEL_TILE = 5.0  # m: the lowest level is sought on tiles of this size
FLOOR_COVERED_SHARE = 0.1  # of a floor, with something above it
HANGING_SHARE = 0.5  # of the columns, that begin high over the lowest ones
LEAST_CEILING_AREA = 2.0  # m2
USUAL_HEADROOM = 2.6  # m between an assumed floor and the ceiling: that of most homes and offices, within 0.4 m
CARRIED_HEIGHT = 1.4  # m above the floor: a tablet in the hands, a helmet, a tripod
CARRIER_HEADROOM = 2.0, 6.0  # m under the ceiling of somebody who carries a sensor: at least, at most
OVERHEAD = 1.0  # m above the bottom: what is higher and no wall is a ceiling
OVER_FLOOR = 0.5  # m: likewise where there is no floor, of a sensor that looked up in low rooms
OFF_LEVEL = 2  # cells: nearer ones are of the floor itself


def has_floor(grid: VoxelGrid, navigable: VoxelGrid, body_height: float) -> bool:
    """Was a floor seen? Without one, what one could stand on is the upper side of the ceiling: it has nothing above, and walls
    hang from it, or most columns begin high over the lowest ones around."""
    lowest = lowest_of_column(navigable)
    covered = (floor_to_ceiling(grid, navigable, body_height)[lowest] > 0).mean()
    if covered > FLOOR_COVERED_SHARE:
        return True
    above = _above_floor(grid, navigable.cells[lowest])
    if (above < -OFF_LEVEL).sum() > (above > OFF_LEVEL).sum():
        return False
    hanging, _, top = _under_ceiling(grid)
    return bool(hanging.sum() < HANGING_SHARE * (top >= 0).sum())


def _above_floor(grid: VoxelGrid, floor: Array) -> Array:
    """(n,) cells by which each occupied one lies above the nearest column of a floor, (k, 3) of the same lattice."""
    level = np.full(grid.shape[:2], -1, np.int64)
    level[tuple(floor[:, :2].T)] = floor[:, 2]
    nearest = ndimage.distance_transform_edt(level < 0, return_distances=False, return_indices=True)
    at = tuple(grid.cells[:, :2].T)
    above: Array = grid.cells[:, 2].astype(np.int64) - level[nearest[0][at], nearest[1][at]]
    return above


def any_ceiling(grid: VoxelGrid) -> bool:
    """Does enough lie so high above the lowest points that it may be a ceiling?"""
    return bool(_under_ceiling(grid)[0].sum() * grid.edge**2 >= LEAST_CEILING_AREA)


def with_assumed_floor(grid: VoxelGrid, rays: tuple[Array, Array] | None = None) -> VoxelGrid:
    """The grid with a floor under whatever seems to be a ceiling: at the lowest points around, or so far below the ceiling that
    one can stand; where the places of the sensor are known, as far below them as it is usually carried.

    Args:
        rays: (k, 3) places of the sensor and (k, 3) of what it saw, m, where they are known.
    """
    inside, height, top = _under_ceiling(grid, OVER_FLOOR)
    inside = ndimage.binary_closing(np.pad(inside, 5), np.ones((7, 7)))[5:-5, 5:-5]
    lowest, ceiling = float(np.median(height[inside])), float(np.median(top[inside & (top >= 0)]))
    below = ceiling - round(USUAL_HEADROOM / grid.edge)
    if rays is not None:
        eyes = (float(np.median(rays[0][:, 2])) - grid.origin[2]) / grid.edge
        least, most = CARRIER_HEADROOM
        carried = round(eyes - CARRIED_HEIGHT / grid.edge)
        below = carried if least <= (ceiling - carried) * grid.edge <= most else below
    return _with_cells(grid, np.argwhere(inside), int(min(lowest, below)))


def _under_ceiling(grid: VoxelGrid, overhead: float = OVERHEAD) -> tuple[Array, Array, Array]:
    """(nx, ny) columns that begin `overhead` m above the lowest ones around; that lowest level; the highest occupied one of
    each."""
    nx, ny = grid.shape[:2]
    bottom, top = np.full((nx, ny), np.iinfo(np.int64).max), np.full((nx, ny), -1)
    at = tuple(grid.cells[:, :2].T)
    np.minimum.at(bottom, at, grid.cells[:, 2].astype(np.int64))
    np.maximum.at(top, at, grid.cells[:, 2].astype(np.int64))
    tile = max(round(LEVEL_TILE / grid.edge), 1)
    tx, ty = -(-nx // tile), -(-ny // tile)
    x, y = np.nonzero(top >= 0)
    of = (x // tile) * ty + y // tile
    order = np.lexsort((bottom[x, y], of))
    first, last = (np.searchsorted(of[order], np.arange(tx * ty), side=side) for side in ("left", "right"))
    occupied = last > first
    lowest = np.full(tx * ty, np.inf)
    twentieth = first[occupied] + ((last - first)[occupied] * 0.05).astype(int)  # single points may lie below the floor
    lowest[occupied] = bottom[x, y][order][twentieth]
    lowest = ndimage.minimum_filter(lowest.reshape(tx, ty), 3, mode="nearest")
    lowest[~np.isfinite(lowest)] = 0
    height = np.repeat(np.repeat(lowest, tile, 0), tile, 1)[:nx, :ny].astype(np.int64)
    return (top >= 0) & ((bottom - height) * grid.edge >= overhead), height, top


def _with_cells(grid: VoxelGrid, columns: Array, level: int) -> VoxelGrid:
    """The grid with a floor at `level` in these columns; a level below the grid moves its origin."""
    down = max(-level, 0)
    shift = np.array([0, 0, down])
    floor = np.column_stack([columns, np.full(len(columns), level + down)])
    cells = np.concatenate([grid.cells.astype(np.int64) + shift, floor])
    shape = (grid.shape[0], grid.shape[1], grid.shape[2] + down)
    return VoxelGrid.from_cells(cells, grid.origin - shift * grid.edge, grid.edge, shape)
