"""A floor for scans that have none: slices of a 2D laser, and captures of the upper half of rooms (beyond the thesis)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from topomerge.kernels.carve import carve
from topomerge.types import Array, VoxelGrid

SLICE = 0.6  # m: what is flatter is a slice
EXTRUDED = 2.4  # m: height of the walls that a slice becomes
TILE = 5.0  # m
LOW = 0.35  # m: what lies so near to the lowest cell of its tile is at the bottom
FLOORED = 0.35  # share of the columns that end at the bottom: where a floor was seen, most do
HEADROOM = 2.3  # m between an assumed floor and the ceiling
OVERHEAD = 1.0  # m above the bottom: what is higher and no wall is a ceiling
ENCLOSED = 0.75  # share of the directions in which a place inside sees a wall
DIRECTIONS = 24
FARTHEST = 15.0  # m


def with_assumed_floor(grid: VoxelGrid, rays: tuple[Array, Array] | None) -> tuple[VoxelGrid, str]:
    """The grid with a floor where rooms are, if the scan shows none; and a warning, empty if it does.

    Args:
        grid: occupied cells.
        rays: (k, 3) places of the sensor and (k, 3) of what it saw, m, where they are known.
    """
    levels = np.sort(grid.cells[:, 2])
    if not len(levels):
        return grid, ""
    low, high = levels[int(0.01 * len(levels))], levels[int(0.99 * (len(levels) - 1))]
    if (high - low) * grid.edge <= SLICE:
        return _extruded(grid, rays, int(low)), "the scan is a slice: walls of 2.4 m and a floor were assumed"
    bottom, top, height = _bottom(grid)
    at_bottom = (bottom - height) * grid.edge <= LOW
    columns = bottom < np.iinfo(np.int64).max
    if at_bottom[columns].mean() >= FLOORED:
        return grid, ""
    inside = columns & ~at_bottom & ((top - height) * grid.edge >= OVERHEAD)
    inside = ndimage.binary_closing(np.pad(inside, 5), np.ones((7, 7)))[5:-5, 5:-5]
    ceiling = ndimage.percentile_filter(np.where(columns, top, 0), 75, max(round(1.0 / grid.edge) | 1, 3))
    floor = np.minimum(height, ceiling - round(HEADROOM / grid.edge))
    level = int(np.median(floor[inside])) if inside.any() else 0
    return _with_cells(grid, np.argwhere(inside), level), "no floor was seen: one was assumed below the lowest points"


def _bottom(grid: VoxelGrid) -> tuple[Array, Array, Array]:
    """(nx, ny) lowest and highest occupied level of each column, and the lowest around it."""
    nx, ny = grid.shape[:2]
    bottom, top = np.full((nx, ny), np.iinfo(np.int64).max), np.full((nx, ny), -1)
    at = tuple(grid.cells[:, :2].T)
    np.minimum.at(bottom, at, grid.cells[:, 2].astype(np.int64))
    np.maximum.at(top, at, grid.cells[:, 2].astype(np.int64))
    tile = max(round(TILE / grid.edge), 1)
    tx, ty = -(-nx // tile), -(-ny // tile)
    lowest = np.full((tx, ty), np.inf)
    x, y = np.nonzero(top >= 0)
    of = (x // tile) * ty + y // tile
    order = np.lexsort((bottom[x, y], of))
    first = np.searchsorted(of[order], np.arange(tx * ty))
    last = np.searchsorted(of[order], np.arange(tx * ty), side="right")
    some = last > first
    lowest.flat[some] = bottom[x, y][order][first[some] + ((last - first)[some] * 0.05).astype(int)]
    lowest = ndimage.minimum_filter(lowest, 3, mode="nearest")
    lowest[~np.isfinite(lowest)] = 0
    return bottom, top, np.repeat(np.repeat(lowest, tile, 0), tile, 1)[:nx, :ny].astype(np.int64)


def _extruded(grid: VoxelGrid, rays: tuple[Array, Array] | None, low: int) -> VoxelGrid:
    """Walls over the columns of a slice, and a floor where the sensor looked or where walls are around."""
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
