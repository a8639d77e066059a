"""The floor plan of a building as a map of its own: walls as drawn, raised as `read_points` does it; no furniture, no rays."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import shapely
from scipy import ndimage
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs.flat_maps import FlatMap, build_from_masks, extrude_flat, label_points, transform_room
from topomerge.datasets.pairs.plan_truth import HUNG_KINDS, compute_footprints
from topomerge.datasets.simulation.floor_truth import rasterize_floors

from topomerge.types import Array, PointCloud, Sim3

DRAWING_CELL = 0.05  # m
DRAWN_WALL = 0.2  # m beside a room that is drawn as wall
SYMBOLS_SHARES = (0.5, 0.2, 0.5)  # of the drawings have arcs of doors, outlines of furniture, names of rooms
DRAWN_AROUND = 8.0  # m about the rooms that are asked for
LETTER_SIZES = (0.25, 0.5)  # m
SAME_LEVEL = 1.0  # m between a door and the floor of its storey, at most


def draw(building: Building, storey: int = 0) -> FlatMap:
    """Draw walls and floor of a storey; inner doors are open, outer ones shut."""
    floors = rasterize_floors(building, DRAWING_CELL)
    room = floors.room[storey] >= 0
    return _build_drawing(building, floors.origin, find_inner_doors(building, storey), room, np.zeros(room.shape, bool))


def _build_drawing(building: Building, origin: Array, doors: Array, room: Array, ink: Array) -> FlatMap:
    """The drawing of the cells (rows, columns) bool of rooms, with doors, and with lines that are no walls."""
    door = np.zeros(room.shape, bool)
    for one in doors:
        _open(one, door, origin)
    walls = ~room & ~door & (ndimage.distance_transform_edt(~room) * DRAWING_CELL <= DRAWN_WALL)
    walls, floor = walls | ink, (room | door) & ~ink
    source = f"{building.name}:drawing"
    flat = build_from_masks(walls[::-1], floor[::-1], DRAWING_CELL, (*origin.tolist(), 0.0), rays=False, source=source)
    return replace(flat, rooms=tuple(replace(r, floor=0.0, ceiling=r.ceiling - r.floor) for r in building.rooms))


def simulate_drawing(building: Building, rooms: Array, storey: int, rng: np.random.Generator, frame: Sim3) -> PointCloud:
    """The drawing of rooms and of what lies about them on a storey as an architect leaves it, in a frame, with the true rooms of
    its points: leaves and arcs of doors, outlines of what stands there, and names of rooms, each on some of the drawings."""
    arcs, outlines, names = (rng.random(3) < SYMBOLS_SHARES).tolist()
    floors = rasterize_floors(building, DRAWING_CELL)
    visited = shapely.union_all([shapely.Polygon(building.rooms[i].polygon) for i in rooms.tolist()])
    shown = np.array([visited.distance(shapely.Polygon(room.polygon)) < DRAWN_AROUND for room in building.rooms])
    sheet = np.isin(floors.room[storey], np.flatnonzero(shown))
    doors = find_inner_doors(building, storey)
    doors = doors[shown[doors["rooms"]].all(axis=1)]
    lines = []
    if arcs:
        lines += [line for door in doors for line in _draw_leaf_and_arc(door, rng)]
    if outlines:
        lines += [box[[0, 1, 2, 3, 0]] for box in _list_furniture_outlines(building, storey)]
    if names:
        lines += [line for room in building.rooms if room.storey == storey for line in _draw_letters(room.polygon, rng)]
    ink = np.zeros(sheet.shape, bool)
    for line in lines:
        row, column = floors.compute_cells(_sample_line(line)).T
        ink[row, column] = True
    flat = _build_drawing(building, floors.origin, doors, sheet, ink & sheet)
    flat = flat.transform(replace(frame, translation=(*frame.translation[:2], 0.0)))
    height = frame.translation[2] + frame.scale * float(building.storeys["floor"][storey])
    outlined = tuple(transform_room(room, frame) for room in building.rooms)
    return label_points(extrude_flat(replace(flat, rooms=()), height), outlined, storey)


def find_inner_doors(building: Building, storey: int) -> Array:
    """Find the doors of a storey that lead from room to room."""
    level = np.abs(building.doors["centre"][:, 2] - building.storeys["floor"][storey]) < SAME_LEVEL
    doors: Array = building.doors[level & (building.doors["rooms"] >= 0).all(axis=1)]
    return doors


def _draw_leaf_and_arc(door: Array, rng: np.random.Generator) -> list[Array]:
    """Lines (k, 2), m, of an open leaf and of the way that it swings; none of an opening without a leaf."""
    if door["state"] == "none":
        return []
    normal = np.array([np.cos(door["direction"]), np.sin(door["direction"])]) * rng.choice([-1.0, 1.0])
    along = np.array([-normal[1], normal[0]]) * rng.choice([-1.0, 1.0])
    hinge = door["centre"][:2] - along * door["width"] / 2 + normal * door["thickness"] / 2
    angle = np.linspace(0, np.pi / 2, 12)[:, None]
    arc = hinge + door["width"] * (np.cos(angle) * along + np.sin(angle) * normal)
    return [np.stack([hinge, arc[-1]]), arc]


def _list_furniture_outlines(building: Building, storey: int) -> list[Array]:
    """(4, 2) m, footprints of what stands in the rooms of a storey."""
    things = building.things[~np.isin(building.things["kind"], HUNG_KINDS) & (building.things["room"] >= 0)]
    here = [t for t in things if building.rooms[t["room"]].storey == storey]
    return [box for thing in here for box in compute_footprints(thing, legs=False)]


def _draw_letters(polygon: Array, rng: np.random.Generator) -> list[Array]:
    """Lines (k, 2), m, of letters in a room, two to eight of them, of strokes at random."""
    place = np.asarray(shapely.Polygon(polygon).representative_point().coords)[0]
    size, count = rng.uniform(*LETTER_SIZES), int(rng.integers(2, 9))
    starts = place + np.column_stack([(np.arange(count) - count / 2) * size * 0.8, np.zeros(count)])
    strokes = rng.uniform(0, 1, (count, 3, 2)) * [0.6 * size, size]
    return [start + stroke for start, stroke in zip(starts, strokes, strict=True)]


def _sample_line(line: Array) -> Array:
    """(n, 2) points on a line through (k, 2) corners, no farther apart than half a cell."""
    parts = []
    for start, end in itertools.pairwise(line):
        count = int(np.hypot(*(end - start)) / (DRAWING_CELL / 2)) + 2
        parts.append(np.linspace(start, end, count))
    return np.concatenate(parts)


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
