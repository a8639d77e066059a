"""From labels of cells to rooms: connected pieces (seeds 2.6, 2.7)."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.components import connected_components
from topomerge.extraction.convolution import moore
from topomerge.types import Array, VoxelGrid


def split_rooms(grid: VoxelGrid, labels: Array, least_volume: float) -> Array:
    """Number the connected pieces of each label that hold at least `least_volume` m3 of occupied cells (seeds 2.6, 2.7).

    Smaller pieces belong to no room.

    Args:
        labels: (n,) int, -1 for none.
        least_volume: the thesis' 128 cells of 0.1 m are 0.128 m3.

    Returns:
        (n,) int32, numbered from 0 in Morton order, -1 for none.
    """
    piece = connected_components(grid, moore(), labels)
    size = np.bincount(piece[piece >= 0])
    large = size * grid.edge**3 >= least_volume - 1e-9
    number = np.where(large, np.cumsum(large) - 1, -1)
    room = np.where(piece >= 0, number[np.maximum(piece, 0)], -1) if len(size) else np.full(len(grid), -1)
    return room.astype(np.int32)
