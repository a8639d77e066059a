"""Rooms and edges with their measures: the topometric map (seeds 2.7)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from topomerge.extraction.completeness import GLIMPSED, completeness
from topomerge.extraction.doors import find_edges
from topomerge.extraction.rooms import navigable_rooms
from topomerge.extraction.storeys import ceiling_height, find_storeys, lowest_of_column
from topomerge.kernels.columns import first_occupied
from topomerge.types import ROOM_DTYPE, Array, TopometricMap, VoxelGrid

HIGHEST_CEILING = 30.0  # m


def topometric_map(grid: VoxelGrid, room: Array, navigable: VoxelGrid, body: float, body_height: float) -> TopometricMap:
    """The graph of rooms over the voxel grid (seeds 2.7).

    A room in which nobody can stand has no place in the graph: its cells lose their label.

    Args:
        grid: occupied cells.
        room: (n,) room of each.
        navigable: the navigable volume.
        body: width (m) of the body it was made for.
        body_height: height (m) of that body: whatever is lower than this above the floor is no ceiling.
    """
    label = navigable_rooms(grid, room, navigable)
    above = floor_to_ceiling(grid, navigable, body_height)
    storeys, storey = find_storeys(navigable, above)
    floor = label[lowest_of_column(navigable)]
    used = np.bincount(floor[floor >= 0], minlength=int(room.max(initial=-1)) + 1) > 0
    number = np.append(np.where(used, np.cumsum(used) - 1, -1), -1).astype(np.int32)
    room, label = number[room], number[label]
    rooms = _measure(grid, room, navigable, label, storey, above, body)
    edges = find_edges(navigable, label, rooms["storey"], above, body)
    return TopometricMap(grid, room, navigable, label, rooms, edges, storeys)


def floor_to_ceiling(grid: VoxelGrid, navigable: VoxelGrid, body_height: float) -> Array:
    """(m,) m of empty space between each navigable cell and the first occupied one above it; 0 where there is none."""
    start = max(int(body_height / grid.edge), 1)
    limit = int(HIGHEST_CEILING / grid.edge)
    return first_occupied(*grid._bricks, navigable.cells.astype(np.int64), start, 1, limit) * grid.edge


def _measure(
    grid: VoxelGrid, room: Array, navigable: VoxelGrid, label: Array, storey: Array, above: Array, body: float
) -> Array:
    """(R,) ROOM_DTYPE."""
    count = int(label.max(initial=-1)) + 1
    rooms = np.zeros(count, ROOM_DTYPE)
    rooms["completeness"] = completeness(grid, navigable, label, count, body)
    rooms["glimpsed"] = rooms["completeness"] < GLIMPSED
    floor = lowest_of_column(navigable)
    order = floor[np.argsort(label[floor], kind="stable")]
    floor_of = np.split(order, np.searchsorted(label[order], np.arange(count + 1)))[1:-1]
    order = np.argsort(room, kind="stable")
    cells_of = np.split(order, np.searchsorted(room[order], np.arange(count + 1)))[1:-1]
    for r in range(count):
        rows, cells = floor_of[r], grid.cells[cells_of[r]]
        rooms["storey"][r] = np.bincount(storey[rows]).argmax()
        rooms["centroid"][r] = navigable.centroids(navigable.cells[rows]).mean(axis=0)
        rooms["area"][r] = _area(navigable.cells[rows, :2], navigable.edge, body)
        rooms["height"][r] = ceiling_height(above[rows])
        rooms["volume"][r] = rooms["area"][r] * rooms["height"][r]
        box = cells if len(cells) else navigable.cells[rows]
        rooms["lo"][r] = grid.origin + box.min(axis=0) * grid.edge
        rooms["hi"][r] = grid.origin + (box.max(axis=0) + 1) * grid.edge
        rooms["cells"][r] = len(cells)
    return rooms


def _area(columns: Array, edge: float, body: float) -> float:
    """m2 of floor: the navigable columns, the strip along the walls in which the body does not fit, and half a cell more along
    the boundary, because a wall's face lies on average in the middle of its cell."""
    reach = int(np.ceil(body / edge - 1e-6)) // 2
    low = columns.min(axis=0) - reach - 1
    plan = np.zeros(columns.max(axis=0) - low + reach + 2, bool)
    plan[tuple((columns - low).T)] = True
    if reach:
        plan = ndimage.binary_dilation(plan, np.ones((2 * reach + 1, 2 * reach + 1)))
    boundary = sum(int((plan[1:] != plan[:-1]).sum()) for plan in (plan, plan.T))
    return (float(plan.sum()) + boundary / 2) * edge**2
