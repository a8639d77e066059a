"""Doors inside of what a plan took for one room: the walls show them surely, the plan did not part there (beyond the thesis:
docs/adr/0018).

A toilet that is no wider than its door does not narrow, and what fills it hides where its doorway is. The plan is cut once more:
regions end along such a doorway, and the narrowing there is a door.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy import ndimage

from topomerge.extraction.plans.partition import Pair
from topomerge.extraction.plans.passages import Passage
from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.types import Array

INNER_DOOR_DTYPE = np.dtype([("centre", "f8", 3), ("normal", "f8", 2), ("width", "f8")])  # m, on the floor; unit; m
DOOR_LOG_ODDS = 6.0  # added to what the plan says of a narrowing in such a doorway
BESIDE_DOOR = 0.2  # m past both jambs
DOORWAY_LINE = 0.75  # columns to both sides of the line of a doorway: regions that touch at a corner are parted, too
DOOR_LEVEL = 1.2  # m


def inner_columns(plan: StoreyPlan, doors: Array) -> Array:
    """(nx, ny) bool: the columns along the doorways (D,) INNER_DOOR_DTYPE."""
    out = np.zeros(plan.wall.shape, bool)
    for door in doors:
        along, across, level = _from_door(plan, door)
        out |= (np.abs(across) < DOORWAY_LINE * plan.edge) & (np.abs(along) < door["width"] / 2 + BESIDE_DOOR) & level
    return out


def inner_log_odds(plan: StoreyPlan, passages: Mapping[Pair, Passage], doors: Array) -> dict[Pair, float]:
    """Log odds to be added to those of a door in each passage: 0 but in the doorways."""
    near = ndimage.binary_dilation(inner_columns(plan, doors), np.ones((3, 3)))
    return {pair: DOOR_LOG_ODDS * float(near[passage.place]) for pair, passage in passages.items()}


def _from_door(plan: StoreyPlan, door: Array) -> tuple[Array, Array, Array]:
    """(nx, ny) m of each column along a door and through it, and does its floor lie as high?"""
    x, y = (plan.origin[k] + (np.arange(n) + 0.5) * plan.edge - door["centre"][k] for k, n in enumerate(plan.wall.shape))
    u, v = door["normal"]
    level = np.abs(plan.floor - door["centre"][2]) < DOOR_LEVEL
    return y[None] * u - x[:, None] * v, x[:, None] * u + y[None] * v, level
