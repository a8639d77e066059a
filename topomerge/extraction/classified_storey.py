"""What probably stands in the columns of a storey, and which passages that rules out (beyond the thesis: docs/adr/0005)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from topomerge.types import Array

COLUMN_CLASSES = ("inside", "wall", "doorway", "shut", "outside")  # furniture is inside
INSIDE_CLASS, WALL_CLASS, DOORWAY_CLASS, SHUT_CLASS = range(4)  # of them
DOOR_CHANCE, WALL_CHANCE = 0.3, 0.02  # less of a door and more of a wall around it, and a passage leads through a wall
PASSAGE_REACH = 0.3  # m around a passage
SIGNS_REACH = 0.5  # m around it, in which walls and leaves are looked for
PLAN_SIGNS = (
    "doorway",
    "doorway_most",
    "walled",
    "leaf",
)  # around a passage: mean, highest, mean of a wall, highest of a shut door


@dataclass(frozen=True, eq=False)
class ClassifiedStorey:
    """Class probabilities of the columns of a storey, in the frame of the map.

    Args:
        probability: (nx, ny, 5) of each of `COLUMN_CLASSES`.
        origin: (2,) m, lower corner of the first column.
        edge: m, of a column.
        height: m, of the floor.
    """

    probability: Array
    origin: Array
    edge: float
    height: float


def leads_through_wall(storeys: Sequence[ClassifiedStorey], centre: Array) -> bool:
    """Does a passage at `centre` (3,) m lead through a wall: none of its columns is of a door, and some are of a wall?"""
    if not storeys:
        return False
    near = _around(_nearest(storeys, centre), centre, PASSAGE_REACH)
    if not near.size:
        return False
    return bool(
        near[..., DOORWAY_CLASS : SHUT_CLASS + 1].sum(axis=-1).max() < DOOR_CHANCE and near[..., WALL_CLASS].mean() > WALL_CHANCE
    )


def plan_signs(storeys: Sequence[ClassifiedStorey], centres: Array) -> Array:
    """(n, 4) `PLAN_SIGNS` at passages (n, 3) m; zeros where no plan is."""
    signs = np.zeros((len(centres), len(PLAN_SIGNS)))
    for row, centre in zip(signs, centres if storeys else (), strict=False):
        storey = _nearest(storeys, centre)
        near, wider = (_around(storey, centre, reach) for reach in (PASSAGE_REACH, SIGNS_REACH))
        if near.size:
            doorway = near[..., DOORWAY_CLASS]
            row[:] = doorway.mean(), doorway.max(), wider[..., WALL_CLASS].mean(), wider[..., SHUT_CLASS].max()
    return signs


def _nearest(storeys: Sequence[ClassifiedStorey], centre: Array) -> ClassifiedStorey:
    return min(storeys, key=lambda s: abs(s.height - float(centre[2])))


def _around(storey: ClassifiedStorey, centre: Array, reach: float) -> Array:
    """(a, b, 5) of the columns at most `reach` m from a place, along each axis."""
    columns = max(int(reach / storey.edge), 1)
    low = np.floor((np.asarray(centre)[:2] - storey.origin) / storey.edge).astype(np.int64) - columns
    box = tuple(slice(max(k, 0), max(k + 2 * columns + 1, 0)) for k in low.tolist())
    near: Array = storey.probability[box]
    return near
