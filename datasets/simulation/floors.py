"""Rasters of a building's floors: which true room each cell is of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from topomerge.datasets.core.building import Building

from topomerge.types import Array


@dataclass(frozen=True, eq=False)
class Floors:
    """Rasters (storeys, rows, columns) of a building's floors.

    Args:
        room: int32, true room of each cell, -1: wall, doorway or outside.
        origin: (2,) of the rasters.
        cell: m.
    """

    room: Array
    origin: Array
    cell: float

    def cells(self, points: Array) -> Array:
        """(n, 2) row and column of points, within the raster."""
        ij = np.floor((np.asarray(points)[:, 1::-1] - self.origin[::-1]) / self.cell).astype(np.int64)
        return np.clip(ij, 0, np.array(self.room.shape[1:]) - 1)


def draw_floors(building: Building, cell: float) -> Floors:
    """Raster of the true rooms; a room that is two storeys high is on both."""
    corners = np.concatenate([r.polygon for r in building.rooms])
    origin = corners.min(axis=0) - 1.0
    columns, rows = np.ceil((corners.max(axis=0) + 1.0 - origin) / cell).astype(int)
    rooms = np.full((len(building.storeys), int(rows), int(columns)), -1, np.int32)
    for i, room in enumerate(building.rooms):
        for k, floor in enumerate(building.storeys["floor"]):
            if k >= room.storey and floor < room.ceiling - 1.5:
                fill(rooms[k], (room.polygon - origin) / cell, i)
    return Floors(rooms, origin, cell)


def fill(raster: Array, polygon: Array, value: int) -> None:
    """Set the cells of a raster whose centres lie in a polygon, given in cells: (k, 2) column and row."""
    low = np.clip(np.floor(polygon.min(axis=0)).astype(int), 0, None)
    high = np.clip(np.ceil(polygon.max(axis=0)).astype(int), 0, raster.shape[::-1])
    if (high <= low).any():
        return
    a, b = polygon, np.roll(polygon, -1, axis=0)
    y = (np.arange(low[1], high[1]) + 0.5)[:, None]
    crossed = (a[:, 1] <= y) != (b[:, 1] <= y)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    row, edge = np.nonzero(crossed)
    column = np.clip(np.ceil(x[row, edge] - 0.5).astype(int) - low[0], 0, high[0] - low[0])
    flips = np.zeros((high[1] - low[1], high[0] - low[0] + 1), np.int32)
    np.add.at(flips, (row, column), 1)
    inside = np.cumsum(flips, axis=1)[:, :-1] % 2 == 1
    raster[low[1] : high[1], low[0] : high[0]][inside] = value
