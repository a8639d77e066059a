"""The navigable volume: where a body can walk (seeds 2.3)."""

from __future__ import annotations

from topomerge.errors import InputError
from topomerge.extraction.assumed_floor import any_ceiling, has_floor, with_assumed_floor
from topomerge.extraction.ceilings import NOWHERE, without_ceilings
from topomerge.extraction.convolution import Kernel, stick
from topomerge.extraction.dilation import dilate_upwards
from topomerge.extraction.floors import floor_components, largest_component
from topomerge.extraction.flying_cells import without_flying_cells
from topomerge.extraction.gaps import bridge_gaps
from topomerge.extraction.parameters import SharedParameters
from topomerge.extraction.scan import Scan, reasons
from topomerge.extraction.slices import is_raised
from topomerge.extraction.unobstructed import unobstructed
from topomerge.types import Array, VoxelGrid

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
