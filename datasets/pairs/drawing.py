"""True classes of the columns of a building's plan, and this plan as a map of its own: no furniture, no rays."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from scipy import ndimage
from scipy.spatial import cKDTree
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs.flat_maps import FlatMap, build_from_masks, extrude_flat, label_points, transform_room
from topomerge.datasets.simulation.floor_truth import rasterize_floors
from topomerge.datasets.simulation.walk import fill

from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.types import Array, PointCloud, Sim3

TRUE_CLASSES = ("inside", "wall", "doorway", "shut", "outside")  # furniture is inside
RASTER_CELL = 0.05  # m, of the rasters of what is true
WALL_REACH = 0.4  # m: so far from a room it is wall, further outside
LEVEL_TOLERANCE = 0.6  # m between a storey and the true floor
DRAWN_HEIGHT = 1.0  # m: lower furniture is in a drawn grid
RAISED_WALL = 2.4  # m: to this height its walls are raised
HUNG_KINDS = ("leaf", "board", "lamp", "beam", "duct")  # in no drawn grid


def compute_plan_truth(building: Building, plan: StoreyPlan, places: Array, frame: Sim3, shift: Any) -> tuple[Array, Array]:
    """Compute true room and `TRUE_CLASSES` of each column of a plan."""
    at = frame.inverse().apply(places.reshape(-1, 3))
    if shift is not None:
        at = at + shift[1][cKDTree(shift[0]).query(at)[1]]
    floors = building.storeys["floor"]
    storey = int(np.argmin(np.abs(floors - np.median(at[:, 2]))))
    room, truth, low = rasterize_truth(building, storey)
    ij = np.floor((at[:, 1::-1] - low[::-1]) / RASTER_CELL).astype(np.int64)
    ok = ((ij >= 0) & (ij < room.shape)).all(axis=1)
    of: list[Array] = [np.full(len(at), -1, np.int16), np.full(len(at), TRUE_CLASSES.index("outside"), np.uint8)]
    for values, raster in zip(of, (room, truth), strict=True):
        values[ok] = raster[tuple(ij[ok].T)]
    return of[0].reshape(plan.wall.shape), of[1].reshape(plan.wall.shape)


def rasterize_truth(building: Building, storey: int) -> tuple[Array, Array, Array]:
    """Return (rows, columns) true room and index into `TRUE_CLASSES` of a storey, in cells of `RASTER_CELL`, and their origin
    (m)."""
    floor = building.storeys["floor"][storey]
    rooms = {i: r.polygon for i, r in enumerate(building.rooms) if abs(r.floor - floor) <= LEVEL_TOLERANCE}
    corners = np.concatenate(list(rooms.values()))
    low = corners.min(axis=0) - 2.0
    columns, rows = np.ceil((corners.max(axis=0) + 2.0 - low) / RASTER_CELL).astype(int)
    room = np.full((rows, columns), -1, np.int16)
    for i, polygon in rooms.items():
        fill(room, (polygon - low) / RASTER_CELL, i)
    truth = np.full(room.shape, TRUE_CLASSES.index("outside"), np.uint8)
    truth[dilate_mask(room >= 0, WALL_REACH)] = TRUE_CLASSES.index("wall")
    truth[room >= 0] = TRUE_CLASSES.index("inside")
    for door in building.doors[np.abs(building.doors["centre"][:, 2] - floor) <= LEVEL_TOLERANCE]:
        normal = np.array([np.cos(door["direction"]), np.sin(door["direction"])])
        along = np.array([-normal[1], normal[0]]) * door["width"] / 2
        deep = normal * (max(float(door["thickness"]), 0.15) / 2 + 0.05)
        box = door["centre"][:2] + np.array([along + deep, along - deep, -along - deep, deep - along])
        fill(truth, (box - low) / RASTER_CELL, TRUE_CLASSES.index("shut" if door["state"] == "shut" else "doorway"))
    return room, truth, low


def dilate_mask(mask: Array, reach: float) -> Array:
    """Return cells of a fine raster that are no further from a mask than this."""
    return np.asarray(ndimage.distance_transform_edt(~mask) * RASTER_CELL <= reach) if mask.any() else mask


def simulate_grid_map(building: Building, visited: Array, rng: np.random.Generator) -> PointCloud:
    """Simulate a grid map of the visited rooms, as robots and draughtsmen make them, its walls raised as those of a file are."""
    room, truth, low = rasterize_truth(building, 0)
    thin = float(rng.uniform(0.1, 0.3))
    solid = dilate_mask(np.isin(room, visited), thin) & np.isin(truth, (TRUE_CLASSES.index("wall"), TRUE_CLASSES.index("shut")))
    free = np.isin(room, visited) | (truth == TRUE_CLASSES.index("doorway")) & dilate_mask(np.isin(room, visited), 0.3)
    legs = rng.random() < 0.6  # a laser sees the legs of tables, a draughtsman the tables
    for thing in building.things[~np.isin(building.things["kind"], HUNG_KINDS)]:
        if thing["centre"][2] - thing["size"][2] / 2 < building.storeys["floor"][0] + DRAWN_HEIGHT:
            for box in compute_footprints(thing, legs and thing["kind"] in ("desk", "meeting", "dining", "table", "chair")):
                fill(solid, (box - low) / RASTER_CELL, 1)
    solid &= dilate_mask(np.isin(room, visited), 0.3)
    solid |= free & (rng.random(free.shape) < rng.choice([0.0, 0.002]))
    levels = np.arange(0.0, RAISED_WALL + 1e-6, RASTER_CELL)  # as close as files are raised: no cell of a wall stays empty
    walls, floor = ((np.argwhere(m)[:, ::-1] + 0.5) * RASTER_CELL + low for m in (solid, free & ~solid))
    points = np.column_stack([np.repeat(walls, len(levels), axis=0), np.tile(levels, len(walls))])
    points = np.concatenate([points, np.column_stack([floor, np.zeros(len(floor))])])
    return PointCloud((points + [0, 0, building.storeys["floor"][0]]).astype(np.float32))


def compute_footprints(thing: Any, legs: bool) -> list[Array]:
    """Compute the footprints of a thing on the floor: rectangles (4, 2)."""
    half = thing["size"][:2] / 2
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    boxes = [corners * half]
    if legs and half.max() > 0.3:
        leg = np.minimum(0.05, half)
        boxes = [corners * leg + c * (half - leg) for c in corners]
    turn = Sim3(float(thing["yaw"])).matrix[:2, :2]
    return [box @ turn.T + thing["centre"][:2] for box in boxes]


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
    """Return the drawing of the cells (rows, columns) bool of rooms, with doors, and with lines that are no walls."""
    door = np.zeros(room.shape, bool)
    for one in doors:
        _open(one, door, origin)
    walls = ~room & ~door & (ndimage.distance_transform_edt(~room) * DRAWING_CELL <= DRAWN_WALL)
    walls, floor = walls | ink, (room | door) & ~ink
    source = f"{building.name}:drawing"
    flat = build_from_masks(walls[::-1], floor[::-1], DRAWING_CELL, (*origin.tolist(), 0.0), rays=False, source=source)
    return replace(flat, rooms=tuple(replace(r, floor=0.0, ceiling=r.ceiling - r.floor) for r in building.rooms))


def simulate_drawing(building: Building, rooms: Array, storey: int, rng: np.random.Generator, frame: Sim3) -> PointCloud:
    """Return the drawing of rooms and of what lies about them on a storey as an architect leaves it, in a frame, with the true
    rooms of its points: leaves and arcs of doors, outlines of what stands there, and names of rooms, each on some of the
    drawings."""
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
    """Return the lines (k, 2), m, of an open leaf and of the way that it swings; none of an opening without a leaf."""
    if door["state"] == "none":
        return []
    normal = np.array([np.cos(door["direction"]), np.sin(door["direction"])]) * rng.choice([-1.0, 1.0])
    along = np.array([-normal[1], normal[0]]) * rng.choice([-1.0, 1.0])
    hinge = door["centre"][:2] - along * door["width"] / 2 + normal * door["thickness"] / 2
    angle = np.linspace(0, np.pi / 2, 12)[:, None]
    arc = hinge + door["width"] * (np.cos(angle) * along + np.sin(angle) * normal)
    return [np.stack([hinge, arc[-1]]), arc]


def _list_furniture_outlines(building: Building, storey: int) -> list[Array]:
    """Return (4, 2) m, footprints of what stands in the rooms of a storey."""
    things = building.things[~np.isin(building.things["kind"], HUNG_KINDS) & (building.things["room"] >= 0)]
    here = [t for t in things if building.rooms[t["room"]].storey == storey]
    return [box for thing in here for box in compute_footprints(thing, legs=False)]


def _draw_letters(polygon: Array, rng: np.random.Generator) -> list[Array]:
    """Draw lines (k, 2), m, of letters in a room, two to eight of them, of strokes at random."""
    place = np.asarray(shapely.Polygon(polygon).representative_point().coords)[0]
    size, count = rng.uniform(*LETTER_SIZES), int(rng.integers(2, 9))
    starts = place + np.column_stack([(np.arange(count) - count / 2) * size * 0.8, np.zeros(count)])
    strokes = rng.uniform(0, 1, (count, 3, 2)) * [0.6 * size, size]
    return [start + stroke for start, stroke in zip(starts, strokes, strict=True)]


def _sample_line(line: Array) -> Array:
    """Return (n, 2) points on a line through (k, 2) corners, no farther apart than half a cell."""
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
