"""Keeping ceilings out of the navigable volume (the thesis' worst fault: findings.md, "Why the thesis fails").

Seen from inside, a ceiling is a sheet with nothing above it: its upper side passes the stick kernel, and it is larger than the
floor, which furniture interrupts.
"""

from __future__ import annotations

import numpy as np

from topomerge.extraction.components import connected_components
from topomerge.extraction.convolution import Kernel, any_at, moore
from topomerge.extraction.distance_field import on_all_sides
from topomerge.kernels.columns import first_occupied, hollow_below, levels_below
from topomerge.types import Array, VoxelGrid

HOLLOW_HEIGHT = 1.2  # m: empty space under a ceiling, above furniture
HOLLOW_SHARE = 0.5  # of a ceiling, between walls, that has such a space below it
STOREY_REACH = 8.0  # m: how far above a floor something may be, and how far below a ceiling its floor
SHEET_HEIGHT = 0.3  # m: a noisy sheet is this thick
SLAB_HEIGHT = 0.8  # m: so far below a ceiling's upper side, or a roof's, its lower side may be
SOLID_SHARE = 0.5  # share of the levels in the metre below that are occupied: a slab is thinner, a wall or a shelf is not
CARRIED = 0.5, 2.3  # m above the floor, of a sensor
NOWHERE = np.zeros((0, 3))
WALLED_SHARE = 0.25  # share of a floor's boundary beside which walls rise


def without_ceilings(grid: VoxelGrid, standing: VoxelGrid, places: Array = NOWHERE) -> VoxelGrid:
    """The standing cells less those on the upper side of a ceiling or of a wall.

    A part of the standing cells with nothing above it is a ceiling if below most of it, walls left aside, is empty space and then
    something: of small flats half may lie over walls. The floor of an upper storey whose own ceiling was not scanned looks so,
    too; but walls rise along its boundary, and along a ceiling's they end. What the sensor was carried over is a roof terrace.

    Args:
        places: (n, 3) m, where the sensor was; may be empty.
    """
    cells = standing.cells.astype(np.int64)
    thick = max(int(np.ceil(SHEET_HEIGHT / grid.edge)), 1)
    far = int(np.ceil(STOREY_REACH / grid.edge))
    bare = first_occupied(*grid._bricks, cells, thick + 1, 1, far) == 0
    if not bare.any():
        return standing
    slab = int(np.ceil(SLAB_HEIGHT / grid.edge))
    hollow = hollow_below(*grid._bricks, cells, 1, slab, int(np.ceil(HOLLOW_HEIGHT / grid.edge)), far)
    component = connected_components(standing, moore(), group=np.where(bare, 0, -1))
    count = int(component.max()) + 1
    boundary = np.flatnonzero(bare)
    boundary = boundary[~on_all_sides(standing, cells[boundary], 1)]
    walled = any_at(grid, cells[boundary], beside_and_above(grid.edge))
    on_boundary = np.bincount(component[boundary], minlength=count)
    with_wall = np.bincount(component[boundary], walled, minlength=count)
    on_wall = _on_a_wall(grid, cells)
    between = bare & ~on_wall
    hollow_area, area = (np.bincount(component[rows], minlength=count) for rows in (between & hollow, between))
    ceiling = (hollow_area > HOLLOW_SHARE * area) & (with_wall < WALLED_SHARE * np.maximum(on_boundary, 1))
    ceiling[component[rows_below(standing, places)]] = False
    return standing.subset(~(bare & (ceiling[component] | on_wall)))


def rows_below(standing: VoxelGrid, places: Array) -> Array:
    """Rows of the cells over which the sensor was carried, at (n, 3) places, m."""
    steps = np.arange(*np.rint(np.array(CARRIED) / standing.edge).astype(int))
    at = np.floor((places[np.isfinite(places).all(axis=1)] - standing.origin) / standing.edge)
    at = np.unique(at.astype(np.int64), axis=0)
    rows = standing.rows((at[:, None] - steps[:, None] * (0, 0, 1)).reshape(-1, 3))
    return rows[rows >= 0]


def _on_a_wall(grid: VoxelGrid, cells: Array) -> Array:
    """(m,) bool: is much of the metre below filled, here or in a neighbouring column?"""
    depth = max(int(1.0 / grid.edge), 1)
    return levels_below(*grid._bricks, cells, 1, depth) >= SOLID_SHARE * depth


def beside_and_above(edge: float) -> Kernel:
    """Cells within 0.35 m horizontally and 0.5 to 1.5 m above."""
    reach = int(np.ceil(0.35 / edge))
    steps = np.arange(-reach, reach + 1)
    heights = np.arange(int(np.ceil(0.5 / edge)), int(np.ceil(1.5 / edge)) + 1)
    return Kernel.from_offsets(np.stack(np.meshgrid(steps, steps, heights, indexing="ij"), -1).reshape(-1, 3))
