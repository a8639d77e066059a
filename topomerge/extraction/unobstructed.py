"""Cells that somebody could stand on (seeds 2.3.1; Gorte et al. 2019)."""

from __future__ import annotations

from topomerge.extraction.convolution import Kernel, any_at
from topomerge.types import VoxelGrid


def unobstructed(grid: VoxelGrid, stick: Kernel) -> VoxelGrid:
    """Cells whose convolution with the stick kernel is 0: nothing stands in the room that a body needs above them.

    The seeds sum occupancy under the kernel and keep sum = 0; as no weight is negative, the search may stop at the first cell.
    """
    return grid.subset(~any_at(grid, grid.cells, stick))
