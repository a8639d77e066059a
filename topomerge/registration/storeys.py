"""Storeys of a map seen from above: walls, empty space and clutter, by which registration goes (method 4).

Storeys are found by their floors and ceilings, by layers of slices, or by lines that were given walls. A *wall* column is filled
at most of the heights between 0.5 and 2.0 m above the floor; a *free* one has a floor or a ceiling and nothing between, or rays
crossed it; the rest of the occupied ones are *clutter*. Works for scans, extruded drawings, and slices."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy import ndimage

from topomerge.errors import InputError
from topomerge.extraction.plans.storey_plan import (
    BODY_HEIGHTS,
    HEIGHT_BANDS,
    USUAL_HEIGHT,
    WALL_HEIGHTS,
    WALL_RULE,
    StoreyPlan,
    build_band_stack,
    detect_wall_columns,
    is_observed_band,
)
from topomerge.kernels.rasters import compute_column_bits, find_line_columns
from topomerge.types import Array, TopometricMap, VoxelGrid, compute_extent

STOREY_GAP = 1.9  # m of empty height between a floor and its ceiling
STOREY_LEAST_AREA = 3.0  # m2
STOREY_LEAST_SHARE = 0.08  # of the largest storey's area
SLICE_HEIGHT = 0.6  # m; a map that is not higher is a slice
LOWEST_EXTRUDED = 1.2  # m, of levels of one size: a map of lines that were given walls has walls that high, at least
LAYER_SHARE = 0.1  # of the cells that a layer of a map of slices holds at least
COLUMN_EDGE = 0.1  # m
BODY_BANDS = np.concatenate([[BODY_HEIGHTS[0]], WALL_HEIGHTS])  # m, limits of the bands in which a map may have looked
SLICE_ABOVE_FLOOR = 0.3  # m, guess of a slice's height above the floor
SLICE_DRAWN = 1.375  # m above the floor, height at which slices are drawn
SLAB = 0.1  # m between a ceiling and the floor above it, at least: that floor is no ceiling
FLOOR_RADIUS = 1.5  # m, over which the floor may rise and fall
STRAIGHT_RUN = 1.2  # m; what a slice shows in no straight run of this length is furniture
BESIDE_RUN = 0.35  # m from such a run, and on one side of it at least, hardly anything stands


def is_extruded(grid: VoxelGrid) -> bool:
    """Return whether a map was made from lines, which were given walls. Then all of its levels but the lowest hold the same
    columns."""
    if not len(grid):
        return False
    level = grid.cells[:, 2] - grid.cells[:, 2].min()
    counts = np.bincount(level)[1:]
    if len(counts) * grid.edge < LOWEST_EXTRUDED or (counts != counts[0]).any():
        return False
    first = grid.cells[level == 1, :2]
    return all(np.array_equal(grid.cells[level == k, :2], first) for k in range(2, len(counts) + 1))


def extract_lines(grid: VoxelGrid) -> tuple[VoxelGrid, VoxelGrid]:
    """Return the lines of such a map at the height of the floor that it was given, where its sensor looked; and that floor, over
    which it looked."""
    level = grid.cells[:, 2] - grid.cells[:, 2].min()
    lines, floor = grid.cells[level == 1] - (0, 0, 1), grid.cells[level == 0]
    drawn = VoxelGrid.from_cells(lines, grid.origin, grid.edge, grid.shape)
    return drawn, VoxelGrid.from_cells(floor[~drawn.contains(floor)], grid.origin, grid.edge, grid.shape)


def find_slices(grid: VoxelGrid) -> list[float]:
    """Find the heights of the layers of a map that was seen at one height a storey only, lowest first; none for other maps.

    Nearly all cells lie in a few thin layers, and these show lines, where floors and ceilings would show areas.
    """
    z = grid.compute_centroids()[:, 2]
    if float(np.ptp(z)) + grid.edge <= SLICE_HEIGHT:
        return [] if _filled(grid.cells, grid.edge) else [float(np.median(z))]
    thick = max(round(SLICE_HEIGHT / 2 / grid.edge), 1)
    counts = np.convolve(np.bincount(grid.cells[:, 2], minlength=grid.shape[2]), np.ones(thick), "same")
    layers: list[int] = []
    for k in np.argsort(-counts, kind="stable"):
        if counts[k] < LAYER_SHARE * len(grid):
            break
        if all(abs(int(k) - other) * grid.edge >= STOREY_GAP for other in layers):
            layers.append(int(k))
    inside = [np.abs(grid.cells[:, 2] - k) <= thick / 2 for k in layers]
    if not layers or sum(int(i.sum()) for i in inside) < 0.7 * len(grid):
        return []
    if _filled(grid.cells[np.logical_or.reduce(inside)], grid.edge):
        return []
    return sorted(float(np.median(z[i])) for i in inside)


def _filled(cells: Array, edge: float) -> bool:
    """Return whether cells fill areas, seen from above, or only draw lines."""
    flat = cells[:, :2].astype(np.int64)
    columns = len(np.unique(flat[:, 0] << 32 | flat[:, 1]))
    side = max(round(0.5 / edge), 1)
    blocks = len(np.unique((flat[:, 0] // side) << 32 | (flat[:, 1] // side)))
    return columns > 0.6 * blocks * side**2


def find_levels(grid: VoxelGrid) -> list[tuple[float, float, float]]:
    """Find (floor, ceiling, base) of each storey, m, lowest first: nan where not seen; bands are counted from the base.

    A floor and its ceiling bound empty columns; where hardly any column has both, the largest level is a floor if most of the
    map lies above it, else a ceiling.
    """
    bottom, top = _find_gaps(grid)
    columns = len(np.unique(grid.cells[:, 0].astype(np.int64) * grid.shape[1] + grid.cells[:, 1]))
    if len(bottom) > 0.15 * columns:
        storeys = _find_closed_storeys(grid, bottom, top)
        if storeys:
            return storeys
    area = np.convolve(np.bincount(grid.cells[:, 2], minlength=grid.shape[2]), np.ones(3), "same")
    level = int(area.argmax())
    z = grid.origin[2] + (level + 0.5) * grid.edge
    above, below = int((grid.cells[:, 2] > level + 2).sum()), int((grid.cells[:, 2] < level - 2).sum())
    return [(z, np.nan, z)] if above >= below else [(np.nan, z, z - USUAL_HEIGHT)]


def _find_gaps(grid: VoxelGrid) -> tuple[Array, Array]:
    """Return the levels of the cells below and above each run of empty cells of at least `STOREY_GAP` in a column."""
    x, y, z = grid.cells.T.astype(np.int64)
    key = np.sort((x * grid.shape[1] + y) * (1 << 21) + z)
    step = np.diff(key)
    wide = (step > STOREY_GAP / grid.edge) & (key[1:] >> 21 == key[:-1] >> 21)
    mask = (1 << 21) - 1
    return key[:-1][wide] & mask, key[1:][wide] & mask


def _find_closed_storeys(grid: VoxelGrid, bottom: Array, top: Array) -> list[tuple[float, float, float]]:
    area = np.convolve(np.bincount(bottom, minlength=grid.shape[2]).astype(float), np.ones(3), "same") * grid.edge**2
    least = min(max(STOREY_LEAST_AREA, STOREY_LEAST_SHARE * area.max()), area.max())
    floors: list[int] = []
    level = np.bincount(grid.cells[:, 2], minlength=grid.shape[2])
    near, far = round(0.3 / grid.edge), round(1.6 / grid.edge)
    for z in np.argsort(-area, kind="stable"):
        if area[z] < least:
            break
        # An upper side of a ceiling, as a map shows that lacks all that is low, has hardly anything standing on it.
        hollow = level[z + near : z + far].sum() < 0.5 * level[max(z - far, 0) : max(z - near, 0)].sum()
        if not hollow and all(abs(int(z) - f) * grid.edge >= STOREY_GAP for f in floors):
            floors.append(int(z))
    storeys = []
    for z in sorted(floors):
        near = np.abs(bottom - z) * grid.edge <= 0.25
        floor = grid.origin[2] + (float(bottom[near].mean()) + 0.5) * grid.edge
        ceiling = grid.origin[2] + (float(np.median(top[near])) + 0.5) * grid.edge
        storeys.append((floor, ceiling, floor))
    return storeys


def build_plans(map: TopometricMap | VoxelGrid, free: VoxelGrid | None = None, cell: float = COLUMN_EDGE) -> list[StoreyPlan]:
    """Return the storeys of a map, lowest first.

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
    if is_extruded(grid):
        grid, free = extract_lines(grid)
    cell = max(cell, grid.edge)
    points = grid.compute_centroids()  # as the verdict was fitted: to half a cell
    corner = grid.origin[:2]  # columns are those of the cells: on another lattice some get two rows of cells, and some none
    low = np.floor((compute_extent(points[:, :2])[0] - corner) / cell + 1e-6).astype(np.int64)
    columns = np.floor((points[:, :2] - corner) / cell + 1e-6).astype(np.int64) - low
    corner = corner + low * cell
    shape = tuple((compute_extent(columns)[1] + 1).tolist())
    ix, iy = np.ascontiguousarray(columns.T)
    empty = None if free is None or not len(free) else _find_crossed_columns(free, corner, cell)
    layers, storeys_seen = find_slices(grid), []
    storeys = [(z - SLICE_ABOVE_FLOOR, np.nan, z - SLICE_DRAWN) for z in layers] if layers else find_levels(grid)
    above = [base for _, _, base in storeys[1:]] + [np.inf]
    for (floor, ceiling, base), next_floor in zip(storeys, above, strict=True):
        z, crossing = np.ascontiguousarray(points[:, 2]), empty
        if layers:  # all that is near the layer is drawn at one height
            level = base + SLICE_DRAWN
            z = np.where(np.abs(z - level) <= SLICE_HEIGHT / 2, level, np.nan)
            crossing = empty and (*empty[:2], np.where(np.abs(empty[2] - level) <= SLICE_HEIGHT / 2, level, np.nan))
        heights = np.full(shape, base)
        if np.isfinite(floor) and not layers:
            heights = _estimate_local_floor(ix, iy, z, heights)
        lattice = (heights, -HEIGHT_BANDS.below * HEIGHT_BANDS.step, HEIGHT_BANDS.step)
        occupied = compute_column_bits(ix, iy, z, *lattice)
        crossed = compute_column_bits(*crossing, *lattice) if crossing else np.zeros(shape, np.uint32)
        # Without the limit the highest thing of a room below another storey was the floor above (docs/adr/0015).
        high = _estimate_ceiling(ix, iy, np.where(z < next_floor - SLAB, z, np.nan), base, ceiling, shape)
        rasters = (occupied, crossed, heights, high - heights)
        storeys_seen.append(_build_plan(rasters, corner, cell, (floor, ceiling), bool(layers)))
    return storeys_seen


