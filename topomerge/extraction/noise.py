"""Points that are too many and points that are too few (beyond the thesis).

At the edge of a door a laser or a depth camera averages what is in front and what is behind: points hang in the opening, and a
single one of them obstructs the body of the stick kernel.
"""

from __future__ import annotations

import numpy as np

from topomerge.extraction.convolution import convolve, moore
from topomerge.types import VoxelGrid

COARSEST = 0.3  # m


def without_flying_cells(grid: VoxelGrid, share: float) -> VoxelGrid:
    """The cells that have at least `share` of the usual (median) number of neighbours.

    The limit follows the map: where points are sparse, surfaces have few neighbours, too, and only lonely cells go.
    """
    neighbours = convolve(grid, moore())
    return grid.subset(neighbours >= share * np.median(neighbours))


def without_gaps(grid: VoxelGrid, neighbours: float, warnings: list[str]) -> VoxelGrid:
    """The grid with cells so large that surfaces hold together: doubled until the median cell has as many neighbours (of 26).

    Cells that would be too large to find doors are not made.
    """
    while len(grid) and 2 * grid.edge <= COARSEST and float(np.median(convolve(grid, moore()))) < neighbours:
        grid = grid.coarser(2)
        warnings.append(f"the points are sparse: cells of {grid.edge:g} m were taken")
    return grid
