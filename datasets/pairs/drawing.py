"""The floor plan of a building as a map of its own: walls as drawn, raised as `read_points` does it; no furniture, no rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs.flat import Flat, from_masks, raise_flat
from topomerge.datasets.pairs.pairs import Pair, seen_by_both
from topomerge.datasets.pairs.parts import share
from topomerge.datasets.simulation.floors import draw_floors

from topomerge.errors import InputError
from topomerge.types import Array

DRAWING_CELL = 0.05  # m
DRAWN_WALL = 0.2  # m beside a room that is drawn as wall
SAME_LEVEL = 1.0  # m between a door and the floor of its storey, at most


def with_plan(pair: Pair, building: Building) -> Pair:
    """The pair with the floor plan of the whole building instead of its second map.

    Raises:
        InputError: the building has several storeys, or the pair is of two buildings.
    """
    if len(building.storeys) > 1 or pair.frames is None or pair.kind != "overlap":
        raise InputError(f"{pair.name}: a floor plan is drawn of buildings of one storey, and of the one that was mapped")
    frame = pair.frames[1]
    flat = draw(building).moved(replace(frame, translation=(*frame.translation[:2], 0.0)))
    b = raise_flat(flat, frame.translation[2] + frame.scale * float(building.storeys["floor"][0]))
    visited = tuple(i for i, r in enumerate(building.rooms) if r.kind != "lift")
    return replace(
        pair,
        b=b,
        shared=seen_by_both(pair.a, b),
        overlap=share(list(pair.visited[0]), list(visited)),
        sensors=(pair.sensors[0], "drawing"),
        visited=(pair.visited[0], visited),
    )


def draw(building: Building, storey: int = 0) -> Flat:
    """Walls and floor of a storey; inner doors are open, outer ones shut."""
    floors = draw_floors(building, DRAWING_CELL)
    room = floors.room[storey] >= 0
    door = np.zeros(room.shape, bool)
    level = np.abs(building.doors["centre"][:, 2] - building.storeys["floor"][storey]) < SAME_LEVEL
    for one in building.doors[level & (building.doors["rooms"] >= 0).all(axis=1)]:
        _open(one, door, floors.origin)
    walls = ~room & ~door & (ndimage.distance_transform_edt(~room) * DRAWING_CELL <= DRAWN_WALL)
    source = f"{building.name}:drawing"
    flat = from_masks(walls[::-1], (room | door)[::-1], DRAWING_CELL, (*floors.origin.tolist(), 0.0), rays=False, source=source)
    return replace(flat, rooms=tuple(replace(r, floor=0.0, ceiling=r.ceiling - r.floor) for r in building.rooms))


def _open(door: Array, image: Array, origin: Array) -> None:
    """Set the cells of the opening, through the whole wall."""
    x, y = door["centre"][:2].tolist()
    reach = float(door["thickness"] + door["width"]) / 2 + 4 * DRAWING_CELL
    row, column = (
        slice(max(int((v - reach) / DRAWING_CELL), 0), int((v + reach) / DRAWING_CELL) + 1)
        for v in (y - origin[1], x - origin[0])
    )
    rows, columns = np.indices(image[row, column].shape) + np.array([row.start, column.start])[:, None, None]
    x, y = origin[0] + (columns + 0.5) * DRAWING_CELL - x, origin[1] + (rows + 0.5) * DRAWING_CELL - y
    c, s = np.cos(door["direction"]), np.sin(door["direction"])
    image[row, column] |= (abs(x * c + y * s) <= door["thickness"] / 2 + 2 * DRAWING_CELL) & (
        abs(y * c - x * s) <= door["width"] / 2
    )