def _find_crossed_columns(free: VoxelGrid, corner: Array, cell: float) -> tuple[Array, Array, Array]:
    """Return the columns ix, iy and heights, m, of empty cells; one that is wider than a column is in several."""
    side = max(round(free.edge / cell), 1)
    at = free.compute_centroids()
    steps = (np.arange(side) - (side - 1) / 2) * free.edge / side
    parts = [np.floor((at[:, :2] + (dx, dy) - corner) / cell + 1e-6).astype(np.int64) for dx in steps for dy in steps]
    ix, iy = np.ascontiguousarray(np.concatenate(parts).T)
    return ix, iy, np.tile(at[:, 2], side**2)


def _estimate_local_floor(ix: Array, iy: Array, z: Array, heights: Array) -> Array:
    """Return the floor under each column: drift and a tilted map raise and lower it by a few centimetres."""
    near = np.abs(z - heights[ix, iy]) < 0.3
    lowest = np.full(heights.shape, np.inf)
    np.minimum.at(lowest, (ix[near], iy[near]), z[near])
    seen = np.isfinite(lowest)
    weight = seen.astype(np.float32)
    total = np.where(seen, lowest - heights, 0.0).astype(np.float32)
    cells = FLOOR_RADIUS / COLUMN_EDGE
    weight, total = (ndimage.gaussian_filter(i, cells, truncate=2.0) for i in (weight, total))
    return heights + np.where(weight > 0.02, total / np.maximum(weight, 1e-6), 0.0)


