"""The navigable volume, where a body can walk (seeds 2.3), and free space, which rays crossed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from topomerge.errors import InputError
from topomerge.extraction.cleaning import remove_flying_cells
from topomerge.extraction.convolution import Kernel, build_stick
from topomerge.extraction.morphology import (
    bridge_gaps,
    compute_horizontal_distance_field,
    dilate_upwards,
    is_surrounded,
    label_components,
    select_unobstructed,
)
from topomerge.extraction.parameters import SharedParameters
from topomerge.extraction.scan import Scan, add_reasons
from topomerge.extraction.slices import is_raised
from topomerge.extraction.storeys import NOWHERE, measure_floor_to_ceiling, remove_ceilings
from topomerge.kernels.rasters import find_first_occupied
from topomerge.kernels.rays import carve, sweep
from topomerge.types import Array, VoxelGrid, select_lowest_of_column

# Which connected parts of the navigable cells are floors.
FLOOR_LEAST_AREA = 1.0  # m2
FLOOR_LEAST_HALF_WIDTH = 0.2  # m: a wall's top is narrower, a floor on which somebody stands is not
FURNITURE_AREA = 15.0  # m2: the largest table, stage or bed
BESIDE, BESIDE_UNCOVERED = 1.0, 4.0  # m: so near the floor lies beside furniture; likewise where nothing was seen above that
CEILING_FROM, HIGHEST_CEILING = 1.0, 8.0  # m above a floor, between which a ceiling is looked for
COVERED_SHARE = 0.1  # of what stands below a ceiling, over which something was seen: lamps, and walls that reach higher
FURNITURE_HEIGHT = (0.25, 1.3)  # m over the floor beside it


def select_largest_component(grid: VoxelGrid) -> VoxelGrid:
    """Return the connected component with the most cells (seeds 2.3.3)."""
    if not len(grid):
        return grid
    component = label_components(grid)
    return grid.select_cells(component == np.bincount(component).argmax())


def select_floor_components(grid: VoxelGrid, occupied: VoxelGrid | None = None) -> VoxelGrid:
    """Return the connected components that are floors.

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
    component = label_components(grid)
    count = int(component.max()) + 1
    area = _count_columns(grid, component, count) * grid.edge**2
    inner = is_surrounded(grid, grid.cells, int(np.ceil(FLOOR_LEAST_HALF_WIDTH / grid.edge - 0.5 - 1e-9)))
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
            if below is not None and _is_on_furniture(top, large, below, reach):
                floor[c] = False
    return grid.select_cells(floor[component])


