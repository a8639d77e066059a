"""Points that are too many (beyond the thesis).

At the edge of a door a laser or a depth camera averages what is in front and what is behind: points hang in the opening, and a
single one of them obstructs the body of the stick kernel.
"""

from __future__ import annotations

import numpy as np

from topomerge.extraction.convolution import convolve, moore
from topomerge.types import VoxelGrid


def without_flying_cells(grid: VoxelGrid, share: float) -> VoxelGrid:
    """The cells that have at least `share` of the usual (median) number of neighbours.

    The limit follows the map: where points are sparse, surfaces have few neighbours, too, and only lonely cells go.
    """
    neighbours = convolve(grid, moore())
    return grid.subset(neighbours >= share * np.median(neighbours))
