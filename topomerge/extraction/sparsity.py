"""Points that are too few: cells are made so large that surfaces hold together (beyond the thesis)."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.cell_means import cell_middles, with_means
from topomerge.extraction.convolution import convolve, moore
from topomerge.types import VoxelGrid

COARSEST_CELL = 0.3  # m: in larger ones no door is seen


def without_gaps(grid: VoxelGrid, neighbours: float, warnings: list[str]) -> VoxelGrid:
    """The grid with cells so large that surfaces hold together: doubled until the median cell has as many neighbours (of 26).

    Cells that would be too large to find doors are not made.

    Args:
        warnings: what the user should know is appended here.
    """
    while len(grid) and 2 * grid.edge <= COARSEST_CELL and float(np.median(convolve(grid, moore()))) < neighbours:
        fine, grid = grid, grid.coarser(2)
        if "offset" in fine.properties:
            grid = with_means(grid, cell_middles(fine), fine.properties.get("count"))
        warnings.append(f"the points are sparse: cells of {grid.edge:g} m were taken")
    return grid
