"""FEATHER-N over the room graph (Rozemberczki and Sarkar, CIKM 2020): the untrained node embedding that the draft tried.

For each feature of the rooms and each number of steps: the characteristic function of the feature among the rooms where a random
walk of so many steps ends. Own implementation of the published formula.
"""

from __future__ import annotations

import numpy as np

from topomerge.embedding.engineered import engineered
from topomerge.embedding.room_cells import Descriptor
from topomerge.embedding.turns import numbers
from topomerge.errors import InputError
from topomerge.types import Array, TopometricMap


def feather(features: Descriptor | None = None, steps: int = 2, points: int = 6, largest: float = 1.5) -> Descriptor:
    """The descriptor: (R, 2 * steps * points * F) float64: real parts, then imaginary parts.

    Args:
        features: descriptor of F columns of about unit spread; the engineered features if None.
        steps: longest walk; walks of 1, ..., steps are taken.
        points: values of theta at which the characteristic function is sampled, evenly up to `largest`.

    Raises:
        InputError: a number below 1 or a `largest` that is not above 0.
    """
    if steps < 1 or points < 1 or not largest > 0:
        raise InputError(f"FEATHER needs 1 step and point or more and theta above 0, not {steps}, {points} and {largest}")
    describe_rooms = engineered(scaling="standard") if features is None else features
    theta = np.linspace(largest / points, largest, points)

    def describe(map: TopometricMap) -> Array:
        angle = numbers(describe_rooms(map))[:, :, None] * theta
        walk, reached = walk_matrix(map), np.eye(len(map.rooms))
        parts: list[Array] = []
        for _ in range(steps):
            reached = reached @ walk
            parts += [np.tensordot(reached, wave, 1).reshape(len(reached), -1) for wave in (np.cos(angle), np.sin(angle))]
        return np.concatenate(parts[::2] + parts[1::2], axis=1)

    return describe


def walk_matrix(map: TopometricMap) -> Array:
    """(R, R) probability of each step of a lazy walk: to stay, or through one of the room's doors, alike often."""
    count = len(map.rooms)
    ends = map.edges["rooms"].reshape(-1, 2)
    beside = np.eye(count)
    beside[ends[:, 0], ends[:, 1]] = beside[ends[:, 1], ends[:, 0]] = 1.0
    out: Array = beside / beside.sum(axis=1, keepdims=True)
    return out
