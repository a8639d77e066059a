"""Cells by their neighbourhoods: components, distances, where a body can stand, bridged gaps (seeds 2.3, 2.4.1)."""

from __future__ import annotations

import edt
import numpy as np

from topomerge.extraction.convolution import LENGTH_SLACK, Kernel, build_circle, build_von_neumann, count_at, is_any_at
from topomerge.kernels import rasters as kernel
from topomerge.types import Array, VoxelGrid, are_within, compute_extent

# Connected components (seeds 2.3.3).


def label_components(grid: VoxelGrid, neighbourhood: Kernel | None = None, group: Array | None = None) -> Array:
    """Return the component of each cell: two cells share one if a path of neighbours joins them (seeds 2.3.3).

    Args:
        grid: the cells.
        neighbourhood: which cells are neighbours; von Neumann (6) by default. It is taken as symmetric.
        group: (n,) integer; only neighbours of the same group are joined, a cell of a negative one has no component.

    Returns:
        (n,) int64, numbered from 0 in the order of their first cells, -1 for cells left out.
    """
    half = (neighbourhood or build_von_neumann()).half
    group = np.zeros(len(grid), np.int64) if group is None else np.asarray(group, np.int64)
    return kernel.label_components(grid.cells, *grid._bricks, half, group)


def spread_labels(grid: VoxelGrid, labels: Array, steps: int | None = None, neighbourhood: Kernel | None = None) -> Array:
    """Give cells that have none (-1) the label of the nearest labelled cell, counted in steps between neighbours.

    Args:
        steps: how far labels may travel; no limit by default.
    """
    out = np.array(labels, np.int64)
    offsets = (neighbourhood or build_von_neumann()).stencil[0]
    kernel.spread(grid.cells, *grid._bricks, offsets, out, len(grid) if steps is None else steps)
    return out


# Horizontal distance field (seeds 2.4.1).


def compute_horizontal_distance_field(grid: VoxelGrid) -> Array:
    """Compute how many cells a horizontal circle around each cell can grow inside the grid (seeds 2.4.1).

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
        low, high = compute_extent(cells)
        low -= 1
        plan = np.zeros(high - low + 2, bool)
        at = tuple((cells - low).T)
        plan[at] = True
        # squared distances are whole numbers: rounding them keeps the root exact
        squared = np.rint(edt.edtsq(plan.view(np.uint8), parallel=1)[at].astype(np.float64))
        distance[rows] = np.ceil(np.sqrt(squared)).astype(np.int32) - 1
    return distance


def is_surrounded(grid: VoxelGrid, cells: Array, radius: int) -> Array:
    """Return (m,) bool: does the grid hold all cells of the level that are at most so many cells away? As
    `compute_horizontal_distance_field` at
    or above the radius, of some cells and for a small radius."""
    disc = build_circle(radius * grid.edge, grid.edge)
    inside: Array = count_at(grid, cells, disc) == len(disc)
    return inside


# Upward dilation (seeds 2.3.2).


def dilate_upwards(grid: VoxelGrid, height: float) -> VoxelGrid:
    """Dilate cells by `height` m upwards, so that the steps of a stair touch (seeds 2.3.2)."""
    layers = np.arange(int(np.floor(height / grid.edge + 1e-6)) + 1)
    up = (grid.cells[:, None, :] + layers[:, None] * np.array([0, 0, 1])).reshape(-1, 3)
    return grid.replace_cells(up[up[:, 2] < grid.shape[2]].astype(np.int32))


# Cells that somebody could stand on (seeds 2.3.1; Gorte et al. 2019).


def select_unobstructed(grid: VoxelGrid, stick: Kernel) -> VoxelGrid:
    """Return cells whose convolution with the stick kernel is 0: nothing stands in the room that a body needs above them.

    The seeds sum occupancy under the kernel and keep sum = 0; as no weight is negative, the search may stop at the first cell.
    """
    return grid.select_cells(~is_any_at(grid, grid.cells, stick))


# Bridging gaps in the floor, without making ceilings or table tops into floor (beyond the thesis: method 2).

CLOSING_TILE = 256  # cells


def bridge_gaps(grid: VoxelGrid, standing: VoxelGrid, stick: Kernel, reach: float) -> VoxelGrid:
    """Close gaps of up to twice `reach` m between cells that one can stand on.

    The standing cells of a level and its two neighbours are closed horizontally; of the cells that this adds, those remain in
    which the stick fits. A kernel grown to bridge gaps lets beds become floor; this adds no height, so it does not.

    Args:
        grid: occupied cells.
        standing: the unobstructed ones that count as floor.
        stick: the room that a body needs.
        reach: m.
    """
    radius = reach / grid.edge + LENGTH_SLACK
    if radius < 1 or not len(standing):
        return standing
    levels = np.split(standing.cells[np.argsort(standing.cells[:, 2], kind="stable")], _find_steps(standing.cells[:, 2]))
    by_level = {int(level[0, 2]): level[:, :2] for level in levels}
    added: list[Array] = []
    for z in by_level:
        near = np.concatenate([by_level[k] for k in (z - 1, z, z + 1) if k in by_level])
        columns = _find_closing_columns(near, radius)
        added.append(np.column_stack([columns, np.full(len(columns), z)]).astype(np.int32))
    new = np.concatenate(added)
    new = new[are_within(new, 0, grid.shape)]
    new = new[~is_any_at(grid, new, stick)]
    return grid.replace_cells(np.concatenate([standing.cells, new]))


def _find_steps(values: Array) -> Array:
    """Return where the sorted values change."""
    return np.flatnonzero(np.diff(np.sort(values))) + 1


def _find_closing_columns(columns: Array, radius: float) -> Array:
    """Return (k, 2) columns that closing by a disc of `radius` cells adds to the given ones, tile by tile: most of a building's
    box is empty on most of its levels."""
    margin = 2 * int(np.ceil(radius)) + 1
    tile = columns.astype(np.int64) // CLOSING_TILE
    added = []
    _, firsts = np.unique(tile[:, 0] << 32 | tile[:, 1] & 0xFFFFFFFF, return_index=True)
    for corner in tile[firsts]:
        # closing looks twice as far as its radius
        low, high = corner * CLOSING_TILE - margin, (corner + 1) * CLOSING_TILE + margin
        window = columns[are_within(columns, low, high)]
        first, last = compute_extent(window)
        start = np.maximum(first - margin, low)
        plan = np.zeros(np.minimum(last + margin + 1, high) - start, bool)
        plan[tuple((window - start).T)] = True
        closed = ~_near(~_near(plan, radius), radius) & ~plan
        cells = np.argwhere(closed) + start
        added.append(cells[are_within(cells, corner * CLOSING_TILE, (corner + 1) * CLOSING_TILE)])
    return np.concatenate(added)


def _near(mask: Array, radius: float) -> Array:
    """Return the pixels at most `radius` pixels from one of the mask: the lines of a disc laid over each other, which for a few
    pixels is many times faster than a distance transform."""
    reach = int(radius)
    wider, widest = mask.copy(), [mask]  # pixels with one of the mask at most so far in their row
    for step in range(1, reach + 1):
        wider[:, step:] |= mask[:, :-step]
        wider[:, :-step] |= mask[:, step:]
        widest.append(wider.copy())
    out = wider.copy()
    for step in range(1, reach + 1):
        line = widest[int(np.sqrt(radius**2 - step**2))]
        out[step:] |= line[:-step]
        out[:-step] |= line[step:]
    return out