def _count_columns(grid: VoxelGrid, component: Array, count: int) -> Array:
    """Return the number of columns (x, y) that each component covers."""
    columns = grid.shape[0] * grid.shape[1]
    keys = np.unique((component * grid.shape[0] + grid.cells[:, 0]) * grid.shape[1] + grid.cells[:, 1])
    return np.bincount(keys // columns, minlength=count)


def _has_ceiling(occupied: VoxelGrid, cells: Array) -> bool:
    """Return whether something was seen above much of a floor (k, 3)."""
    start, far = max(int(CEILING_FROM / occupied.edge), 1), int(HIGHEST_CEILING / occupied.edge)
    above = find_first_occupied(*occupied._bricks, np.ascontiguousarray(cells, np.int64), start, 1, far)
    return bool((above > 0).mean() > COVERED_SHARE)


def _is_on_furniture(top: Array, floors: Array, below: cKDTree, reach: float) -> bool:
    """Return whether the cells `top` (k, 3) lie a table's height above the floor around them, at most `reach` away. All in m;
    `below` searches the floors' plan.

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
    """Return whether a floor was seen. Without one, what one could stand on is the upper side of the ceiling: it has nothing
    above, and walls hang from it, or most columns begin high over the lowest ones around."""
    lowest = select_lowest_of_column(navigable)
    covered = (measure_floor_to_ceiling(grid, navigable, body_height, lowest) > 0).mean()
    if covered > FLOOR_COVERED_SHARE:
        return True
    above = _measure_above_floor(grid, navigable.cells[lowest])
    if (above < -OFF_LEVEL).sum() > (above > OFF_LEVEL).sum():
        return False
    hanging, _, top = _find_under_ceiling(grid)
    return bool(hanging.sum() < HANGING_SHARE * (top >= 0).sum())


def _measure_above_floor(grid: VoxelGrid, floor: Array) -> Array:
    """Return (n,) cells by which each occupied one lies above the nearest column of a floor, (k, 3) of the same lattice."""
    level = np.full(grid.shape[:2], -1, np.int64)
    level[tuple(floor[:, :2].T)] = floor[:, 2]
    nearest = ndimage.distance_transform_edt(level < 0, return_distances=False, return_indices=True)
    at = tuple(grid.cells[:, :2].T)
    above: Array = grid.cells[:, 2].astype(np.int64) - level[nearest[0][at], nearest[1][at]]
    return above


def has_ceiling(grid: VoxelGrid) -> bool:
    """Return whether enough lies so high above the lowest points that it may be a ceiling."""
    return bool(_find_under_ceiling(grid)[0].sum() * grid.edge**2 >= LEAST_CEILING_AREA)


def add_assumed_floor(grid: VoxelGrid, rays: tuple[Array, Array] | None = None) -> VoxelGrid:
    """Return the grid with a floor under whatever seems to be a ceiling: at the lowest points around, or so far below the ceiling
    that one can stand; where the places of the sensor are known, as far below them as it is usually carried.

    Args:
        rays: (k, 3) places of the sensor and (k, 3) of what it saw, m, where they are known.
    """
    inside, height, top = _find_under_ceiling(grid, OVER_FLOOR)
    inside = ndimage.binary_closing(np.pad(inside, 5), np.ones((7, 7)))[5:-5, 5:-5]
    lowest, ceiling = float(np.median(height[inside])), float(np.median(top[inside & (top >= 0)]))
    below = ceiling - round(USUAL_HEADROOM / grid.edge)
    if rays is not None:
        eyes = (float(np.median(rays[0][:, 2])) - grid.origin[2]) / grid.edge
        least, most = CARRIER_HEADROOM
        carried = round(eyes - CARRIED_HEIGHT / grid.edge)
        below = carried if least <= (ceiling - carried) * grid.edge <= most else below
    return _add_floor_cells(grid, np.argwhere(inside), int(min(lowest, below)))


def _find_under_ceiling(grid: VoxelGrid, overhead: float = OVERHEAD) -> tuple[Array, Array, Array]:
    """Return (nx, ny) columns that begin `overhead` m above the lowest ones around; that lowest level; the highest occupied one
    of each."""
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


def _add_floor_cells(grid: VoxelGrid, columns: Array, level: int) -> VoxelGrid:
    """Add a floor at `level` to the grid in these columns; a level below the grid moves its origin."""
    down = max(-level, 0)
    shift = np.array([0, 0, down])
    floor = np.column_stack([columns, np.full(len(columns), level + down)])
    cells = np.concatenate([grid.cells.astype(np.int64) + shift, floor])
    shape = (grid.shape[0], grid.shape[1], grid.shape[2] + down)
    return VoxelGrid.from_cells(cells, grid.origin - shift * grid.edge, grid.edge, shape)


# Free space: the cells that rays crossed (method 4: what later rejects a wrong merge).
FREE_CELL = 2  # free cells are that many times longer than occupied ones: a wall is thinner than what it bounds
RAY_MARGIN = 0.5  # of a free cell's length: a ray ends that far before what it met
RAYS_OF_VIEW = 2000  # 0.25 m apart at 3.5 m
VIEW_SPACING = 2.0  # m between the views that carve where the sensor's places are unknown
VIEW_HEIGHT, VIEW_CLEARANCE = 1.5, 0.3  # m: above the floor, and below what is above
LARGEST_VOLUME = 400_000_000  # free cells


def find_free_space(scan: Scan, navigable: VoxelGrid, range: float) -> VoxelGrid | None:
    """Find the cells that are empty: by the file, crossed by the sensor's rays, or where its places are unknown, seen through
    from views.

    Args:
        scan: occupied cells, with the rays and the free cells that its file knows.
        navigable: the navigable volume.
        range: m, how far views see.

    Returns:
        Cells twice as long as those of the grid; None where the volume is too large to be carved.
    """
    if scan.free is not None:
        return scan.free
    scan = add_crossed_cells(scan)
    if scan.rays is not None:
        return scan.crossed
    crossed = _allocate_crossed(scan.grid)
    if crossed is None:
        return None
    _carve_views(scan.grid, navigable, range, crossed)
    return _select_empty_cells(scan.grid, crossed)


def add_crossed_cells(scan: Scan) -> Scan:
    """Add to the scan the cells that its rays crossed, twice as long as those of its grid, where the places of the sensor are
    known and the volume is not too large to be carved."""
    if scan.rays is None or scan.crossed is not None:
        return scan
    crossed = _allocate_crossed(scan.grid)
    if crossed is None:
        return scan
    _carve_rays(scan.grid, *scan.rays, crossed)
    return replace(scan, crossed=_select_empty_cells(scan.grid, crossed))


def _allocate_crossed(grid: VoxelGrid) -> Array | None:
    """Return (nx, ny, nz) bool of the free cells, none of them crossed; None where there are too many."""
    nx, ny, nz = (-(-s // FREE_CELL) for s in grid.shape)
    return np.zeros((nx, ny, nz), bool) if nx * ny * nz <= LARGEST_VOLUME else None


def _select_empty_cells(grid: VoxelGrid, crossed: Array) -> VoxelGrid:
    """Return the crossed cells in which nothing stands."""
    crossed[tuple((grid.cells // FREE_CELL).T)] = False
    nx, ny, nz = crossed.shape
    return VoxelGrid.from_cells(np.argwhere(crossed), grid.origin, grid.edge * FREE_CELL, (nx, ny, nz))


def _carve_rays(grid: VoxelGrid, starts: Array, ends: Array, crossed: Array) -> None:
    """Mark the free cells that rays crossed, from (k, 3) places of the sensor to (k, 3) of what it saw, m."""
    edge = grid.edge * FREE_CELL
    at, to = (np.ascontiguousarray((np.asarray(p, np.float64) - grid.origin) / edge) for p in (starts, ends))
    carve(at, to, RAY_MARGIN, crossed)


def _carve_views(grid: VoxelGrid, navigable: VoxelGrid, reach: float, crossed: Array) -> None:
    """Mark what lies between views above the floor and the first thing in each direction. A direction in which nothing is seen
    tells nothing."""
    views = select_tile_views(grid, navigable, VIEW_SPACING)
    starts = np.ascontiguousarray((views - grid.origin) / grid.edge)
    sweep(*grid._bricks, starts, _sample_directions(RAYS_OF_VIEW), reach / grid.edge, FREE_CELL, crossed)


def select_tile_views(grid: VoxelGrid, navigable: VoxelGrid, spacing: float) -> Array:
    """Return (v, 3) m, one view for each `spacing` x `spacing` m tile and storey-high layer: where it is farthest from the
    boundary.

    A regular net of views sees rooms evenly, whatever the shape of their medial axis. None ends up in a ceiling.
    """
    cells = navigable.cells[_select_tile_maxima(navigable, compute_horizontal_distance_field(navigable), spacing)]
    start = int(np.ceil(1.0 / grid.edge))
    limit = int(np.ceil((VIEW_HEIGHT + VIEW_CLEARANCE) / grid.edge)) + 1
    above = find_first_occupied(*grid._bricks, cells.astype(np.int64), start, 1, limit)
    views = grid.compute_centroids(cells)
    views[:, 2] += np.where(above > 0, np.minimum(VIEW_HEIGHT, above * grid.edge - VIEW_CLEARANCE), VIEW_HEIGHT)
    return views


def _select_tile_maxima(grid: VoxelGrid, distance: Array, spacing: float) -> Array:
    """Return the ascending rows of the cell of each tile with the largest distance."""
    size = max(round(spacing / grid.edge), 1)
    layer = max(round(2.0 / grid.edge), 1)
    tile = grid.cells // (size, size, layer)
    order = np.lexsort((grid.cells[:, 2], -np.asarray(distance), tile[:, 2], tile[:, 1], tile[:, 0]))
    sorted_tiles = tile[order]
    first = np.ones(len(order), bool)
    first[1:] = (sorted_tiles[1:] != sorted_tiles[:-1]).any(axis=1)
    return np.sort(order[first])


def _sample_directions(count: int) -> Array:
    """Return (count, 3) directions spread evenly: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    turn = np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


# The navigable volume: where a body can walk (seeds 2.3).
CLOUD_ADVICE = "check --up and --unit, or take larger voxels if the points are sparse"
PLAN_ADVICE = "check the map's resolution, its thresholds and negate, and that its free floor is white"


def compute_navigable_volume(scan: Scan, p: SharedParameters) -> tuple[Scan, VoxelGrid]:
    """Compute the standing room, joined upwards over steps, in connected parts (seeds 2.3).

    Returns:
        The scan, with an assumed floor where none was seen and the parameters allow it; the navigable cells.

    Raises:
        InputError: nowhere is room for a body on a floor.
    """
    with add_reasons(scan.warnings):
        try:
            navigable = _compute_navigable(scan.grid, p, scan.places)
            if not p.assume or has_floor(scan.grid, navigable, p.standing_height):
                return scan, navigable
        except InputError:
            if not p.assume or not has_ceiling(scan.grid):
                raise
    scan = scan.replace_grid(add_assumed_floor(scan.grid, scan.rays), "no floor was seen: one was assumed")
    with add_reasons(scan.warnings):
        return scan, _compute_navigable(scan.grid, p, scan.places)


def _compute_navigable(grid: VoxelGrid, p: SharedParameters, places: Array = NOWHERE) -> VoxelGrid:
    """Take the steps of 2.3 in their order; those between them are beyond the thesis (docs/adr/0003)."""
    body = _build_stick_kernel(grid.edge, p)
    # Points that fly in door openings shut nine of ten doors of simulated scans (docs/adr/0003).
    if p.noise:
        grid = remove_flying_cells(grid, p.noise)
    standing = select_unobstructed(grid, body)  # 2.3.1
    # The upper side of the ceiling was often the largest component (docs/adr/0003).
    if not p.ceilings:
        standing = remove_ceilings(grid, standing, places)
    # Sparse floors fell apart; more height in place of this turned beds into floor (docs/adr/0003).
    if p.bridge:
        standing = bridge_gaps(grid, standing, body, p.bridge)
    dilated = dilate_upwards(standing, p.dilation)  # 2.3.2
    navigable = select_largest_component(dilated) if p.largest_only else select_floor_components(dilated, grid)  # 2.3.3
    if not len(navigable):
        check = PLAN_ADVICE if is_raised(grid) else CLOUD_ADVICE
        raise InputError(
            f"no floor found: nowhere is an area of 1 m2 with {p.standing_height:g} m of empty space above it; {check}"
        )
    return navigable


def _build_stick_kernel(edge: float, p: SharedParameters) -> Kernel:
    """Return the stick that the parameters describe, in cells of `edge` m; the body's width is the nearest odd number of them."""
    width = 2 * int((p.body_width / edge - 1) / 2 + 0.5) + 1
    return build_stick(p.stem_height, width * edge, p.body_height, edge)
