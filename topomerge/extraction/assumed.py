"""A floor for scans that have none: slices of a 2D laser, and captures of the upper half of rooms (beyond the thesis)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from topomerge.extraction.storeys import floor_to_ceiling, lowest_of_column
from topomerge.kernels.carve import carve
from topomerge.types import Array, VoxelGrid

SLICE = 0.6  # m: what is flatter is a slice
EXTRUDED = 2.4  # m: height of the walls that a slice becomes
TILE = 5.0  # m
COVERED = 0.1  # share of a floor with something above it
HANGING = 0.5  # share of the columns that begin high over the lowest ones
LEAST_AREA = 2.0  # m2
HEADROOM = 2.6  # m between an assumed floor and the ceiling: that of most homes and offices, within 0.4 m
CARRIED = 1.4  # m above the floor: a tablet in the hands, a helmet, a tripod
LEAST_HEADROOM, MOST_HEADROOM = 2.0, 6.0  # m under the ceiling of somebody who carries a sensor
OVERHEAD = 1.0  # m above the bottom: what is higher and no wall is a ceiling
ENCLOSED = 0.75  # share of the directions in which a place inside sees a wall
DIRECTIONS = 24
FARTHEST = 15.0  # m


def is_slice(grid: VoxelGrid) -> bool:
    """Is the scan flat, but for single points?"""
    levels = np.sort(grid.cells[:, 2])
    if not len(levels):
        return False
    low, high = levels[int(0.01 * len(levels))], levels[int(0.99 * (len(levels) - 1))]
    return bool((high - low) * grid.edge <= SLICE)


def extruded(grid: VoxelGrid, rays: tuple[Array, Array] | None) -> VoxelGrid:
    """Walls over the columns of a slice, and a floor where the sensor looked, or where walls are around.

    Args:
        grid: occupied cells.
        rays: (k, 3) places of the sensor and (k, 3) of what it saw, m, where they are known.
    """
    low = int(np.sort(grid.cells[:, 2])[int(0.01 * len(grid))])
    columns = np.unique(grid.cells[:, :2], axis=0)
    wall = np.zeros(grid.shape[:2], bool)
    wall[tuple(columns.T)] = True
    inside = _crossed(grid, *rays) if rays is not None else _enclosed(wall, grid.edge)
    inside = ndimage.binary_closing(np.pad(inside, 2), np.ones((3, 3)))[2:-2, 2:-2] & ~wall
    high = round(EXTRUDED / grid.edge)
    levels = np.arange(low + 1, low + high)
    walls = np.column_stack([np.repeat(columns, len(levels), axis=0), np.tile(levels, len(columns))])
    shape = (grid.shape[0], grid.shape[1], max(grid.shape[2], low + high + 1))
    floor = np.column_stack([np.argwhere(inside), np.full(int(inside.sum()), low)])
    return VoxelGrid.from_cells(np.concatenate([walls, floor]), grid.origin, grid.edge, shape)


def has_floor(grid: VoxelGrid, navigable: VoxelGrid, body_height: float) -> bool:
    """Was a floor seen? Without one, what one could stand on is the upper side of the ceiling: it has nothing above, and most
    columns begin high over the lowest ones around."""
    lowest = lowest_of_column(navigable)
    covered = (floor_to_ceiling(grid, navigable, body_height)[lowest] > 0).mean()
    hanging, _, top = _under_ceiling(grid)
    return bool(covered > COVERED or hanging.sum() < HANGING * (top >= 0).sum())


def any_ceiling(grid: VoxelGrid) -> bool:
    """Does enough lie so high above the lowest points that it may be a ceiling?"""
    return bool(_under_ceiling(grid)[0].sum() * grid.edge**2 >= LEAST_AREA)


def with_assumed_floor(grid: VoxelGrid, rays: tuple[Array, Array] | None = None) -> VoxelGrid:
    """The grid with a floor under whatever seems to be a ceiling: at the lowest points around, or so far below the ceiling that
    one can stand; where the places of the sensor are known, as far below them as it is usually carried.

    Args:
        rays: (k, 3) places of the sensor and (k, 3) of what it saw, m, where they are known.
    """
    inside, height, top = _under_ceiling(grid)
    inside = ndimage.binary_closing(np.pad(inside, 5), np.ones((7, 7)))[5:-5, 5:-5]
    lowest, ceiling = float(np.median(height[inside])), float(np.median(top[inside & (top >= 0)]))
    below = ceiling - round(HEADROOM / grid.edge)
    if rays is not None:
        eyes = (float(np.median(rays[0][:, 2])) - grid.origin[2]) / grid.edge
        carried = round(eyes - CARRIED / grid.edge)
        below = carried if LEAST_HEADROOM <= (ceiling - carried) * grid.edge <= MOST_HEADROOM else below
    return _with_cells(grid, np.argwhere(inside), int(min(lowest, below)))


def _under_ceiling(grid: VoxelGrid) -> tuple[Array, Array, Array]:
    """(nx, ny) columns that begin high above the lowest ones around; that lowest level; the highest occupied one of each."""
    nx, ny = grid.shape[:2]
    bottom, top = np.full((nx, ny), np.iinfo(np.int64).max), np.full((nx, ny), -1)
    at = tuple(grid.cells[:, :2].T)
    np.minimum.at(bottom, at, grid.cells[:, 2].astype(np.int64))
    np.maximum.at(top, at, grid.cells[:, 2].astype(np.int64))
    tile = max(round(TILE / grid.edge), 1)
    tx, ty = -(-nx // tile), -(-ny // tile)
    x, y = np.nonzero(top >= 0)
    of = (x // tile) * ty + y // tile
    order = np.lexsort((bottom[x, y], of))
    first, last = (np.searchsorted(of[order], np.arange(tx * ty), side=side) for side in ("left", "right"))
    some = last > first
    lowest = np.full(tx * ty, np.inf)
    lowest[some] = bottom[x, y][order][first[some] + ((last - first)[some] * 0.05).astype(int)]  # but for single points
    lowest = ndimage.minimum_filter(lowest.reshape(tx, ty), 3, mode="nearest")
    lowest[~np.isfinite(lowest)] = 0
    height = np.repeat(np.repeat(lowest, tile, 0), tile, 1)[:nx, :ny].astype(np.int64)
    return (top >= 0) & ((bottom - height) * grid.edge >= OVERHEAD), height, top


def _crossed(grid: VoxelGrid, starts: Array, ends: Array) -> Array:
    """(nx, ny) columns that rays crossed, seen from above."""
    flat = np.zeros((*grid.shape[:2], 1), bool)
    at, to = ((np.asarray(p, np.float64) - grid.origin) / grid.edge for p in (starts, ends))
    at[:, 2], to[:, 2] = 0.5, 0.5
    carve(np.ascontiguousarray(at), np.ascontiguousarray(to), 1.0, flat)
    return flat[:, :, 0]


def _enclosed(wall: Array, edge: float) -> Array:
    """(nx, ny) columns around which walls stand in most directions."""
    hits = np.zeros(wall.shape, np.int32)
    far = round(FARTHEST / edge)
    for angle in np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS:
        seen = wall.copy()  # swept along the direction: doubling the shift each time covers all distances
        step = 1
        reach = np.array([np.cos(angle), np.sin(angle)])
        while step < far:
            dx, dy = np.rint(reach * step).astype(int)
            seen |= _shifted(seen, int(dx), int(dy))
            step *= 2
        hits += seen
    return np.asarray(hits >= ENCLOSED * DIRECTIONS)


def _shifted(mask: Array, dx: int, dy: int) -> Array:
    out = np.zeros_like(mask)
    nx, ny = mask.shape
    if abs(dx) < nx and abs(dy) < ny:
        out[max(dx, 0) : nx + min(dx, 0), max(dy, 0) : ny + min(dy, 0)] = mask[
            max(-dx, 0) : nx + min(-dx, 0), max(-dy, 0) : ny + min(-dy, 0)
        ]
    return out


def _with_cells(grid: VoxelGrid, columns: Array, level: int) -> VoxelGrid:
    """The grid with a floor at `level` in these columns; a level below the grid moves its origin."""
    down = max(-level, 0)
    shift = np.array([0, 0, down])
    floor = np.column_stack([columns, np.full(len(columns), level + down)])
    cells = np.concatenate([grid.cells.astype(np.int64) + shift, floor])
    shape = (grid.shape[0], grid.shape[1], grid.shape[2] + down)
    return VoxelGrid.from_cells(cells, grid.origin - shift * grid.edge, grid.edge, shape)
