"""Upward dilation (seeds 2.3.2)."""

from __future__ import annotations

import numpy as np

from topomerge.types import VoxelGrid


def dilate_upwards(grid: VoxelGrid, height: float) -> VoxelGrid:
    """The cells and those up to `height` m above them, so that the steps of a stair touch (seeds 2.3.2)."""
    layers = np.arange(int(np.floor(height / grid.edge + 1e-6)) + 1)
    up = (grid.cells[:, None, :] + layers[:, None] * np.array([0, 0, 1])).reshape(-1, 3)
    return grid.with_cells(up[up[:, 2] < grid.shape[2]].astype(np.int32))
