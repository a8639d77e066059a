"""Rooms on the floor: which room the navigable cells belong to (seeds 2.7)."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.components import spread_labels
from topomerge.extraction.floor import Floor
from topomerge.extraction.storeys import find_storeys, floor_to_ceiling
from topomerge.types import Array, VoxelGrid


def navigable_floor(grid: VoxelGrid, room: Array, navigable: VoxelGrid, body_height: float, body_width: float) -> Floor:
    """The navigable volume as the floor of rooms that are sets of occupied cells (seeds 2.7).

    A navigable cell has the room of the occupied cell in its place, otherwise that of the nearest navigable cell.

    Args:
        room: (n,) room of each occupied cell.
        body_height, body_width: of the body that the navigable volume was made for, m.
    """
    row = grid.rows(navigable.cells)
    label = np.where(row >= 0, room[np.maximum(row, 0)], -1)
    label = spread_labels(navigable, label).astype(np.int32)
    storeys, storey = find_storeys(navigable, floor_to_ceiling(grid, navigable, body_height))
    none = np.full(len(navigable), -1, np.int32)
    return Floor(navigable, storeys, storey, label, none, np.zeros(0, np.int32), room, body_width)
