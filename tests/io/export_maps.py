"""Maps for the tests of exports: buildings whose rooms, doors and stairs are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely

from tests.scenes import Scene, stair
from tests.scenes_map import EDGE, boxes, building
from topomerge.types import EDGE_DTYPE, ROOM_DTYPE, STOREY_DTYPE, WINDOW_DTYPE, Array, TopometricMap, VoxelGrid

GRID = (432100.0, 5812300.0, 40.0)  # m, as in UTM
AT = (2.0, -3.0, 0.5)


def rectangles(pairs: int = 1, storeys: int = 1, at: tuple[float, float, float] = AT) -> list[shapely.Polygon]:
    """The floors of `scenes_map.building`."""
    floors = [shapely.box(x0 * EDGE, y0 * EDGE, x1 * EDGE, y1 * EDGE) for x0, x1, y0, y1 in boxes(pairs)]
    return [shapely.affinity.translate(r, at[0], at[1]) for r in floors] * storeys


def two_floors(at: tuple[float, float, float] = AT) -> TopometricMap:
    """Two storeys of a corridor between two rooms, stairs between the corridors."""
    joined = building(1, 2, at)
    edges = joined.edges.copy()
    stairs = edges["kind"] == "stairs"
    middle = joined.rooms["centroid"][2]
    edges["lower"][stairs], edges["upper"][stairs] = middle + (-1.0, 0.0, -1.4), middle + (1.0, 0.0, 1.6)
    edges["centre"][stairs] = middle + (0.0, 0.0, 0.1)
    return replace(joined, edges=edges)


def doubted() -> TopometricMap:
    """`two_floors` with three windows of room 0: a sure one outdoors, one outdoors whose sill and head nobody saw, and a doubtful
    one into the corridor. Room 1 and the door of room 0 are doubtful; room 3 is outside."""
    map = two_floors()
    rooms, edges, windows = map.rooms.copy(), map.edges.copy(), np.zeros(3, WINDOW_DTYPE)
    rooms["confidence"], rooms["outside"] = [0.9, 0.3, 0.8, 0.7, 0.95, 0.6], [0, 0, 0, 0.8, 0, 0.5]
    edges["confidence"] = [0.4, 0.9, 0.85, 0.75, 0.65]
    low, high = rooms["lo"][0], rooms["hi"][0]
    x, y, _ = (low + high) / 2
    windows["rooms"] = [(0, -1), (0, -1), (0, 2)]
    windows["centre"] = [(low[0] - EDGE / 2, y, low[2]), (x, low[1] - EDGE / 2, low[2]), (x + 1.2, high[1] + EDGE / 2, low[2])]
    windows["direction"], windows["width"] = [0.0, np.pi / 2, np.pi / 2], [1.2, 0.9, 0.6]
    windows["sill"], windows["head"], windows["confidence"] = [0.9, np.nan, 1.0], [2.1, np.nan, 2.0], [0.88, 0.77, 0.2]
    return replace(map, rooms=rooms, edges=edges, windows=windows)


def nothing() -> TopometricMap:
    """A map of one cell, without rooms and storeys."""
    grid = VoxelGrid.from_cells(np.array([[0, 0, 0]]), np.zeros(3), EDGE)
    none = VoxelGrid.from_cells(np.empty((0, 3), np.int32), np.zeros(3), EDGE)
    tables = (np.zeros(0, ROOM_DTYPE), np.zeros(0, EDGE_DTYPE), np.zeros(0, STOREY_DTYPE))
    return TopometricMap(grid, np.full(1, -1, np.int32), none, np.zeros(0, np.int32), *tables, source="no<th>ing\x07.ply")


def without_doors() -> TopometricMap:
    """One storey whose rooms nothing joins."""
    rooms_only = building(1)
    return replace(rooms_only, edges=rooms_only.edges[:0])


def flat(plan: Array, area: float | None = None) -> TopometricMap:
    """One room whose floor is the cells set in a plan (nx, ny) bool."""
    cells = np.column_stack([np.argwhere(plan), np.zeros(int(plan.sum()), int)]).astype(np.int32)
    grid = VoxelGrid.from_cells(cells, np.zeros(3), EDGE)
    room = np.zeros(1, ROOM_DTYPE)
    room["area"], room["height"] = plan.sum() * EDGE**2 if area is None else area, 2.5
    room["hi"][0] = (*(np.array(plan.shape) * EDGE), EDGE)
    storey = np.array([(EDGE / 2, np.nan, 0.0)], STOREY_DTYPE)
    label = np.zeros(len(cells), np.int32)
    return TopometricMap(grid, label, grid, label.copy(), room, np.zeros(0, EDGE_DTYPE), storey)


def stair_scene() -> Scene:
    """A hall below and one above, 12 x 8 m, a wall with a door in each, and stairs along the wall y = 8."""
    scene, z = Scene(), 3.0
    hole = (2.0, 6.8, 2.0 + 0.29 * int(np.ceil(z / 0.18)), 8.0)
    for level in (0.0, z):
        for a, b in (((0, 0), (12, 0)), ((0, 8), (12, 8)), ((0, 0), (0, 8)), ((12, 0), (12, 8))):
            scene.wall(a, b, level, z)
        scene.wall((0, 4), (12, 4), level, z, doors=(6.0,))
    scene.floor(0, 0, 12, 8).floor(0, 0, 12, 8, z, hole).floor(0, 0, 12, 8, 2 * z)
    stair(scene, 2.0, 6.8, 8.0, 0.0, z)
    return scene
