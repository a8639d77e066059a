"""Map -> plans: what each storey shows from above. Walls, empty space and clutter are what registration goes by (method 4).

A *wall* column is filled at most of the heights between 0.5 and 2.0 m above the floor; a *free* one has a floor or a ceiling and
nothing between, or rays crossed it; the rest of the occupied ones are *clutter*. Works for scans, extruded drawings, and slices.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy import ndimage

from topomerge.errors import InputError
from topomerge.extraction.plans.storey_plan import (
    BODY_HEIGHTS,
    HEIGHT_BANDS,
    WALL_HEIGHTS,
    WALL_RULE,
    StoreyPlan,
    band_stack,
    observed_bands,
    wall_columns,
)
from topomerge.fusion.storey_levels import SLICE_HEIGHT, extruded, levels, lines_of, slices
from topomerge.kernels.plan import column_bits, on_lines
from topomerge.types import Array, TopometricMap, VoxelGrid

COLUMN_EDGE = 0.1  # m
BODY_BANDS = np.concatenate([[BODY_HEIGHTS[0]], WALL_HEIGHTS])  # m, limits of the bands in which a map may have looked
SLICE_ABOVE_FLOOR = 0.3  # m, guess of a slice's height above the floor
SLICE_DRAWN = 1.375  # m above the floor, height at which slices are drawn
SLAB = 0.1  # m between a ceiling and the floor above it, at least: that floor is no ceiling
FLOOR_RADIUS = 1.5  # m, over which the floor may rise and fall
STRAIGHT_RUN = 1.2  # m; what a slice shows in no straight run of this length is furniture
BESIDE_RUN = 0.35  # m from such a run, and on one side of it at least, hardly anything stands


def plans(map: TopometricMap | VoxelGrid, free: VoxelGrid | None = None, cell: float = COLUMN_EDGE) -> list[StoreyPlan]:
    """The storeys of a map, lowest first.

    Args:
        map: a topometric map (its `free` is used) or occupied cells.
        free: cells known to be empty.
        cell: edge length of a column, m; never below that of the map's cells.

    Raises:
        InputError: the map has no cells.
    """
    grid = map.grid if isinstance(map, TopometricMap) else map
    free = map.free if isinstance(map, TopometricMap) and free is None else free
    if not len(grid):
        raise InputError("the map has no occupied cells: there is nothing to register")
    if extruded(grid):
        grid, free = lines_of(grid)
    cell = max(cell, grid.edge)
    points = grid.centroids()  # as the verdict was fitted: to half a cell
    corner = grid.origin[:2]  # columns are those of the cells: on another lattice some get two rows of cells, and some none
    low = np.floor((points[:, :2].min(axis=0) - corner) / cell + 1e-6).astype(np.int64)
    columns = np.floor((points[:, :2] - corner) / cell + 1e-6).astype(np.int64) - low
    corner = corner + low * cell
    shape = tuple((columns.max(axis=0) + 1).tolist())
    ix, iy = np.ascontiguousarray(columns.T)
    empty = None if free is None or not len(free) else _crossed(free, corner, cell)
    layers, storeys_seen = slices(grid), []
    storeys = [(z - SLICE_ABOVE_FLOOR, np.nan, z - SLICE_DRAWN) for z in layers] if layers else levels(grid)
    above = [base for _, _, base in storeys[1:]] + [np.inf]
    for (floor, ceiling, base), next_floor in zip(storeys, above, strict=True):
        z, crossing = points[:, 2], empty
        if layers:  # all that is near the layer is drawn at one height
            level = base + SLICE_DRAWN
            z = np.where(np.abs(z - level) <= SLICE_HEIGHT / 2, level, np.nan)
            crossing = empty and (*empty[:2], np.where(np.abs(empty[2] - level) <= SLICE_HEIGHT / 2, level, np.nan))
        heights = np.full(shape, base)
        if np.isfinite(floor) and not layers:
            heights = _local_floor(ix, iy, z, heights)
        lattice = (heights, -HEIGHT_BANDS.below * HEIGHT_BANDS.step, HEIGHT_BANDS.step)
        occupied = column_bits(ix, iy, z, *lattice)
        crossed = column_bits(*crossing, *lattice) if crossing else np.zeros(shape, np.uint32)
        high = _ceiling(ix, iy, np.where(z < next_floor - SLAB, z, np.nan), base, ceiling, shape)
        rasters = (occupied, crossed, heights, high - heights)
        storeys_seen.append(_plan(rasters, corner, cell, (floor, ceiling), bool(layers)))
    return storeys_seen


def _crossed(free: VoxelGrid, corner: Array, cell: float) -> tuple[Array, Array, Array]:
    """Columns ix, iy and heights, m, of empty cells; one that is wider than a column is in several."""
    side = max(round(free.edge / cell), 1)
    at = free.centroids()
    steps = (np.arange(side) - (side - 1) / 2) * free.edge / side
    parts = [np.floor((at[:, :2] + (dx, dy) - corner) / cell + 1e-6).astype(np.int64) for dx in steps for dy in steps]
    ix, iy = np.ascontiguousarray(np.concatenate(parts).T)
    return ix, iy, np.tile(at[:, 2], side**2)


def _local_floor(ix: Array, iy: Array, z: Array, heights: Array) -> Array:
    """The floor under each column: drift and a tilted map raise and lower it by a few centimetres."""
    near = np.abs(z - heights[ix, iy]) < 0.3
    lowest = np.full(heights.shape, np.inf)
    np.minimum.at(lowest, (ix[near], iy[near]), z[near])
    seen = np.isfinite(lowest)
    weight = seen.astype(np.float32)
    total = np.where(seen, lowest - heights, 0.0).astype(np.float32)
    cells = FLOOR_RADIUS / COLUMN_EDGE
    weight, total = (ndimage.gaussian_filter(i, cells, truncate=2.0) for i in (weight, total))
    return heights + np.where(weight > 0.02, total / np.maximum(weight, 1e-6), 0.0)


def _ceiling(ix: Array, iy: Array, z: Array, base: float, ceiling: float, shape: tuple[int, ...]) -> Array:
    """(H, W) m: the highest cell of each column that may be this storey's ceiling; nan where none is."""
    high = np.full(shape, -np.inf)
    if np.isfinite(ceiling):
        near = (z > base + 2.0) & (z < ceiling + 1.0)
        np.maximum.at(high, (ix[near], iy[near]), z[near])
    return np.where(np.isfinite(high), high, np.nan)


