"""Free space: the cells that rays crossed (method.md, section 1: the evidence that later rejects a wrong merge)."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.distance_field import horizontal_distance_field
from topomerge.extraction.views import best_of_tiles, raise_views
from topomerge.extraction.visibility import visible_cells
from topomerge.kernels.carve import carve
from topomerge.types import Array, VoxelGrid

COARSER = 2  # free cells are that many times longer than occupied ones: a wall is thinner than what it bounds
MARGIN = 0.5  # of a free cell's length: a ray ends that far before what it met
SPACING = 2.0  # m between the views that carve where the sensor's places are unknown
LARGEST = 400_000_000  # cells of the volume


def carve_rays(grid: VoxelGrid, starts: Array, ends: Array) -> VoxelGrid | None:
    """The cells, twice as long as those of the grid, that rays crossed and in which nothing is occupied.

    Args:
        grid: occupied cells.
        starts, ends: (k, 3) m, places of the sensor and of what it saw.

    Returns:
        None where the volume is too large to be carved.
    """
    edge = grid.edge * COARSER
    shape = tuple(-(-s // COARSER) for s in grid.shape)
    if int(np.prod(shape, dtype=np.float64)) > LARGEST:
        return None
    crossed = np.zeros(shape, bool)
    at, to = (np.ascontiguousarray((np.asarray(p, np.float64) - grid.origin) / edge) for p in (starts, ends))
    carve(at, to, MARGIN, crossed)
    crossed[tuple((grid.cells // COARSER).T)] = False
    return VoxelGrid.from_cells(np.argwhere(crossed), grid.origin, edge, shape)  # type: ignore[arg-type]


def carve_views(grid: VoxelGrid, navigable: VoxelGrid, height: float, reach: float, tolerance: float) -> VoxelGrid | None:
    """The same for a map whose sensor's places are unknown: what lies between a view on the floor and what can be seen from it.

    Args:
        height: of the views above the floor, m.
        reach, tolerance: of the visibility, m.
    """
    rows = best_of_tiles(navigable, horizontal_distance_field(navigable), SPACING)
    views = raise_views(grid, navigable.cells[rows], height, 0.3)
    seen = visible_cells(grid, views, reach, tolerance)
    cells = [seen.rows(v) for v in range(len(seen))]
    starts = np.repeat(views, [len(c) for c in cells], axis=0)
    ends = grid.centroids(grid.cells[np.concatenate(cells)]) if len(starts) else np.zeros((0, 3))
    return carve_rays(grid, starts, ends)
