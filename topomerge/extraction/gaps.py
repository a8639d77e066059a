"""Bridging gaps in the floor, without making ceilings or table tops into floor (beyond the thesis: method.md, section 1)."""

from __future__ import annotations

import edt
import numpy as np

from topomerge.extraction.convolution import Kernel, any_at
from topomerge.types import Array, VoxelGrid


def bridge_gaps(grid: VoxelGrid, standing: VoxelGrid, stick: Kernel, reach: float) -> VoxelGrid:
    """Close gaps of up to twice `reach` m between cells that one can stand on.

    The standing cells of a level and its two neighbours are closed horizontally; of the cells that this adds, those are kept in
    which the stick fits. A kernel grown to bridge gaps lets beds become floor; this adds no height, so it does not.

    Args:
        grid: occupied cells.
        standing: the unobstructed ones that count as floor.
        stick: the room that a body needs.
        reach: m.
    """
    radius = reach / grid.edge
    if radius < 1 or not len(standing):
        return standing
    margin = int(np.ceil(radius)) + 1
    levels = np.unique(standing.cells[:, 2])
    by_level = {int(z): standing.cells[standing.cells[:, 2] == z, :2] for z in levels}
    added: list[Array] = [standing.cells]
    for z in by_level:
        near = np.concatenate([by_level[k] for k in (z - 1, z, z + 1) if k in by_level])
        low = near.min(axis=0) - margin
        plan = np.zeros(near.max(axis=0) - low + margin + 1, bool)
        plan[tuple((near - low).T)] = True
        grown = edt.edtsq((~plan).view(np.uint8), parallel=1) <= radius**2
        closed = (edt.edtsq(grown.view(np.uint8), parallel=1) > radius**2) & ~plan
        cells = np.argwhere(closed) + low
        cells = cells[((cells >= 0) & (cells < grid.shape[:2])).all(axis=1)]
        added.append(np.column_stack([cells, np.full(len(cells), z)]).astype(np.int32))
    new = np.concatenate(added[1:])
    new = new[~any_at(grid, new, stick)]
    return grid.with_cells(np.concatenate([standing.cells, new]))
