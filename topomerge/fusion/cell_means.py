"""Where the points of a cell lie on average: heights and surfaces are known better by it than by the cell alone."""

from __future__ import annotations

import numpy as np

from topomerge.types import Array, VoxelGrid


def cell_middles(grid: VoxelGrid) -> Array:
    """(n, 3) float64: the mean of the points of each cell where the grid has it (property ``mean``), else the centroids."""
    mean = grid.properties.get("mean")
    return grid.centroids() if mean is None else np.asarray(mean, np.float64)


def with_means(grid: VoxelGrid, points: Array) -> VoxelGrid:
    """The grid with the property ``mean``, the middle of the points (N, 3), m, of each cell: heights of ceilings and the fine
    registration gain from it (cells alone are known to half an edge)."""
    rows = grid.rows(grid.locate(points))
    points, rows = np.asarray(points, np.float64)[rows >= 0], rows[rows >= 0]
    many = np.bincount(rows, minlength=len(grid))[:, None]
    total = np.column_stack([np.bincount(rows, points[:, k], len(grid)) for k in range(3)])
    return grid.with_properties(mean=np.where(many > 0, total / np.maximum(many, 1), grid.centroids()))
