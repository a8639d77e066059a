"""A storey seen from above: its floor, its walls, its ceiling and where it is open, a raster of columns (beyond the thesis).

Rooms end at walls, whatever stands in them: furniture hides the floor and obstructs the body of the stick kernel, but a wall
alone fills a column up to the ceiling (findings.md, "Rooms").
"""

from __future__ import annotations

import edt
import numpy as np
from scipy import ndimage

from topomerge.extraction.plans.plan_network import COARSEST_STRIDE
from topomerge.extraction.plans.storey_plan import (
    WALL_HEIGHTS,
    HeightBands,
    StoreyPlan,
    WallRule,
    build_band_stack,
    detect_wall_columns,
    find_first_above,
    is_observed_band,
)
from topomerge.extraction.slices import SIGHT_DIRECTIONS, count_walled_directions, find_enclosed_columns
from topomerge.extraction.storeys import CARRIED, HIGHEST_CEILING, NOWHERE, STOREY_LEAST_HEIGHT
from topomerge.kernels.rasters import PROFILE_BELOW, PROFILE_LEVELS, fill_profiles, find_first_occupied, is_hollow_below
from topomerge.types import Array, VoxelGrid, are_within, compute_extent, select_lowest_of_column

ROOM_WALLS = WallRule(least_bands=3)  # fewer bands show the upper side of a ceiling, beside higher ones
THIN = 0.4  # share of the usual wall's levels: what has fewer is no wall
ROOFLESS_SHARE = 0.1  # of the floor that was seen, over which something is: less, and the scan has no ceiling
FURNITURE_HEIGHTS = 0.25, 1.9  # m above the floor
OVER_FURNITURE = 2.05  # m: cupboards end below
BLOCK = 0.5  # m: ceilings are measured on tiles of this size
CLUTTER = 0.9  # m: free-standing pieces of wall shorter than this are pillars and the like
FLOOR_REACH = 1.5  # m: so far from a seen floor a column still has its height
COVERED_REACH = 3.0  # m: likewise where something is above it
LOOKED_THROUGH = 0.4, 1.9  # m above the floor, where rays say that a column is empty
LONGEST_CROSSED = 0.3  # m: longer free cells reach from wall to wall
OVER_LEVEL = 0.3  # m: what is higher above a storey's level does not lie in its floor
LEAST_FLOOR = 0.5  # m2 of seen floor in a part
HOLE = 4.0  # m2: gaps this small in what is known are filled
TOUCHES = 0.25  # m: pieces this close to a longer wall belong to it
# About where somebody can stand. When plans ended there everywhere, 30 of the 45 rooms that flats lost were no part of them: now
# they go on to what has a ceiling or was looked through (docs/adr/0004).
PLAN_MARGIN = 0.6  # m
LEAST_SLAB = 0.1  # m at least, between a ceiling and the floor above it


def locate_columns(plan: StoreyPlan, grid: VoxelGrid) -> tuple[Array, Array]:
    """Return where a plan lies in the grid that it was made of: (2,) int64 column that is element (0, 0), and (nx, ny) int64
    level of the floor."""
    low = np.rint((plan.origin - grid.origin[:2]) / plan.edge).astype(np.int64)
    return low, np.rint((plan.floor - grid.origin[2]) / plan.edge - 0.5).astype(np.int64)


