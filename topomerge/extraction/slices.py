"""Slices of a 2D laser: they get walls and a floor. Raised plans: their walls show no doors (beyond the thesis)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from topomerge.errors import InputError
from topomerge.extraction.cleaning import MIDDLE
from topomerge.extraction.levelling import SLICE_HEIGHT
from topomerge.extraction.scan import Scan
from topomerge.kernels.rays import count_rays
from topomerge.types import Array, VoxelGrid

EXTRUDED_HEIGHT = 2.4  # m, of the walls that a slice becomes
RAISED_SHARE = 0.999  # of the columns of a raised plan are filled alike; of scans at most 0.6 were, usually a tenth
RAISED_LEVELS = 0.5  # of the levels of a raised wall are filled at least, whatever the size of the pixels
RAISED_FROM, BELOW_TOP = 0.5, 0.3  # m above the floor, and m below the top of the walls, between which these are looked at
WALL_THICKNESS = 1.0  # m: what is wider both ways is no wall, nor a row of legs
FLOOR_SHARE = 0.7  # of the columns of a floor lie in such areas; of slices 0 to 0.2 do
ENCLOSED_SHARE = 0.75  # of the directions in which a place inside sees a wall
SIGHT_DIRECTIONS = 24
SIGHT_RANGE = 15.0  # m
# A slice has one point in a column where a scan has dozens: a single one at the edge of a leaf became a wall that shut the door.
# Most missed doors of slices were shut so (docs/adr/0018).
SEEN_THROUGH = 20  # rays through a column for each that ends in it: what hangs there is no wall
FEW_POINTS = 0.25  # of the usual number in the columns around, where rays are unknown: likewise
COLUMNS_AROUND = 0.3  # m


def raise_slice(scan: Scan) -> Scan:
    """Give a scan that is a slice walls over its columns, and a floor; leave any other as it is, but for the walls of a raised
    plan, at which nobody needs to look closely.

    Raises:
        InputError: it is a floor, or a ceiling.
    """
    if not is_slice(scan.grid):
        return replace(scan, fine=None, raised=True) if is_raised(scan.grid) else scan
    if is_floor(scan.grid):
        flat = f"only a floor or a ceiling was seen (all within {SLICE_HEIGHT:g} m of height, over whole areas), and no walls"
        raise InputError(f"{flat}: rooms can't be told from it; give a scan that shows walls, too")
    warning = f"the scan is a slice: walls of {EXTRUDED_HEIGHT:g} m and a floor were assumed"
    return replace(scan.replace_grid(_extrude_slice(scan.grid, scan.rays), warning), fine=None)


def is_slice(grid: VoxelGrid) -> bool:
    """Return whether the scan is flat, but for single points."""
    if not len(grid):
        return False
    low, high = _measure_extent(grid)
    return (high - low) * grid.edge <= SLICE_HEIGHT


def is_floor(grid: VoxelGrid) -> bool:
    """Return whether what is flat fills areas, as a floor does, rather than lines, as the walls in a slice do."""
    seen = np.zeros(grid.shape[:2], bool)
    seen[tuple(grid.cells[:, :2].T)] = True
    size = 2 * round(WALL_THICKNESS / 2 / grid.edge) + 1
    seen = np.pad(seen, size)
    areas = ndimage.binary_opening(ndimage.binary_closing(seen, np.ones((3, 3))), np.ones((size, size)))
    return bool((areas & seen).sum() >= FLOOR_SHARE * seen.sum())


def is_raised(grid: VoxelGrid) -> bool:
    """Return whether the scan was a plan, of which every wall was raised alike. Then there are neither lintels nor leaves nor
    recesses."""
    if not len(grid):
        return False
    low, high = _measure_extent(grid)
    bottom, top = low + round(RAISED_FROM / grid.edge), high - round(BELOW_TOP / grid.edge)
    x, y, z = grid.cells.T
    standing = (z >= bottom) & (z < top)
    filled = np.bincount(x[standing].astype(np.int64) * grid.shape[1] + y[standing])
    filled = filled[filled > 0]
    most = filled.max(initial=0)  # not all levels where the picture's pixels are as large as the cells
    return bool(most >= RAISED_LEVELS * (top - bottom) > 0 and (filled == most).mean() >= RAISED_SHARE)


def _measure_extent(grid: VoxelGrid) -> tuple[int, int]:
    """Return the lowest and the highest level, but for single points."""
    below = np.cumsum(np.bincount(grid.cells[:, 2]))
    low, high = np.searchsorted(below, (int(0.01 * len(grid)), int(0.99 * (len(grid) - 1))), side="right").tolist()
    return low, high


def _extrude_slice(grid: VoxelGrid, rays: tuple[Array, Array] | None) -> VoxelGrid:
    """Build walls over the columns of a slice, and a floor where the sensor looked, or where walls are around.

    Args:
        grid: occupied cells.
        rays: (k, 3) places of the sensor and (k, 3) of what it saw, m, where they are known.
    """
    low, _ = _measure_extent(grid)
    columns, column = np.unique(grid.cells[:, :2], axis=0, return_inverse=True)
    points = np.zeros(grid.shape[:2], np.int64)
    count = grid.properties.get("count", np.ones(len(grid), np.int64))
    points[tuple(columns.T)] = np.bincount(column.ravel(), count)
    if rays is not None:
        passed, met = _count_column_rays(grid, *rays)
        wall, inside = (points > 0) & (passed <= SEEN_THROUGH * np.maximum(met, 1)), passed > 0
    else:
        wall = _find_filled_columns(points, grid.edge)
        inside = find_enclosed_columns(wall, grid.edge)
    inside = ndimage.binary_closing(np.pad(inside, 2), np.ones((3, 3)))[2:-2, 2:-2] & ~wall
    high = round(EXTRUDED_HEIGHT / grid.edge)
    levels = np.arange(low + 1, low + high)
    filled = wall[tuple(columns.T)]
    walls = np.column_stack([np.repeat(columns[filled], len(levels), axis=0), np.tile(levels, int(filled.sum()))])
    shape = (grid.shape[0], grid.shape[1], max(grid.shape[2], low + high + 1))
    floor = np.column_stack([np.argwhere(inside), np.full(int(inside.sum()), low)])
    offset = np.full((len(walls) + len(floor), 3), MIDDLE, np.uint8)
    if "offset" in grid.properties:  # a wall stands where the points of its column are
        many = np.bincount(column.ravel())
        for k in (0, 1):
            mean = np.bincount(column.ravel(), grid.properties["offset"][:, k]) / many
            offset[: len(walls), k] = np.repeat(mean[filled], len(levels))
    return VoxelGrid.from_cells(np.concatenate([walls, floor]), grid.origin, grid.edge, shape, {"offset": offset})


def _count_column_rays(grid: VoxelGrid, starts: Array, ends: Array) -> tuple[Array, Array]:
    """Return (nx, ny) how many rays go through each column and how many end in it, seen from above."""
    passed, met = np.zeros(grid.shape[:2], np.int32), np.zeros(grid.shape[:2], np.int32)
    at, to = ((np.asarray(p, np.float64)[:, :2] - grid.origin[:2]) / grid.edge for p in (starts, ends))
    count_rays(np.ascontiguousarray(at), np.ascontiguousarray(to), 1.0, passed, met)
    return passed, met


def _find_filled_columns(points: Array, edge: float) -> Array:
    """Return (nx, ny) columns that hold about as many points (nx, ny) as others around them: single ones hang in doorways."""
    size = 2 * round(COLUMNS_AROUND / edge) + 1
    some = points > 0
    near = ndimage.uniform_filter(some.astype(float), size, mode="constant")
    usual = ndimage.uniform_filter(points.astype(float), size, mode="constant") / np.maximum(near, 1e-9)
    return np.asarray(some & (points >= FEW_POINTS * usual))


def find_enclosed_columns(wall: Array, edge: float) -> Array:
    """Return (nx, ny) columns around which walls stand in most directions."""
    return np.asarray(count_walled_directions(wall, edge) >= ENCLOSED_SHARE * SIGHT_DIRECTIONS)


def count_walled_directions(wall: Array, edge: float) -> Array:
    """Return (nx, ny) int32 in how many of `SIGHT_DIRECTIONS` a wall stands, from each column."""
    hits = np.zeros(wall.shape, np.int32)
    far = round(SIGHT_RANGE / edge)
    for angle in np.arange(SIGHT_DIRECTIONS) * 2 * np.pi / SIGHT_DIRECTIONS:
        seen = wall.copy()  # swept along the direction: doubling the shift each time covers all distances
        step = 1
        reach = np.array([np.cos(angle), np.sin(angle)])
        while step < far:
            dx, dy = np.rint(reach * step).astype(int)
            seen |= _shift_mask(seen, int(dx), int(dy))
            step *= 2
        hits += seen
    return hits


def _shift_mask(mask: Array, dx: int, dy: int) -> Array:
    shifted = np.zeros_like(mask)
    nx, ny = mask.shape
    if abs(dx) < nx and abs(dy) < ny:
        shifted[max(dx, 0) : nx + min(dx, 0), max(dy, 0) : ny + min(dy, 0)] = mask[
            max(-dx, 0) : nx + min(-dx, 0), max(-dy, 0) : ny + min(-dy, 0)
        ]
    return shifted
