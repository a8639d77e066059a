"""Connected components (seeds 2.3.3)."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.convolution import Kernel, von_neumann
from topomerge.kernels import components as kernel
from topomerge.types import Array, VoxelGrid


def connected_components(grid: VoxelGrid, neighbourhood: Kernel | None = None, group: Array | None = None) -> Array:
    """Component of each cell: two cells share one if a path of neighbours joins them (seeds 2.3.3).

    Args:
        grid: the cells.
        neighbourhood: which cells are neighbours; von Neumann (6) by default. It is taken as symmetric.
        group: (n,) integer; only neighbours of the same group are joined, a cell of a negative one has no component.

    Returns:
        (n,) int64, numbered from 0 in the order of their first cells, -1 for cells left out.
    """
    offsets = (neighbourhood or von_neumann()).stencil[0]
    both = np.unique(np.concatenate([offsets, -offsets]), axis=0)  # a neighbour's neighbour, whichever way it is said
    half = both[[tuple(o) > (0, 0, 0) for o in both.tolist()]]
    group = np.zeros(len(grid), np.int64) if group is None else np.asarray(group, np.int64)
    return kernel.components(grid.cells, *grid._bricks, half, group)


def spread_labels(grid: VoxelGrid, labels: Array, steps: int | None = None, neighbourhood: Kernel | None = None) -> Array:
    """Labels of cells that have none (-1) taken from the nearest labelled cell, counted in steps between neighbours.

    Args:
        steps: how far labels may travel; no limit by default.
    """
    out = np.array(labels, np.int64)
    offsets = (neighbourhood or von_neumann()).stencil[0]
    kernel.spread(grid.cells, *grid._bricks, offsets, out, len(grid) if steps is None else steps)
    return out
