"""Where the points of a cell lie on average: surfaces are known better by it than by the cell alone.

A grid holds it as its property ``offset``, (n, 3) uint8: of the way through the cell along each axis, in 256 parts. So it stays
right when a map is moved to another origin or scaled.
"""

from __future__ import annotations

import numpy as np

from topomerge.kernels.voxelise import OFFSET_STEPS
from topomerge.types import Array, VoxelGrid

MIDDLE = OFFSET_STEPS // 2  # offset of a cell whose points are not known


def cell_middles(grid: VoxelGrid) -> Array:
    """(n, 3) float64 m: the mean of the points of each cell where the grid has it (property ``offset``), else the centroids."""
    offset = grid.properties.get("offset")
    if offset is None:
        return grid.centroids()
    out: Array = grid.origin + (grid.cells + (offset.astype(np.float64) + 0.5) / OFFSET_STEPS) * grid.edge
    return out


def with_means(grid: VoxelGrid, points: Array, counts: Array | None = None) -> VoxelGrid:
    """The grid with the property ``offset`` of points (N, 3), m, that each stand for so many points; others are left out."""
    rows = grid.rows(grid.locate(points))
    inside = rows >= 0
    points, rows = np.asarray(points, np.float64)[inside], rows[inside]
    weights = np.ones(len(rows)) if counts is None else np.asarray(counts, np.float64)[inside]
    many = np.bincount(rows, weights, len(grid))
    within = (points - grid.origin) / grid.edge - grid.cells[rows]
    total = np.column_stack([np.bincount(rows, weights * within[:, k], len(grid)) for k in range(3)])
    mean = np.where(many[:, None] > 0, total / np.maximum(many, 1e-9)[:, None], 0.5)
    return grid.with_properties(offset=np.clip(mean * OFFSET_STEPS, 0, OFFSET_STEPS - 1).astype(np.uint8))
