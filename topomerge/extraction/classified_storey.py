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
    storey = min(storeys, key=lambda s: abs(s.height - float(centre[2])))
    reach = max(int(PASSAGE_REACH / storey.edge), 1)
    low = np.floor((centre[:2] - storey.origin) / storey.edge).astype(np.int64) - reach
    box = tuple(slice(max(k, 0), max(k + 2 * reach + 1, 0)) for k in low.tolist())
    near = storey.probability[box]
    if not near.size:
        return False
    return bool(
        near[..., DOORWAY_CLASS : SHUT_CLASS + 1].sum(axis=-1).max() < DOOR_CHANCE and near[..., WALL_CLASS].mean() > WALL_CHANCE
    )
