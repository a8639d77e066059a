"""The navigable volume, where a body can walk (seeds 2.3), and free space, which rays crossed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topomerge.errors import InputError
from topomerge.extraction.cleaning import without_flying_cells
from topomerge.extraction.convolution import Kernel, stick
from topomerge.extraction.floors import any_ceiling, floor_components, has_floor, largest_component, with_assumed_floor
from topomerge.extraction.morphology import bridge_gaps, dilate_upwards, horizontal_distance_field, unobstructed
from topomerge.extraction.parameters import SharedParameters
from topomerge.extraction.scan import Scan, reasons
from topomerge.extraction.slices import is_raised
from topomerge.extraction.storeys import NOWHERE, without_ceilings
from topomerge.kernels.carve import carve, sweep
from topomerge.kernels.columns import first_occupied
from topomerge.types import Array, VoxelGrid

# Free space: the cells that rays crossed (method 4: what later rejects a wrong merge).

FREE_CELL = 2  # free cells are that many times longer than occupied ones: a wall is thinner than what it bounds
RAY_MARGIN = 0.5  # of a free cell's length: a ray ends that far before what it met
RAYS_OF_VIEW = 2000  # 0.25 m apart at 3.5 m
VIEW_SPACING = 2.0  # m between the views that carve where the sensor's places are unknown
VIEW_HEIGHT, VIEW_CLEARANCE = 1.5, 0.3  # m: above the floor, and below what is above
LARGEST_VOLUME = 400_000_000  # free cells


def free_space(scan: Scan, navigable: VoxelGrid, range: float) -> VoxelGrid | None:
    """Cells that are empty: by the file, crossed by the sensor's rays, or where its places are unknown, seen through from views.

    Args:
        scan: occupied cells, with the rays and the free cells that its file knows.
        navigable: the navigable volume.
        range: m, how far views see.

    Returns:
        Cells twice as long as those of the grid; None where the volume is too large to be carved.
    """
    if scan.free is not None:
        return scan.free
    scan = with_crossed_cells(scan)
    if scan.rays is not None:
        return scan.crossed
    crossed = _nothing_crossed(scan.grid)
    if crossed is None:
        return None
    _carve_views(scan.grid, navigable, range, crossed)
    return _empty_cells(scan.grid, crossed)


def with_crossed_cells(scan: Scan) -> Scan:
    """The scan with the cells that its rays crossed, twice as long as those of its grid, where the places of the sensor are known
    and the volume is not too large to be carved."""
    if scan.rays is None or scan.crossed is not None:
        return scan
    crossed = _nothing_crossed(scan.grid)
    if crossed is None:
        return scan
    _carve_rays(scan.grid, *scan.rays, crossed)
    return replace(scan, crossed=_empty_cells(scan.grid, crossed))


def _nothing_crossed(grid: VoxelGrid) -> Array | None:
    """(nx, ny, nz) bool of the free cells, none of them crossed; None where there are too many."""
    nx, ny, nz = (-(-s // FREE_CELL) for s in grid.shape)
    return np.zeros((nx, ny, nz), bool) if nx * ny * nz <= LARGEST_VOLUME else None


def _empty_cells(grid: VoxelGrid, crossed: Array) -> VoxelGrid:
    """The crossed cells in which nothing stands."""
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
    views = views_of_tiles(grid, navigable, VIEW_SPACING)
    starts = np.ascontiguousarray((views - grid.origin) / grid.edge)
    sweep(*grid._bricks, starts, _sphere(RAYS_OF_VIEW), reach / grid.edge, FREE_CELL, crossed)


def views_of_tiles(grid: VoxelGrid, navigable: VoxelGrid, spacing: float) -> Array:
    """(v, 3) m, one view for each `spacing` x `spacing` m tile and storey-high layer: where it is farthest from the boundary.

    A regular net of views sees rooms evenly, whatever the shape of their medial axis. None ends up in a ceiling.
    """
    cells = navigable.cells[_best_of_tiles(navigable, horizontal_distance_field(navigable), spacing)]
    start = int(np.ceil(1.0 / grid.edge))
    limit = int(np.ceil((VIEW_HEIGHT + VIEW_CLEARANCE) / grid.edge)) + 1
    above = first_occupied(*grid._bricks, cells.astype(np.int64), start, 1, limit)
    views = grid.centroids(cells)
    views[:, 2] += np.where(above > 0, np.minimum(VIEW_HEIGHT, above * grid.edge - VIEW_CLEARANCE), VIEW_HEIGHT)
    return views


def _best_of_tiles(grid: VoxelGrid, distance: Array, spacing: float) -> Array:
    """Ascending rows of the cell of each tile with the largest distance."""
    size = max(round(spacing / grid.edge), 1)
    layer = max(round(2.0 / grid.edge), 1)
    tile = grid.cells // (size, size, layer)
    order = np.lexsort((grid.cells[:, 2], -np.asarray(distance), tile[:, 2], tile[:, 1], tile[:, 0]))
    sorted_tiles = tile[order]
    first = np.ones(len(order), bool)
    first[1:] = (sorted_tiles[1:] != sorted_tiles[:-1]).any(axis=1)
    return np.sort(order[first])


def _sphere(count: int) -> Array:
    """(count, 3) directions spread evenly: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    turn = np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


