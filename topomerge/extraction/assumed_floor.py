"""A floor for scans that have none: captures of the upper half of rooms (beyond the thesis)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from topomerge.extraction.storeys import floor_to_ceiling, lowest_of_column
from topomerge.types import Array, VoxelGrid

LEVEL_TILE = 5.0  # m: the lowest level is sought on tiles of this size
COVERED_SHARE = 0.1  # of a floor, with something above it
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
    if covered > COVERED_SHARE:
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
