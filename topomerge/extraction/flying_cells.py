"""Points that are too many (beyond the thesis).

At the edge of a door a laser or a depth camera averages what is in front and what is behind: points hang in the opening, and a
single one of them obstructs the body of the stick kernel.
"""

from __future__ import annotations

import numpy as np

from topomerge.extraction.convolution import convolve, moore
from topomerge.types import VoxelGrid

THICK_SURFACE = 17  # neighbours of a cell in a surface that is two cells thick


def without_flying_cells(grid: VoxelGrid, share: float) -> VoxelGrid:
    """The cells that have at least `share` of the usual (median) number of neighbours.

    The limit follows the map: where points are sparse, surfaces have few neighbours, too, and only lonely cells go. In plans
    whose walls are solid most cells have all 26, and the floor 8: there the limit is that of a surface.
    """
    neighbours = convolve(grid, moore())
    return grid.subset(neighbours >= share * min(float(np.median(neighbours)), THICK_SURFACE))
