"""Storeys, levels at which much floor lies; and ceilings, which are none of them."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.convolution import Kernel, build_moore, is_any_at
from topomerge.extraction.morphology import is_surrounded, label_components
from topomerge.kernels.rasters import count_levels_below, find_first_occupied, is_hollow_below
from topomerge.types import STOREY_DTYPE, Array, VoxelGrid, select_lowest_of_column

# Storeys: levels at which much floor lies.

STOREY_LEAST_AREA = 3.0  # m2
STOREY_LEAST_SHARE = 0.01  # of the largest storey: a landing upstairs is one
HIGHEST_CEILING = 30.0  # m
STOREY_LEAST_HEIGHT = 1.9  # m between floors: nobody stands upright in less
GALLERY_LEAST_AREA = 10.0  # m2 that lie at its level, of a floor in the air: landings are smaller
IN_THE_AIR = 1.0  # m below the ceiling of the storey below
HALF_STOREY = 1.0  # m between floors, where one of them would be above others of its own storey
STACKED_SHARE = 0.4  # of the floor above others, at its level
HALF_LEVEL = 0.4  # m above halfway between two floors, up to which a half level is of the lower one
LEVEL_SHARE = 0.5  # of a floor that lies within a cell of its level; flights, what hangs and mirror images are spread


def find_storeys(navigable: VoxelGrid, floor_to_ceiling: Array) -> tuple[Array, Array]:
    """Return the peaks of the height histogram of the floor, at least 1.9 m apart. What hangs below the ceiling of the storey
    below, and is not level, is none: stairs with a landing in a hall through two storeys, and what glass mirrors.

    Args:
        navigable: the navigable volume.
        floor_to_ceiling: (m,) m of empty space above each navigable cell, 0 where nothing was seen.

    Returns:
        storeys (S,) STOREY_DTYPE, lowest first; (m,) int32 storey of each navigable cell: the one whose floor is nearest.
    """
    if not len(navigable):
        return np.zeros(0, STOREY_DTYPE), np.zeros(0, np.int32)
    lowest = select_lowest_of_column(navigable)
    level = navigable.cells[lowest, 2]
    area = np.bincount(level) * navigable.edge**2
    smooth = np.convolve(area, np.ones(3), "same")
    floors: list[int] = []
    largest = smooth.max()
    for z in np.argsort(-smooth, kind="stable"):
        if smooth[z] < min(max(STOREY_LEAST_AREA, STOREY_LEAST_SHARE * largest), largest):
            break
        if all(abs(int(z) - f) * navigable.edge >= STOREY_LEAST_HEIGHT for f in floors):
            floors.append(int(z))
    floors.sort()
    storeys, storey, level = _assign_storeys(navigable, lowest, floors, floor_to_ceiling)
    in_the_air = np.append(False, storeys["floor"][1:] < storeys["ceiling"][:-1] - IN_THE_AIR)
    none = in_the_air & (level < np.maximum(GALLERY_LEAST_AREA, LEVEL_SHARE * storeys["area"]))
    if none.any():
        floors = [z for z, gone in zip(floors, none, strict=True) if not gone]
        storeys, storey, _ = _assign_storeys(navigable, lowest, floors, floor_to_ceiling)
    while (half := _find_stacked_level(navigable, lowest, storey[lowest], floors)) is not None:
        floors = sorted([*floors, half])
        storeys, storey, _ = _assign_storeys(navigable, lowest, floors, floor_to_ceiling)
    return storeys, storey


def _find_stacked_level(navigable: VoxelGrid, lowest: Array, storey: Array, floors: list[int]) -> int | None:
    """Return the level of floor that lies above other floor of the same storey, as the half levels of one side of a house do;
    None where there is less of it than of a gallery, or where it is not level."""
    x, y, z = navigable.cells[lowest].T.astype(np.int64)
    order = np.lexsort((z, y, x, storey))
    same = (np.diff(np.column_stack([storey, x, y])[order], axis=0) == 0).all(axis=1)
    upper = z[order][1:][same & (np.diff(z[order]) * navigable.edge >= STOREY_LEAST_HEIGHT)]
    area = np.bincount(upper, minlength=3) * navigable.edge**2
    area[np.abs(np.arange(len(area))[:, None] - floors).min(axis=1) * navigable.edge < HALF_STOREY] = 0
    level = np.convolve(area, np.ones(3), "same")
    return int(level.argmax()) if level.max() >= max(GALLERY_LEAST_AREA, STACKED_SHARE * area.sum()) else None


def _assign_storeys(
    navigable: VoxelGrid, lowest: Array, floors: list[int], floor_to_ceiling: Array
) -> tuple[Array, Array, Array]:
    """Return the storeys of floors at these levels (ascending), the storey of each navigable cell, and how much of a storey's
    floor, m2, lies at its level."""
    halfway = (np.array(floors[:-1]) + np.array(floors[1:])) / 2
    cut = (np.abs(navigable.cells[lowest, 2] - halfway[:, None]) <= 1.5).sum(axis=1) * navigable.edge**2
    halfway += np.where(cut >= GALLERY_LEAST_AREA, HALF_LEVEL / navigable.edge, 0)  # half a level up lies a floor of its own
    storey = np.searchsorted(halfway, navigable.cells[:, 2]).astype(np.int32)
    storeys, level = np.zeros(len(floors), STOREY_DTYPE), np.zeros(len(floors))
    for s, z in enumerate(floors):
        rows = lowest[storey[lowest] == s]
        near = rows[np.abs(navigable.cells[rows, 2] - z) <= 1]
        level[s] = len(near) * navigable.edge**2
        near = near if len(near) else rows
        height = navigable.origin[2] + (navigable.cells[near, 2].mean() + 0.5) * navigable.edge
        ceiling = height + (estimate_ceiling_height(floor_to_ceiling[near]) or np.nan)
        storeys[s] = (height, ceiling, len(rows) * navigable.edge**2)
    return storeys, storey, level


def measure_floor_to_ceiling(grid: VoxelGrid, navigable: VoxelGrid, body_height: float, rows: Array | None = None) -> Array:
    """Return (m,) m of empty space between each navigable cell, or those of some rows, and the first occupied one above; 0: none
    is."""
    start = max(int(body_height / grid.edge), 1)
    limit = int(HIGHEST_CEILING / grid.edge)
    cells = navigable.cells if rows is None else navigable.cells[rows]
    return find_first_occupied(*grid._bricks, cells.astype(np.int64), start, 1, limit) * grid.edge


def estimate_ceiling_height(above: Array) -> float:
    """Return the median of the heights above a floor, 0 where less than a third of it has something above: lintels are no
    ceiling."""
    seen = above[above > 0]
    return float(np.median(seen)) if len(seen) * 3 >= len(above) > 0 else 0.0


# Keeping ceilings out of the navigable volume (the thesis' worst fault: findings.md, "Why the thesis fails").
#
# Seen from inside, a ceiling is a sheet with nothing above it: its upper side passes the stick kernel, and it is larger than the
# floor, which furniture interrupts.

HOLLOW_HEIGHT = 1.2  # m: empty space under a ceiling, above furniture
HOLLOW_SHARE = 0.5  # of a ceiling, between walls, that has such a space below it
STOREY_REACH = 8.0  # m: how far above a floor something may be, and how far below a ceiling its floor
SHEET_HEIGHT = 0.3  # m: a noisy sheet is this thick
SLAB_HEIGHT = 0.8  # m: so far below a ceiling's upper side, or a roof's, its lower side may be
SOLID_SHARE = 0.5  # share of the levels in the metre below that are occupied: a slab is thinner, a wall or a shelf is not
CARRIED = 0.5, 2.3  # m above the floor, of a sensor
NOWHERE = np.zeros((0, 3))
WALLED_SHARE = 0.25  # share of a floor's boundary beside which walls rise


def remove_ceilings(grid: VoxelGrid, standing: VoxelGrid, places: Array = NOWHERE) -> VoxelGrid:
    """Return the standing cells less those on the upper side of a ceiling or of a wall.

    A part of the standing cells with nothing above it is a ceiling if below most of it, walls left aside, is empty space and then
    something: of small flats half may lie over walls. The floor of an upper storey whose own ceiling was not scanned looks so,
    too; but walls rise along its boundary, and along a ceiling's they end. What the sensor was carried over is a roof terrace.

    Args:
        places: (n, 3) m, where the sensor was; may be empty.
    """
    cells = standing.cells.astype(np.int64)
    thick = max(int(np.ceil(SHEET_HEIGHT / grid.edge)), 1)
    far = int(np.ceil(STOREY_REACH / grid.edge))
    bare = find_first_occupied(*grid._bricks, cells, thick + 1, 1, far) == 0
    if not bare.any():
        return standing
    slab = int(np.ceil(SLAB_HEIGHT / grid.edge))
    hollow = is_hollow_below(*grid._bricks, cells, 1, slab, int(np.ceil(HOLLOW_HEIGHT / grid.edge)), far)
    component = label_components(standing, build_moore(), group=np.where(bare, 0, -1))
    count = int(component.max()) + 1
    boundary = np.flatnonzero(bare)
    boundary = boundary[~is_surrounded(standing, cells[boundary], 1)]
    walled = is_any_at(grid, cells[boundary], build_overhang_kernel(grid.edge))
    on_boundary = np.bincount(component[boundary], minlength=count)
    with_wall = np.bincount(component[boundary], walled, minlength=count)
    on_wall = _is_on_wall(grid, cells)
    between = bare & ~on_wall
    hollow_area, area = (np.bincount(component[rows], minlength=count) for rows in (between & hollow, between))
    ceiling = (hollow_area > HOLLOW_SHARE * area) & (with_wall < WALLED_SHARE * np.maximum(on_boundary, 1))
    ceiling[component[find_rows_below(standing, places)]] = False
    return standing.select_cells(~(bare & (ceiling[component] | on_wall)))


def find_rows_below(standing: VoxelGrid, places: Array) -> Array:
    """Return rows of the cells over which the sensor was carried, at (n, 3) places, m."""
    steps = np.arange(*np.rint(np.array(CARRIED) / standing.edge).astype(int))
    at = np.floor((places[np.isfinite(places).all(axis=1)] - standing.origin) / standing.edge)
    at = np.unique(at.astype(np.int64), axis=0)
    rows = standing.find_rows((at[:, None] - steps[:, None] * (0, 0, 1)).reshape(-1, 3))
    return rows[rows >= 0]


def _is_on_wall(grid: VoxelGrid, cells: Array) -> Array:
    """Return (m,) bool: is much of the metre below filled, here or in a neighbouring column?"""
    depth = max(int(1.0 / grid.edge), 1)
    return count_levels_below(*grid._bricks, cells, 1, depth) >= SOLID_SHARE * depth


def build_overhang_kernel(edge: float) -> Kernel:
    """Return cells within 0.35 m horizontally and 0.5 to 1.5 m above."""
    reach = int(np.ceil(0.35 / edge))
    steps = np.arange(-reach, reach + 1)
    heights = np.arange(int(np.ceil(0.5 / edge)), int(np.ceil(1.5 / edge)) + 1)
    return Kernel.from_offsets(np.stack(np.meshgrid(steps, steps, heights, indexing="ij"), -1).reshape(-1, 3))
