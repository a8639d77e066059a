"""Rooms and edges with their measures: the topometric map (seeds 2.7)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from topomerge.extraction.classified_storey import leads_through_wall
from topomerge.extraction.completeness import completeness
from topomerge.extraction.doors import find_edges
from topomerge.extraction.floor import Floor
from topomerge.extraction.storeys import ceiling_height, floor_to_ceiling, lowest_of_column
from topomerge.types import AREA_DTYPE, ROOM_DTYPE, Array, TopometricMap, VoxelGrid


def topometric_map(grid: VoxelGrid, floor: Floor, body_height: float) -> TopometricMap:
    """The graph of rooms over the voxel grid (seeds 2.7).

    A room without a floor has no place in the graph: its cells lose their label.

    Args:
        grid: occupied cells.
        floor: of all storeys, cut into rooms.
        body_height: m, whatever is lower than this above the floor is no ceiling.
    """
    old_number = rooms_with_floor(floor)
    number = np.full(int(max(floor.label.max(initial=-1), floor.room.max(initial=-1))) + 2, -1, np.int32)
    number[old_number] = np.arange(len(old_number))
    room, label = number[floor.label], number[floor.room]
    above = floor_to_ceiling(grid, floor.cells, body_height)
    rooms = _measured_rooms(grid, room, floor, label, above, old_number)
    edges = find_edges(floor, label, rooms["storey"], above)
    edges = edges[~_leads_through_wall(floor, edges)]
    for edge in edges:
        a, b = old_number[edge["rooms"]].tolist()
        edge["confidence"] = floor.door_probability.get((min(a, b), max(a, b)), 1.0)
    area = np.where(number[floor.room_of_area][floor.area] >= 0, floor.area, -1) if len(floor.room_of_area) else floor.area
    areas, area = _areas(floor, label, area)
    narrows = find_edges(floor, area, rooms["storey"][areas["room"]], above, areas["room"])
    return TopometricMap(grid, room, floor.cells, label, rooms, edges, floor.storeys, areas, area, narrows)


def rooms_with_floor(floor: Floor) -> Array:
    """(R,) numbers of those rooms of a floor that are rooms of its map, in its order."""
    lowest = floor.room[lowest_of_column(floor.cells)]
    return np.unique(lowest[lowest >= 0])


def _leads_through_wall(floor: Floor, edges: Array) -> Array:
    """(E,) bool: is a door or an opening where there is probably a wall?"""
    level = np.isin(edges["kind"], ("door", "opening"))
    through = [leads_through_wall(floor.classified_storeys, centre) for centre in edges["centre"]]
    return np.asarray(level & np.array(through, bool))


def _areas(floor: Floor, label: Array, area: Array) -> tuple[Array, Array]:
    """(A,) AREA_DTYPE and the areas renumbered."""
    numbers = np.unique(area[area >= 0])
    number = np.append(np.searchsorted(numbers, np.arange(int(area.max(initial=-1)) + 1)), -1)
    area = number[area].astype(np.int32)
    areas = np.zeros(len(numbers), AREA_DTYPE)
    lowest = lowest_of_column(floor.cells)
    for a in range(len(numbers)):
        rows = lowest[area[lowest] == a]
        rows = rows if len(rows) else np.flatnonzero(area == a)
        areas[a] = (label[rows[0]], floor.cells.centroids(floor.cells.cells[rows]).mean(axis=0), len(rows) * floor.cells.edge**2)
    return areas, area


def _measured_rooms(grid: VoxelGrid, room: Array, floor: Floor, label: Array, above: Array, numbers: Array) -> Array:
    """(R,) ROOM_DTYPE; `numbers` (R,) are those of the floor's rooms."""
    count = int(label.max(initial=-1)) + 1
    cells = floor.cells
    rooms = np.zeros(count, ROOM_DTYPE)
    if floor.completeness is not None:
        rooms["completeness"] = floor.completeness[numbers]
    else:
        rooms["completeness"] = completeness(grid, cells, label, count, floor.body_width)
    lowest = lowest_of_column(cells)
    order = lowest[np.argsort(label[lowest], kind="stable")]
    floor_of = np.split(order, np.searchsorted(label[order], np.arange(count + 1)))[1:-1]
    order = np.argsort(room, kind="stable")
    cells_of = np.split(order, np.searchsorted(room[order], np.arange(count + 1)))[1:-1]
    for r in range(count):
        rows, occupied = floor_of[r], grid.cells[cells_of[r]]
        rooms["storey"][r] = np.bincount(floor.storey[rows]).argmax()
        rooms["centroid"][r] = cells.centroids(cells.cells[rows]).mean(axis=0)
        rooms["area"][r] = _area(cells.cells[rows, :2], cells.edge, floor.body_width)
        rooms["height"][r] = ceiling_height(above[rows])
        rooms["volume"][r] = rooms["area"][r] * rooms["height"][r]
        box = occupied if len(occupied) else cells.cells[rows]
        rooms["lo"][r] = grid.origin + box.min(axis=0) * grid.edge
        rooms["hi"][r] = grid.origin + (box.max(axis=0) + 1) * grid.edge
        rooms["cells"][r] = len(occupied)
    return rooms


def _area(columns: Array, edge: float, body_width: float) -> float:
    """m2 of floor: the navigable columns, the strip along the walls in which the body does not fit, and half a cell more along
    the boundary, because a wall's face lies on average in the middle of its cell."""
    reach = int(np.ceil(body_width / edge - 1e-6)) // 2
    low = columns.min(axis=0) - reach - 1
    plan = np.zeros(columns.max(axis=0) - low + reach + 2, bool)
    plan[tuple((columns - low).T)] = True
    if reach:
        plan = ndimage.binary_dilation(plan, np.ones((2 * reach + 1, 2 * reach + 1)))
    boundary = sum(int((plan[1:] != plan[:-1]).sum()) for plan in (plan, plan.T))
    return (float(plan.sum()) + boundary / 2) * edge**2
