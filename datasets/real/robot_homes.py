"""Homes as vacuum robots drew them, with the robots' own rooms: what comes nearest to rooms that people would draw in real homes.

Robots cut and join in their own way, and owners correct them: methods are compared by it, all of it is nobody's aim. For
development.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from topomerge.datasets.plans.grid import NARROW_CONTACT, find_contacts, trace_outline
from topomerge.datasets.plans.robot_home import spread_rooms
from topomerge.datasets.simulation.floor_truth import OUTSIDE_ROOMS, TRUTH_CELL, TRUTH_MARGIN, FloorTruth, mask_unseen

from topomerge.errors import InputError
from topomerge.io.json_map import load_json_map
from topomerge.io.valetudo import RobotMap, is_robot_map, parse_robot_map
from topomerge.types import Array, TrueRoom

FEWEST_HOME_ROOMS = 2
HOME_HEIGHT = 2.5  # m
INSIDE = 0.01  # m, from a corner of a column into it


def load_robot_rooms(path: Path) -> tuple[RobotMap, Array, Array]:
    """Load a robot's map of which the rooms are taken for true, and what `spread_rooms` returns of it.

    Raises:
        InputError: it is no map of Valetudo, or the robot tells fewer than two rooms apart.
    """
    about = load_json_map(path)
    if not is_robot_map(about):
        raise InputError(f"{path}: is no map of Valetudo; give one that a robot drew")
    drawn = parse_robot_map(path, about)
    labels, large = spread_rooms(drawn)
    if len(large) < FEWEST_HOME_ROOMS:
        raise InputError(f"{path}: the robot tells {len(large)} rooms apart, so nothing is true about it; take another map")
    return drawn, labels, large


def compute_home_truth(path: Path, points: Array) -> tuple[FloorTruth, tuple[TrueRoom, ...]]:
    """Return the robot's rooms as what is true, and a door wherever two of them touch, in the frame in which the map is read; and
    what its owner calls them.

    Args:
        points: (n, 3) of the map.

    Raises:
        InputError: the robot tells fewer than two rooms apart.
    """
    drawn, labels, large = load_robot_rooms(path)
    number = np.full(int(drawn.rooms.max()) + 1, -1)
    number[large] = np.arange(len(large))
    touching = [
        c for c in find_contacts(labels, drawn.resolution, drawn.origin) if np.hypot(*(c[2][1] - c[2][0])) >= NARROW_CONTACT
    ]
    doors = [[number[a], number[b], *ends.mean(axis=0), 0.0] for a, b, ends in touching]
    truth = FloorTruth(
        raster=_compute_columns(number[labels], drawn.resolution)[None],
        origin=drawn.origin - TRUTH_MARGIN,
        visited=np.ones(len(large), bool),
        floors=np.zeros(1),
        height=np.full(1, HOME_HEIGHT),
        doors=np.array(doors, float).reshape(-1, 5),
        edges=np.array(sorted({(number[a], number[b]) for a, b, _ in touching}), np.int64).reshape(-1, 2),
        matrix=np.eye(4),
        anchors=np.zeros((0, 3)),
        drift=np.zeros((0, 3)),
        complete=np.array(True),
    )
    level, names = (0.0, HOME_HEIGHT), [drawn.names[k - 1] or f"room {k}" for k in large]
    shapes = [trace_outline(labels == k, drawn.resolution, drawn.origin) for k in large]
    rooms = [TrueRoom(n, np.array(s.exterior.coords)[:-1], *level) for n, s in zip(names, shapes, strict=True)]
    return mask_unseen(truth, points), tuple(rooms)


def _compute_columns(rooms: Array, resolution: float) -> Array:
    """Return (rows, columns) int32 of the truth's columns: the room at the middle of each, or at one of its corners."""
    extent = np.array(rooms.shape[::-1]) * resolution
    columns, rows = np.ceil((extent + 2 * TRUTH_MARGIN) / TRUTH_CELL).astype(int)
    out = np.full((rows, columns), OUTSIDE_ROOMS, np.int32)
    corner = TRUTH_CELL / 2 - INSIDE
    for aside in ((0.0, 0.0), (-corner, -corner), (-corner, corner), (corner, -corner), (corner, corner)):
        x, y = ((np.arange(n) + 0.5) * TRUTH_CELL - TRUTH_MARGIN + a for n, a in zip((columns, rows), aside, strict=True))
        j, i = (np.floor(v / resolution).astype(int) for v in (x, y))
        on = np.ix_((i >= 0) & (i < rooms.shape[0]), (j >= 0) & (j < rooms.shape[1]))
        here = rooms[np.ix_(i[(i >= 0) & (i < rooms.shape[0])], j[(j >= 0) & (j < rooms.shape[1])])]
        out[on] = np.where((out[on] < 0) & (here >= 0), here, out[on])
    return out
