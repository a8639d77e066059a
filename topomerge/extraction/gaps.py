"""Bridging gaps in the floor, without making ceilings or table tops into floor (beyond the thesis: method 2)."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.convolution import LENGTH_SLACK, Kernel, any_at
from topomerge.types import Array, VoxelGrid

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
    levels = np.split(standing.cells[np.argsort(standing.cells[:, 2], kind="stable")], _steps(standing.cells[:, 2]))
    by_level = {int(level[0, 2]): level[:, :2] for level in levels}
    added: list[Array] = []
    for z in by_level:
        near = np.concatenate([by_level[k] for k in (z - 1, z, z + 1) if k in by_level])
        columns = _closing(near, radius)
        added.append(np.column_stack([columns, np.full(len(columns), z)]).astype(np.int32))
    new = np.concatenate(added)
    new = new[((new >= 0) & (new < grid.shape)).all(axis=1)]
    new = new[~any_at(grid, new, stick)]
    return grid.with_cells(np.concatenate([standing.cells, new]))


def _steps(values: Array) -> Array:
    """Where the sorted values change."""
    return np.flatnonzero(np.diff(np.sort(values))) + 1


def _closing(columns: Array, radius: float) -> Array:
    """(k, 2) columns that closing by a disc of `radius` cells adds to the given ones, tile by tile: most of a building's box is
    empty on most of its levels."""
    margin = 2 * int(np.ceil(radius)) + 1
    tile = columns.astype(np.int64) // CLOSING_TILE
    added = []
    _, firsts = np.unique(tile[:, 0] << 32 | tile[:, 1] & 0xFFFFFFFF, return_index=True)
    for corner in tile[firsts]:
        # closing looks twice as far as its radius
        low, high = corner * CLOSING_TILE - margin, (corner + 1) * CLOSING_TILE + margin
        window = columns[((columns >= low) & (columns < high)).all(axis=1)]
        start = np.maximum(window.min(axis=0) - margin, low)
        plan = np.zeros(np.minimum(window.max(axis=0) + margin + 1, high) - start, bool)
        plan[tuple((window - start).T)] = True
        closed = ~_near(~_near(plan, radius), radius) & ~plan
        cells = np.argwhere(closed) + start
        added.append(cells[(cells // CLOSING_TILE == corner).all(axis=1)])
    return np.concatenate(added)


def _near(mask: Array, radius: float) -> Array:
    """Pixels at most `radius` pixels from one of the mask: the lines of a disc laid over each other, which for a few pixels is
    many times faster than a distance transform."""
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
