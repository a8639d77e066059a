"""What truly stands in each column of a plan of a simulated building, and grid maps that are drawn from it."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from topomerge.datasets.core.building import Building
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
    """(rows, columns) true room and index into `TRUE_CLASSES` of a storey, in cells of `RASTER_CELL`, and their origin (m)."""
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
