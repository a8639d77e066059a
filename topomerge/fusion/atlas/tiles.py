"""A large joined map in tiles: parts of a building, each small enough for a page that shows all of its cells.

Rooms are parted from above along the longer side, where half of the cells lie on either, until a tile is small enough. A cell of
no room goes with the nearest room.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from topomerge.types import Array, TopometricMap

TILE_CELLS = 1_000_000  # cells of a tile, at most, but for a single room
NEAREST_BY = 0.5  # m: the raster in which the nearest room is looked for


def tiles(map: TopometricMap) -> list[Array]:
    """The rooms of each tile, ascending; every room is in one. A map without rooms is one tile."""
    size = np.bincount(nearest_rooms(map), minlength=len(map.rooms)) if len(map.rooms) else np.zeros(0, np.int64)
    parts, small = [np.arange(len(map.rooms))], []
    while parts:
        rooms = parts.pop()
        if len(rooms) < 2 or size[rooms].sum() <= TILE_CELLS:
            small.append(rooms)
            continue
        middle = map.rooms["centroid"][rooms, :2]
        order = np.argsort(middle[:, np.argmax(np.ptp(middle, axis=0))], kind="stable")
        below = np.cumsum(size[rooms][order])
        half = int(np.clip(np.searchsorted(below, below[-1] / 2), 1, len(rooms) - 1))
        parts += [np.sort(rooms[order[half:]]), np.sort(rooms[order[:half]])]
    return small


def nearest_rooms(map: TopometricMap) -> Array:
    """(n,) room of each occupied cell; of those without one that of the nearest cell with one, from above. 0 where none has."""
    owner = map.room.astype(np.int64)
    inside = owner >= 0
    if inside.all() or not inside.any():
        return np.maximum(owner, 0)
    step = max(round(NEAREST_BY / map.grid.edge), 1)
    squares, first = np.unique(map.grid.cells[inside, :2] // step, axis=0, return_index=True)
    others, square = np.unique(map.grid.cells[~inside, :2] // step, axis=0, return_inverse=True)
    near = cKDTree(squares).query(others)[1][square.ravel()]
    owner[~inside] = owner[inside][first][near]
    return owner


def tile_map(map: TopometricMap, rooms: Sequence[int] | Array) -> TopometricMap:
    """The map with nothing but what belongs to some of its rooms, which keep their numbers."""
    mine = np.zeros(max(len(map.rooms), 1), bool)
    mine[np.asarray(rooms, np.int64)] = True
    mine |= not len(map.rooms)
    cells, floor = mine[nearest_rooms(map)], (map.navigable_room >= 0) & mine[np.maximum(map.navigable_room, 0)]
    assert map.navigable_area is not None
    return replace(
        map,
        grid=map.grid.subset(cells),
        room=map.room[cells],
        provenance=None if map.provenance is None else map.provenance[cells],
        navigable=map.navigable.subset(floor),
        navigable_room=map.navigable_room[floor],
        navigable_area=map.navigable_area[floor],
        edges=map.edges[mine[map.edges["rooms"]].any(axis=1)] if len(map.edges) else map.edges,
        narrows=map.narrows[mine[map.areas["room"][map.narrows["rooms"]]].any(axis=1)] if len(map.narrows) else map.narrows,
        windows=map.windows[mine[map.windows["rooms"][:, 0]]] if len(map.windows) else map.windows,
        fixtures=map.fixtures[mine[map.fixtures["room"]]] if len(map.fixtures) else map.fixtures,
        free=None,
    )