def _estimate_ceiling(ix: Array, iy: Array, z: Array, base: float, ceiling: float, shape: tuple[int, ...]) -> Array:
    """Return (H, W) m: the highest cell of each column that may be this storey's ceiling; nan where none is."""
    high = np.full(shape, -np.inf)
    if np.isfinite(ceiling):
        near = (z > base + 2.0) & (z < ceiling + 1.0)
        np.maximum.at(high, (ix[near], iy[near]), z[near])
    return np.where(np.isfinite(high), high, np.nan)


def _build_plan(rasters: tuple[Array, ...], origin: Array, cell: float, levels: tuple[float, float], sliced: bool) -> StoreyPlan:
    """Return the plan of a storey.

    Args:
        rasters: (nx, ny) each: bits of the bands that cells fill and that rays crossed; height of the floor, m, and of the
            ceiling above it.
        levels: m, heights of the storey's floor and ceiling.
        sliced: was it seen at one height only?
    """
    occupied, crossed, floor, ceiling = rasters
    filled = build_band_stack(occupied, HEIGHT_BANDS, BODY_BANDS)
    examined = is_observed_band(filled)
    masks = [HEIGHT_BANDS.build_mask(low, high) for low, high in pairwise(BODY_BANDS)]
    observed = sum(mask for mask, seen in zip(masks, examined.tolist(), strict=True) if seen)
    wall = detect_wall_columns(filled[1:][examined[1:]], WALL_RULE)
    standing = filled.any(axis=0)
    shut = (occupied & ~np.uint32(HEIGHT_BANDS.build_mask(*BODY_HEIGHTS))) > 0
    rays = np.bitwise_count(crossed & np.uint32(HEIGHT_BANDS.build_mask(*BODY_HEIGHTS))) >= max(int(examined.sum()) // 2, 1)
    if sliced:
        wall = _find_straight_runs(wall, cell)
    inside = ~wall & (standing | rays | (shut & (not sliced)))
    return StoreyPlan(
        origin, cell, wall, inside, occupied, HEIGHT_BANDS, floor, ceiling, levels=levels, observed=observed, sliced=sliced
    )


def _find_straight_runs(mask: Array, cell: float) -> Array:
    """Find the walls in a slice: straight runs beside which little stands. Legs and chairs are as dense, but stand in heaps."""
    angles = np.pi * np.arange(24) / 24
    long = max(round(STRAIGHT_RUN / cell), 3)
    straight: Array = find_line_columns(mask, np.cos(angles), np.sin(angles), long, long - 1, max(round(BESIDE_RUN / cell), 2))
    return straight
