"""How a tilted cloud was levelled before it became a map: what takes points of its file into the frame of the map."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from topomerge.types.arrays import Array, require
from topomerge.types.similarity import Sim3

LEVELLED = "levelled"  # parameter of a map whose cloud was tilted: the matrix, row by row
ROUNDING = 1e-9  # by which a rotation in a file may miss one


def levelling_of(parameters: Mapping[str, Any]) -> Array:
    """Read the levelling of a map from its parameters.

    Returns:
        (4, 4) float64: a rotation and a translation, m, that take points of the file into the frame of the map; the identity
        where the cloud was level.

    Raises:
        ValueError: something else stands there.
    """
    return np.eye(4) if LEVELLED not in parameters else checked_levelling(parameters[LEVELLED])


def checked_levelling(listed: Any) -> Array:
    """The (4, 4) matrix of a listing; ValueError where it is no rotation and translation."""
    matrix = np.array(listed, np.float64)
    proper = matrix.shape == (4, 4) and bool(np.isfinite(matrix).all()) and bool((matrix[3] == (0, 0, 0, 1)).all())
    require(proper, "a levelling that is none")
    rotation = matrix[:3, :3]
    rigid = np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=ROUNDING) and np.linalg.det(rotation) > 0
    require(bool(rigid), "a levelling that is none")
    return matrix


def is_level(levelling: Array) -> bool:
    """Is a levelling (4, 4) none, as that of a cloud that was level?"""
    return bool(np.array_equal(levelling, np.eye(4)))


def between_files(pose: Sim3, levelling: Array, into: Array) -> Array:
    """Carry a pose between two maps over to their files.

    Args:
        pose: takes points of the one map into the frame of the other.
        levelling: (4, 4) of the one map.
        into: (4, 4) of the other one.

    Returns:
        (4, 4) float64 that takes points of the one file into the frame of the other.
    """
    if is_level(levelling) and is_level(into):
        return pose.matrix
    out: Array = np.linalg.inv(into) @ pose.matrix @ levelling
    out[3] = 0, 0, 0, 1
    return out


def between_maps(matrix: Array, levelling: Array, into: Array) -> Array:
    """Undo `between_files`: the (4, 4) matrix of the pose between two maps."""
    if is_level(levelling) and is_level(into):
        return matrix
    out: Array = into @ matrix @ np.linalg.inv(levelling)
    return out


def transformed(matrix: Array, points: Array) -> Array:
    """Apply a matrix (4, 4) to points (n, 3), in float64."""
    with np.errstate(invalid="ignore", over="ignore"):  # points may be nan or infinite
        out: Array = np.asarray(points, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    return out