def build_storey_plan(
    grid: VoxelGrid, navigable: VoxelGrid, storey: Array, k: int, crossed: VoxelGrid | None = None
) -> StoreyPlan:
    """Return the plan of storey `k`.

    Args:
        grid: occupied cells.
        navigable: the navigable volume.
        storey: (m,) storey of each of its cells.
        crossed: cells that the sensor looked through, where that is known: there is a room, though neither its floor nor its
            ceiling was seen.
    """
    e = grid.edge
    floor = select_lowest_of_column(navigable)
    cells = navigable.cells[floor].astype(np.int64)
    mine = cells[storey[floor] == k]
    # Whole strides of the network and whole ceiling tiles: where columns lie decides single rooms (docs/adr/0004).
    margin, steps = int(np.ceil(PLAN_MARGIN / e)), int(np.lcm(COARSEST_STRIDE, _compute_tile_size(e)))
    far_off = -(-(round(COVERED_REACH / e) + margin) // steps) * steps
    lowest, highest = compute_extent(mine[:, :2])
    first, last = lowest - margin, highest + margin
    low, high = first - far_off, last + far_off
    size = high + 1 - low
    base, seen, far = _interpolate_heights(mine, low, size)
    above = cells[storey[floor] == k + 1]
    top = base + PROFILE_LEVELS
    if len(above):
        nominal = int(np.median(above[:, 2]))
        upper, _, near = _interpolate_heights(above[_is_within(above[:, :2] - low, size)], low, size, nominal)
        upper = np.where(near * e < 1.0, upper, nominal)
        ends = (near * e < 1.0) | ((upper - base) * e >= STOREY_LEAST_HEIGHT)  # not so over half levels
        # The floor of the storey above would be taken for this one's ceiling (docs/adr/0015).
        top = np.where(ends, np.minimum(top, upper - int(np.ceil(LEAST_SLAB / e))), top)
    profile = np.zeros(size, np.uint64)
    fill_profiles(grid.cells, low, base, top, profile)
    bands = build_profile_bands(e)
    wall_like = _is_filled_like_wall(profile, bands)
    clear = find_first_above(profile, bands)
    ceiling = _estimate_ceiling(np.where(wall_like, np.nan, clear), e)
    # Cupboards: the ceiling was seen above them (docs/adr/0004).
    wall = wall_like & ~_is_below_ceiling(profile, ceiling, e)
    # Points that hang in a doorway of a slice would move its door by .3 m (docs/adr/0026).
    wall = _remove_clutter(ndimage.binary_closing(wall, np.ones((3, 3)), border_value=0) | wall, e)
    on_floor = (profile & np.uint64(bands.build_mask(-0.3, 0.3))) != 0
    # What hangs over the hall of the storey below is no floor of this one (docs/adr/0004).
    reach = np.where(_is_open_below(grid, cells[storey[floor] == k - 1], low, base), FLOOR_REACH, COVERED_REACH)
    covered = ~np.isnan(clear)
    if covered[seen].sum() < ROOFLESS_SHARE * seen.sum():  # the scan ends below the ceiling, but furniture stands on floor
        covered |= ((profile & np.uint64(bands.build_mask(*FURNITURE_HEIGHTS))) != 0) & find_enclosed_columns(wall, e)
    # A depth camera sees neither floor nor ceiling of a bath, but its rays cross it (docs/adr/0004).
    if crossed is not None:
        covered |= _is_seen_through(crossed, grid, low, base) & find_enclosed_columns(
            wall, e
        )  # what lies before windows is no room
    inside = seen | (on_floor & (far * e <= FLOOR_REACH)) | (covered & (far * e <= reach))
    inside = _fill_holes(inside, wall, on_floor & (far * e <= FLOOR_REACH), covered, e) & (far * e <= COVERED_REACH)
    box = _find_box_around(inside, first - low, last - low, margin)
    origin = grid.origin[:2] + (low + [side.start for side in box]) * e
    floor, height = grid.origin[2] + (base[box] + 0.5) * e, (top - base)[box] * e
    return StoreyPlan(origin, e, wall[box], inside[box], profile[box], bands, floor, ceiling[box], height)


def _find_box_around(inside: Array, first: Array, last: Array, margin: int) -> tuple[slice, slice]:
    """Return the part of a raster from columns `first` to `last`, and `margin` columns beyond where what is inside reaches
    further.

    At its beginning it grows by whole strides of the plan network, which so sees all else as it would without.
    """
    box = []
    for axis in (0, 1):
        at = np.flatnonzero(inside.any(axis=1 - axis))
        begin, end = int(first[axis]), int(last[axis])
        if len(at) and at[0] < begin:
            begin -= -(-(begin - int(at[0]) + margin) // COARSEST_STRIDE) * COARSEST_STRIDE
        if len(at) and at[-1] > end:
            end = int(at[-1]) + margin
        box.append(slice(begin, end + 1))
    return box[0], box[1]


def _is_within(at: Array, size: Array) -> Array:
    return are_within(at, 0, size)


def _interpolate_heights(cells: Array, low: Array, size: Array, nominal: int = 0) -> tuple[Array, Array, Array]:
    """Return the level of the nearest of the given floor cells, where there is one, and how many columns away it is."""
    if not len(cells):
        return np.full(size, nominal), np.zeros(size, bool), np.full(size, 1e9)
    order = np.argsort(-cells[:, 2], kind="stable")  # the lowest is written last
    at = tuple((cells[order, :2] - low).T)
    base = np.zeros(size, np.int64)
    base[at] = cells[order, 2]
    seen = np.zeros(size, bool)
    seen[at] = True
    far, nearest = ndimage.distance_transform_edt(~seen, return_indices=True)
    return base[tuple(nearest)], seen, far


def _is_open_below(grid: VoxelGrid, lower: Array, low: Array, base: Array) -> Array:
    """Return (nx, ny) bool: does the floor of the storey below, (n, 3) cells, see past the level of this one's? A hall through
    both."""
    out = np.zeros(base.shape, bool)
    lower = np.ascontiguousarray(lower[_is_within(lower[:, :2] - low, np.array(base.shape))])
    at = tuple((lower[:, :2] - low).T)
    upright, highest = round(STOREY_LEAST_HEIGHT / grid.edge), round(HIGHEST_CEILING / grid.edge)
    free = find_first_occupied(*grid._bricks, lower, upright, 1, highest)
    out[at] = (free == 0) | (lower[:, 2] + free > base[at] + round(OVER_LEVEL / grid.edge))
    return out


def _is_seen_through(crossed: VoxelGrid, grid: VoxelGrid, low: Array, base: Array) -> Array:
    """Return (nx, ny) bool: did rays cross two free cells or more of a column at the height of a body?"""
    count = np.zeros(base.size, np.int64)
    if crossed.edge > LONGEST_CROSSED:
        return count.reshape(base.shape) > 0
    parts = max(round(crossed.edge / grid.edge), 1)  # columns a side that lie in a free cell
    height = (crossed.cells[:, 2] + 0.5) * (crossed.edge / grid.edge)
    for part in np.argwhere(np.ones((parts, parts), bool)):
        at = np.floor((crossed.cells[:, :2] + (part + 0.5) / parts) * (crossed.edge / grid.edge)).astype(np.int64) - low
        within = _is_within(at, np.array(base.shape))
        column = at[within, 0] * base.shape[1] + at[within, 1]
        above = (height[within] - base.ravel()[column]) * grid.edge
        count += np.bincount(column[(above > LOOKED_THROUGH[0]) & (above < LOOKED_THROUGH[1])], minlength=base.size)
    return count.reshape(base.shape) >= 2


def build_profile_bands(edge: float) -> HeightBands:
    """Build the height bands of the bits of a profile (`kernels.rasters.fill_profiles`): each is as high as a cell, m."""
    return HeightBands(edge, PROFILE_BELOW, PROFILE_LEVELS)


def _is_filled_like_wall(profile: Array, bands: HeightBands) -> Array:
    """Return whether the column is filled like a wall, at the heights at which the sensor looked."""
    filled = build_band_stack(profile, bands)
    filled = filled[is_observed_band(filled)]
    like = detect_wall_columns(filled, ROOM_WALLS)
    if len(filled) < ROOM_WALLS.least_bands:
        return like
    # flying points hang in every height of a doorway, but few of them
    levels = np.bitwise_count(profile & np.uint64(bands.build_mask(WALL_HEIGHTS[0], WALL_HEIGHTS[-1])))
    full = filled.sum(axis=0) >= ROOM_WALLS.count_least_bands(len(filled))
    usual = np.median(levels[full]) if full.any() else 0
    return np.asarray(like & (levels >= THIN * usual))


def _estimate_ceiling(clear: Array, edge: float) -> Array:
    """Estimate the ceiling of each column: the median of a few tiles around it, which lamps and lintels don't reach."""
    tile = _compute_tile_size(edge)
    nx, ny = (-(-s // tile) for s in clear.shape)
    padded = np.full((nx * tile, ny * tile), np.nan)
    padded[: clear.shape[0], : clear.shape[1]] = clear
    blocks = padded.reshape(nx, tile, ny, tile).transpose(0, 2, 1, 3).reshape(nx, ny, -1)
    middle = _compute_nanmedian(blocks)
    around = np.pad(middle, 2, constant_values=np.nan)
    smooth = _compute_nanmedian(np.stack([around[i : i + nx, j : j + ny] for i in range(5) for j in range(5)], axis=-1))
    return np.repeat(np.repeat(smooth, tile, 0), tile, 1)[: clear.shape[0], : clear.shape[1]]


def _compute_tile_size(edge: float) -> int:
    """Return the columns a side of the tiles on which ceilings are measured."""
    return max(round(BLOCK / edge), 1)


def _compute_nanmedian(values: Array) -> Array:
    """Return the median along the last axis of what is a number; nan where fewer than a tenth are."""
    ordered = np.sort(values, axis=-1)  # nan last
    count = (~np.isnan(ordered)).sum(axis=-1)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[..., None] // 2, axis=-1)[..., 0]
    return np.where(count * 10 >= values.shape[-1], middle, np.nan)


def _is_below_ceiling(profile: Array, ceiling: Array, edge: float) -> Array:
    """Return the columns over which the ceiling was seen with empty space below it: what stands there is no wall."""
    height = np.where(np.isnan(ceiling), 0.0, ceiling)
    out, bands = np.zeros(profile.shape, bool), build_profile_bands(edge)
    for level in np.unique(np.round(height / edge)):
        top = level * edge
        if top < OVER_FURNITURE + 0.25:
            continue
        here = np.round(height / edge) == level
        empty = (profile & np.uint64(bands.build_mask(OVER_FURNITURE, max(top - 0.25, OVER_FURNITURE + 0.1)))) == 0
        out |= here & empty & ((profile & np.uint64(bands.build_mask(top - 0.15, top + 0.35))) != 0)
    return out


def _remove_clutter(wall: Array, edge: float) -> Array:
    """Return the walls without short pieces that stand free."""
    piece, count = ndimage.label(wall, np.ones((3, 3)))
    boxes = ndimage.find_objects(piece)
    length = np.array([max(b[0].stop - b[0].start, b[1].stop - b[1].start) for b in boxes]) * edge
    keep = np.concatenate([[False], length > CLUTTER])
    if keep.any():
        gap = edt.edt((~keep[piece]).view(np.uint8), parallel=1) * edge
        keep[1:] |= np.asarray(ndimage.minimum(gap, piece, np.arange(1, count + 1))) < TOUCHES
    return keep[piece]


def _fill_holes(inside: Array, wall: Array, seen: Array, covered: Array, edge: float) -> Array:
    """Return the observed columns, without small holes and without parts of which neither a floor was seen nor walls around what
    has a ceiling or was looked through (`covered`)."""
    reach = max(round(0.2 / edge), 1)
    closed = ndimage.binary_closing(np.pad(inside | wall, reach), np.ones((2 * reach + 1,) * 2))[reach:-reach, reach:-reach]
    hole, count = ndimage.label(~closed)
    if count:
        area = np.bincount(hole.ravel(), minlength=count + 1) * edge**2
        border = np.unique(np.concatenate([hole[0], hole[-1], hole[:, 0], hole[:, -1]]))
        small = area <= HOLE
        small[border] = False
        small[0] = False
        closed |= small[hole]
    inside = closed & ~wall
    piece, count = ndimage.label(inside)
    area = np.maximum(np.bincount(piece.ravel(), minlength=count + 1), 1)
    floor = np.bincount(piece[seen & inside], minlength=count + 1)
    roof = np.bincount(piece[covered & inside], minlength=count + 1)
    outline = inside & ndimage.binary_dilation(~inside, np.ones((3, 3)))
    walled = outline & ndimage.binary_dilation(wall, np.ones((3, 3)))
    around = np.bincount(piece[walled], minlength=count + 1) / np.maximum(np.bincount(piece[outline], minlength=count + 1), 1)
    closed_in = (roof >= 0.5 * area) & (around >= 0.6) & (area * edge**2 >= 2 * LEAST_FLOOR)
    keep = (floor * edge**2 >= LEAST_FLOOR) | closed_in
    keep[0] = False
    return keep[piece]


# The upper sides of ceilings that look like the floor of an upper storey (beyond the thesis).

SHEET_THICKNESS = 0.2  # m: thinner than a floor that carries somebody
STOREY_BELOW = 1.2, 8.0  # m of empty space under a ceiling: at least, at most
ONE_SIDED_SHARE = 0.6  # of the directions in which a place sees a wall, on average: beside one long wall half of them
FLOOR_HEIGHTS = -0.3, 0.3  # m about the level of a storey, between which its floor lies
LEAST_FLOOR_SHARE = 0.1  # of a region in which a floor was seen
OPEN_SHARE = 0.25  # of the outline with walls, and of the floor with a ceiling: less, and a floor may be a ceiling


def remove_upper_sides(grid: VoxelGrid, plan: StoreyPlan, region: Array, places: Array = NOWHERE) -> Array:
    """Return the regions of an upper storey less those that are the upper side of a ceiling: nothing above, and either no walls
    around or so thin that nobody is carried, with a storey right below. The flat roof of low rooms beside a hall has walls on one
    side: those of the hall, which so becomes no storey of its own.

    Args:
        grid: occupied cells.
        plan: of the upper storey.
        region: (nx, ny) region of each column, -1 none.
        places: (n, 3) m, where the sensor was: what it was carried over is a floor.
    """
    count = int(region.max(initial=-1)) + 1
    in_region = region >= 0
    size = np.maximum(np.bincount(region[in_region], minlength=count), 1)
    covered = np.bincount(region[in_region], ~np.isnan(plan.clear[in_region]), minlength=count) / size
    walled = ndimage.binary_dilation(plan.wall, np.ones((5, 5)))
    outline = in_region & ndimage.binary_dilation(~plan.inside, np.ones((3, 3)))
    length = np.maximum(np.bincount(region[outline], minlength=count), 1)
    beside_walls = np.bincount(region[outline], walled[outline], minlength=count) / length
    suspect = covered < OPEN_SHARE
    low, base = locate_columns(plan, grid)
    at = np.floor((places[np.isfinite(places).all(axis=1)] - grid.origin) / grid.edge).astype(np.int64) - (*low, 0)
    at = at[are_within(at[:, :2], 0, region.shape)]
    above, of = (at[:, 2] - base[tuple(at[:, :2].T)]) * grid.edge, region[tuple(at[:, :2].T)]
    suspect[of[(above > CARRIED[0]) & (above < CARRIED[1]) & (of >= 0)]] = False
    if not suspect.any():
        return region
    at = np.argwhere(in_region & suspect[np.where(in_region, region, 0)])
    cells = np.ascontiguousarray(np.column_stack([at + low, base[tuple(at.T)]]))  # each layout is compiled by itself
    heights = (round(height / grid.edge) for height in (SHEET_THICKNESS, *STOREY_BELOW))
    hollow = is_hollow_below(*grid._bricks, cells, 1, *heights)
    thin = np.bincount(region[tuple(at.T)], hollow, minlength=count) > 0.5 * size
    directions = count_walled_directions(plan.wall, plan.edge) / SIGHT_DIRECTIONS
    walls_around = np.bincount(region[in_region], directions[in_region], minlength=count) / size
    ceiling = suspect & (thin | (beside_walls < OPEN_SHARE) | (walls_around < ONE_SIDED_SHARE))
    if ceiling.any():  # what the hall beside a roof adds to that has no floor
        on_floor = (plan.profile & plan.profile.dtype.type(plan.bands.build_mask(*FLOOR_HEIGHTS))) != 0
        ceiling |= np.bincount(region[in_region], on_floor[in_region], minlength=count) < LEAST_FLOOR_SHARE * size
    return np.where(in_region & ceiling[np.where(in_region, region, 0)], -1, region)
