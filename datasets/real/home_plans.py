"""Plans of homes as vacuum robots left them, and what is true of their columns by the robots' own rooms: grids to learn from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import ndimage
from topomerge.datasets.pairs.drawing import TRUE_CLASSES, WALL_REACH
from topomerge.datasets.pairs.plan_examples import PlanExample, build_storey_plans
from topomerge.datasets.plans.robot_home import WIDEST_LEAF
from topomerge.datasets.real.robot_homes import load_robot_rooms

from topomerge.io.points import read_points
from topomerge.types import Array, are_within

HOME_EDGE = 0.1  # m, of a column
DOOR_DEPTH = 0.13  # m to each side of where two rooms touch
UNTOLD = 255  # class of columns of which nothing is true: where the owner cut an open plan


def load_home_examples(path: Path) -> list[PlanExample]:
    """Load the plan of a home, and true room and class of each column: doorway where two of the robot's rooms touch over the
    width of a door.

    Raises:
        InputError: it is no map of Valetudo, or the robot tells fewer than two rooms apart.
    """
    drawn, rooms, _ = load_robot_rooms(path)
    classes = classify_pixels(rooms, drawn.resolution)
    examples = []
    for plan, places in build_storey_plans(read_points(path), HOME_EDGE):
        at = np.floor((places.reshape(-1, 3)[:, 1::-1] - drawn.origin[::-1]) / drawn.resolution).astype(np.int64)
        on = are_within(at, 0, rooms.shape)
        room, truth = np.full(len(at), -1, np.int16), np.full(len(at), TRUE_CLASSES.index("outside"), np.uint8)
        room[on], truth[on] = rooms[tuple(at[on].T)] - 1, classes[tuple(at[on].T)]
        shape = plan.wall.shape
        visited = np.flatnonzero(np.isin(np.arange(rooms.max()), room))
        examples.append(PlanExample(plan, room.reshape(shape), truth.reshape(shape), visited, f"home/{path.stem}"))
    return examples


def classify_pixels(rooms: Array, resolution: float) -> Array:
    """Return (h, w) uint8 index into `TRUE_CLASSES`, or `UNTOLD`, of each pixel of a home.

    Args:
        rooms: (h, w) number of the robot's room, 0: none.
        resolution: m a pixel.
    """
    out = np.full(rooms.shape, TRUE_CLASSES.index("outside"), np.uint8)
    out[ndimage.distance_transform_edt(rooms == 0) * resolution <= WALL_REACH] = TRUE_CLASSES.index("wall")
    out[rooms > 0] = TRUE_CLASSES.index("inside")
    touching, count = ndimage.label(_find_borders(rooms), np.ones((3, 3)))
    sizes = [max(side.stop - side.start for side in box) * resolution for box in ndimage.find_objects(touching)]
    if count:
        far, nearest = ndimage.distance_transform_edt(touching == 0, return_indices=True)
        near = (far * resolution <= DOOR_DEPTH) & (rooms > 0)
        wide = np.array([False, *(size > WIDEST_LEAF for size in sizes)])[touching[tuple(nearest)]]
        out[near] = np.where(wide, UNTOLD, TRUE_CLASSES.index("doorway"))[near]
    return out


def _find_borders(rooms: Array) -> Array:
    """Return (h, w) bool, the pixels of a room beside one of another room."""
    out = np.zeros(rooms.shape, bool)
    for a, b in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        differ = (rooms[a] != rooms[b]) & (rooms[a] > 0) & (rooms[b] > 0)
        out[a] |= differ
        out[b] |= differ
    return out
