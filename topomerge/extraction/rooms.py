"""Rooms: connected pieces of a label (seeds 2.6, 2.7)."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.components import connected_components, spread_labels
from topomerge.extraction.convolution import moore
from topomerge.types import Array, VoxelGrid


def split_rooms(grid: VoxelGrid, labels: Array, least_volume: float, absorb: bool = False) -> Array:
    """Number the connected pieces of each label that hold at least `least_volume` m3 of occupied cells.

    Args:
        labels: (n,) int, -1 for none.
        least_volume: the thesis' 128 cells of 0.1 m are 0.128 m3.
        absorb: give smaller pieces to the room they touch; otherwise, as in the thesis, they have none (-1).

    Returns:
        (n,) int32, numbered from 0 in Morton order, -1 for none.
    """
    piece = connected_components(grid, moore(), labels)
    size = np.bincount(piece[piece >= 0])
    large = size * grid.edge**3 >= least_volume - 1e-9
    number = np.where(large, np.cumsum(large) - 1, -1)
    room = np.where(piece >= 0, number[np.maximum(piece, 0)], -1) if len(size) else np.full(len(grid), -1)
    if absorb and large.any():
        small = (piece >= 0) & (room < 0)
        spread = spread_labels(grid, room, steps=round(1.0 / grid.edge), neighbourhood=moore())
        room = np.where(small, spread, room)
    return room.astype(np.int32)


def navigable_rooms(grid: VoxelGrid, room: Array, navigable: VoxelGrid) -> Array:
    """(m,) int32 room of each navigable cell: its own where it is occupied, otherwise that of the nearest navigable cell."""
    row = grid.rows(navigable.cells)
    label = np.where(row >= 0, room[np.maximum(row, 0)], -1)
    return spread_labels(navigable, label).astype(np.int32)