def _plan(rasters: tuple[Array, ...], origin: Array, cell: float, levels: tuple[float, float], sliced: bool) -> StoreyPlan:
    """The plan of a storey.

    Args:
        rasters: (nx, ny) each: bits of the bands that cells fill and that rays crossed; height of the floor, m, and of the
            ceiling above it.
        levels: m, heights of the storey's floor and ceiling.
        sliced: was it seen at one height only?
    """
    occupied, crossed, floor, ceiling = rasters
    filled = band_stack(occupied, HEIGHT_BANDS, BODY_BANDS)
    looked = observed_bands(filled)
    masks = [HEIGHT_BANDS.mask(low, high) for low, high in pairwise(BODY_BANDS)]
    observed = sum(mask for mask, seen in zip(masks, looked.tolist(), strict=True) if seen)
    wall = wall_columns(filled[1:][looked[1:]], WALL_RULE)
    standing = filled.any(axis=0)
    shut = (occupied & ~np.uint32(HEIGHT_BANDS.mask(*BODY_HEIGHTS))) > 0
    rays = np.bitwise_count(crossed & np.uint32(HEIGHT_BANDS.mask(*BODY_HEIGHTS))) >= max(int(looked.sum()) // 2, 1)
    if sliced:
        wall = _straight(wall, cell)
    inside = ~wall & (standing | rays | (shut & (not sliced)))
    return StoreyPlan(
        origin, cell, wall, inside, occupied, HEIGHT_BANDS, floor, ceiling, levels=levels, observed=observed, sliced=sliced
    )


def _straight(mask: Array, cell: float) -> Array:
    """What a slice shows of walls: straight runs beside which little stands. Legs and chairs are as dense, but stand in heaps."""
    angles = np.pi * np.arange(24) / 24
    long = max(round(STRAIGHT_RUN / cell), 3)
    straight: Array = on_lines(mask, np.cos(angles), np.sin(angles), long, long - 1, max(round(BESIDE_RUN / cell), 2))
    return straight