# The navigable volume: where a body can walk (seeds 2.3).

CLOUD_ADVICE = "check --up and --unit, or take larger voxels if the points are sparse"
PLAN_ADVICE = "check the map's resolution, its thresholds and negate, and that its free floor is white"


def navigable_volume(scan: Scan, p: SharedParameters) -> tuple[Scan, VoxelGrid]:
    """Standing room, joined upwards over steps, in connected parts (seeds 2.3).

    Returns:
        The scan, with an assumed floor where none was seen and the parameters allow it; the navigable cells.

    Raises:
        InputError: nowhere is room for a body on a floor.
    """
    with reasons(scan.warnings):
        try:
            navigable = _navigable(scan.grid, p, scan.places)
            if not p.assume or has_floor(scan.grid, navigable, p.standing_height):
                return scan, navigable
        except InputError:
            if not p.assume or not any_ceiling(scan.grid):
                raise
    scan = scan.with_grid(with_assumed_floor(scan.grid, scan.rays), "no floor was seen: one was assumed")
    with reasons(scan.warnings):
        return scan, _navigable(scan.grid, p, scan.places)


def _navigable(grid: VoxelGrid, p: SharedParameters, places: Array = NOWHERE) -> VoxelGrid:
    """The steps of 2.3 in their order; those between them are beyond the thesis (docs/adr/0003)."""
    body = _stick_kernel(grid.edge, p)
    if p.noise:
        grid = without_flying_cells(grid, p.noise)
    standing = unobstructed(grid, body)  # 2.3.1
    if not p.ceilings:
        standing = without_ceilings(grid, standing, places)
    if p.bridge:
        standing = bridge_gaps(grid, standing, body, p.bridge)
    dilated = dilate_upwards(standing, p.dilation)  # 2.3.2
    navigable = largest_component(dilated) if p.largest_only else floor_components(dilated, grid)  # 2.3.3
    if not len(navigable):
        check = PLAN_ADVICE if is_raised(grid) else CLOUD_ADVICE
        raise InputError(
            f"no floor found: nowhere is an area of 1 m2 with {p.standing_height:g} m of empty space above it; {check}"
        )
    return navigable


def _stick_kernel(edge: float, p: SharedParameters) -> Kernel:
    """The stick that the parameters describe, in cells of `edge` m; the body's width is the nearest odd number of them."""
    width = 2 * int((p.body_width / edge - 1) / 2 + 0.5) + 1
    return stick(p.stem_height, width * edge, p.body_height, edge)
