"""Cells in which a wall may have been seen from a room, and where their points lie on average."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from topomerge.kernels.voxelise import OFFSET_STEPS
from topomerge.structure.floors import room_levels
from topomerge.types import Array, TopometricMap

FACE_HEIGHTS = (0.3, 2.2)  # m above the floor: skirting and ceilings are no faces of walls
ABOVE = 6.0  # m above the floor: cells higher up are of no use
LEAST_CELLS = 6  # of a column, between 0.3 and 2.2 m: fewer are furniture
FULL_COLUMN = 12  # cells: as many say no more
STRAY = 1.0  # m: cells of no room belong to a floor this near


@dataclass(frozen=True, eq=False)
class FacePoints:
    """Cells of one storey.

    Args:
        at: (n, 2) float64 m, mean of the points of each cell, or its middle.
        height: (n,) m above the floor of the room.
        room: (n,) int32 the room that sees it, -1 none.
        column: (n,) int64 cells of one column and room have one number.
        edge: m, of a cell.
        measured: are the means of points known?
    """

    at: Array
    height: Array
    room: Array
    column: Array
    edge: float
    measured: bool

    @property
    def upright(self) -> Array:
        """(n,) bool: at the heights of `FACE_HEIGHTS`."""
        return np.asarray((self.height > FACE_HEIGHTS[0]) & (self.height < FACE_HEIGHTS[1]))


def face_points(map: TopometricMap, storey: int, floors: list[shapely.MultiPolygon] | None = None) -> FacePoints:
    """The cells of a storey above its floors.

    Args:
        floors: of each room of the map, m; cells of no room go to the nearest. None: they stay out.
    """
    grid = map.grid
    rows = np.flatnonzero(map.storey_of_cells() == storey)
    cells, offset = grid.cells[rows], grid.properties.get("offset")
    within = 0.5 if offset is None else (offset[rows].astype(np.float64) + 0.5) / OFFSET_STEPS
    middles = grid.origin + (cells + within) * grid.edge
    room = map.room[rows].astype(np.int32)
    stray, rooms = np.flatnonzero(room < 0), np.flatnonzero(map.rooms["storey"] == storey)
    if floors is not None and len(stray) and len(rooms):
        columns, of = np.unique(cells[stray, :2], axis=0, return_inverse=True)
        middle = grid.origin[:2] + (columns + 0.5) * grid.edge
        tree = shapely.STRtree([floors[r] for r in rooms])
        near, which = tree.query_nearest(shapely.points(middle), max_distance=STRAY, all_matches=False)
        nearest = np.full(len(columns), -1, np.int32)
        nearest[near] = rooms[which]
        room[stray] = nearest[of.ravel()]
    floor = np.append(room_levels(map)[0][:, 0], map.storeys["floor"][storey])
    height = middles[:, 2] - floor[room]
    use = (height > 0) & (height < ABOVE) & ((floors is not None) | (room >= 0))
    column = (cells[:, 0].astype(np.int64) * grid.shape[1] + cells[:, 1]) * (len(map.rooms) + 1) + room + 1
    return FacePoints(middles[use, :2], height[use], room[use], column[use], grid.edge, offset is not None)


def wall_columns(points: FacePoints, room: int) -> tuple[Array, Array]:
    """(n, 2) where the columns of a room that fill like walls stand, m, and (n,) m of wall that each is."""
    rows = np.flatnonzero(points.upright & (points.room == room))
    _, column, count = np.unique(points.column[rows], return_inverse=True, return_counts=True)
    at = np.column_stack([np.bincount(column, points.at[rows, k], len(count)) / np.maximum(count, 1) for k in (0, 1)])
    scale = 0.1 / points.edge  # how many cells stand above each other
    full = count >= LEAST_CELLS * scale
    return at[full], np.minimum(count[full] / (FULL_COLUMN * scale), 1.0) * points.edge
