"""Horizontal distance field (seeds 2.4.1)."""

from __future__ import annotations

import edt
import numpy as np

from topomerge.extraction.convolution import circle, count_at
from topomerge.types import Array, VoxelGrid


def horizontal_distance_field(grid: VoxelGrid) -> Array:
    """How many times a horizontal circle around each cell can grow by one cell before it leaves the grid (seeds 2.4.1).

    The seeds grow a circle-shaped kernel until it holds fewer neighbours than cells. That is the largest whole radius below the
    distance to the nearest missing cell of the same level, so one exact Euclidean transform a level gives the same numbers.

    Returns:
        (n,) int32; 0 on the boundary: cells that miss one of their four horizontal neighbours.
    """
    distance = np.zeros(len(grid), np.int32)
    order = np.argsort(grid.cells[:, 2], kind="stable")
    levels = grid.cells[order, 2]
    for rows in np.split(order, np.flatnonzero(np.diff(levels)) + 1):
        if not len(rows):
            continue
        cells = grid.cells[rows, :2]
        low = cells.min(axis=0) - 1
        plan = np.zeros(cells.max(axis=0) - low + 2, bool)
        at = tuple((cells - low).T)
        plan[at] = True
        # squared distances are whole numbers: rounding them keeps the root exact
        squared = np.rint(edt.edtsq(plan.view(np.uint8), parallel=1)[at].astype(np.float64))
        distance[rows] = np.ceil(np.sqrt(squared)).astype(np.int32) - 1
    return distance


def on_all_sides(grid: VoxelGrid, cells: Array, radius: int) -> Array:
    """(m,) bool: does the grid hold all cells of the level that are at most so many cells away? As `horizontal_distance_field` at
    or above the radius, of some cells and for a small radius."""
    disc = circle(radius * grid.edge, grid.edge)
    inside: Array = count_at(grid, cells, disc) == len(disc)
    return inside
