"""Rooms: connected pieces of a label (seeds 2.6, 2.7)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from topomerge.extraction.components import connected_components, spread_labels
from topomerge.extraction.convolution import moore
from topomerge.extraction.plans.plan_network import Told
from topomerge.extraction.storeys import find_storeys, floor_to_ceiling
from topomerge.types import Array, VoxelGrid


@dataclass(frozen=True, eq=False)
class Floor:
    """The floors of all storeys, cut into rooms.

    Args:
        cells: the navigable volume, and the floor under furniture where rooms have such. Its property `standing` (bool) tells
            where a body fits; absent, it fits everywhere.
        storeys: (S,) STOREY_DTYPE.
        storey, room, area: (m,) int32 of each cell, -1 none.
        room_of_area: (A,) int32.
        label: (n,) int32 room of each occupied cell of the grid, -1 none.
        body: m, how much wider than its cells a passage is: where they tell where a body's middle may be, the body's width.
        probability: that a door parts two rooms, as far as it is known.
        completeness: (R,) share of each room's outline at which a wall was seen, where the plans tell it.
        told: what the network says of the storeys' plans.
    """

    cells: VoxelGrid
    storeys: Array
    storey: Array
    room: Array
    area: Array
    room_of_area: Array
    label: Array
    body: float = 0.0
    probability: dict[tuple[int, int], float] = field(default_factory=dict)
    completeness: Array | None = None
    told: tuple[Told, ...] = ()


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


def navigable_floor(grid: VoxelGrid, room: Array, navigable: VoxelGrid, body_height: float, body: float) -> Floor:
    """The navigable volume as the floor of rooms that were found as sets of occupied cells.

    A navigable cell has the room of the occupied cell in its place, otherwise that of the nearest navigable cell.

    Args:
        room: (n,) room of each occupied cell.
        body_height, body: of the body that the navigable volume was made for, m.
    """
    row = grid.rows(navigable.cells)
    label = np.where(row >= 0, room[np.maximum(row, 0)], -1)
    label = spread_labels(navigable, label).astype(np.int32)
    storeys, storey = find_storeys(navigable, floor_to_ceiling(grid, navigable, body_height))
    none = np.full(len(navigable), -1, np.int32)
    return Floor(navigable, storeys, storey, label, none, np.zeros(0, np.int32), room, body)
