"""A building's structure: walls with thickness, doors as openings in them, rooms whose outlines are the walls' faces."""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import shapely

from topomerge.structure.face_points import FacePoints, face_points, wall_columns
from topomerge.structure.floors import floor_polygons
from topomerge.structure.lines import main_direction, straight_lines
from topomerge.structure.openings import OPENING_DTYPE, openings_in_walls, windows_in_walls
from topomerge.structure.outlines import apart, room_outline
from topomerge.structure.sides import one_side_each
from topomerge.structure.walls import WALL_DTYPE, walls_between
from topomerge.types import Array, TopometricMap


@dataclass(frozen=True, eq=False)
class PlanStructure:
    """What stands between rooms.

    Args:
        walls: (W,) WALL_DTYPE, by storey.
        openings: (O,) OPENING_DTYPE, a row for each door and opening of the map that is no flight of stairs.
        windows: (N,) SET_WINDOW_DTYPE, a row for each window of the map.
        rooms: of each room its floor between the faces of its walls, m, counter-clockwise; rooms of a storey do not overlap.
        storey_of_rooms: (R,) int32.
    """

    walls: Array
    openings: Array
    windows: Array
    rooms: list[shapely.MultiPolygon]
    storey_of_rooms: Array


def plan_structure(map: TopometricMap) -> PlanStructure:
    """Walls, openings and outlines of rooms of a map; the same map gives the same ones.

    A room's faces are straight lines through the means of the cells that it sees; its outline runs along them where they are, and
    where no wall was seen, and in maps that do not hold these means, along its floor (`floor_polygons`). Two faces that look away
    from each other, no more than 0.6 m apart, are a wall; the other faces are walls of which one side was seen.
    """
    if map not in _MADE:
        _MADE[map] = _structure(map)
    return _MADE[map]


_MADE: WeakKeyDictionary[TopometricMap, PlanStructure] = WeakKeyDictionary()  # several formats need it


def _structure(map: TopometricMap) -> PlanStructure:
    floors = floor_polygons(map)
    rooms, walls = list(floors), [np.zeros(0, WALL_DTYPE)]
    for storey in range(len(map.storeys)):
        of = np.flatnonzero(map.rooms["storey"] == storey)
        points = face_points(map, storey, floors)
        if points.measured:
            for r, outline in zip(of.tolist(), _outlines(points, of, floors), strict=True):
                rooms[r] = outline
        walls.append(walls_between(map, storey, rooms, points))
    every = np.concatenate(walls)
    openings = openings_in_walls(map, every) if len(map.edges) else np.zeros(0, OPENING_DTYPE)
    return PlanStructure(every, openings, windows_in_walls(map, every), rooms, map.rooms["storey"])


def _outlines(points: FacePoints, rooms: Array, floors: list[shapely.MultiPolygon]) -> list[shapely.MultiPolygon]:
    columns = [wall_columns(points, r) for r in rooms.tolist()]
    main = main_direction([line for column in columns for line in straight_lines(*column)])
    own = [floors[r] for r in rooms.tolist()]
    lines = one_side_each([straight_lines(*column, main) for column in columns], own)
    return apart([room_outline(*room) for room in zip(own, lines, strict=True)])
