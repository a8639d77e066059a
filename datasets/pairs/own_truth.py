"""Which rooms of two of one's own captures are one: by the transform between them, or by the rooms that somebody matched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from topomerge.datasets.pairs.evaluation_pair import LAID_IOU, measure_common_area
from topomerge.datasets.pairs.pairs_file import PairTruth

from topomerge.errors import InputError
from topomerge.matching.consistency import find_matches, propose_hypotheses
from topomerge.matching.room_plans import build_room_plans
from topomerge.types import Array, Sim3, TopometricMap, convert_pose_to_maps

LEAST_COMMON = 1.0  # m2 that both captures of a pair see
MOST_TILT = 3.0  # degrees by which a transform may tip a map over
AGREEING_ROOMS = 0.6  # share of the rooms in `rooms` that one pose must lay over each other
NO_OVERLAP = "share no floor"


@dataclass(frozen=True, eq=False)
class RoomOverlap:
    """How two maps lie to each other.

    Args:
        transform: T_ab of the maps; None where they show two places.
        matches: (M, 2) rooms that are one; of a room in pieces each piece.
        fit: (M,) IoU of each, of a piece the share that lies inside.
        common: m2 that both saw.
    """

    transform: Sim3 | None
    matches: Array
    fit: Array
    common: float


def find_overlap(truth: PairTruth, maps: tuple[TopometricMap, TopometricMap]) -> RoomOverlap:
    """Find which rooms of two maps are one, by the truth about them.

    Raises:
        InputError: rooms that do not exist, a transform that tips a map over, or maps without anything in common.
    """
    if truth.different:
        return RoomOverlap(None, np.zeros((0, 2), np.int64), np.zeros(0), 0.0)
    plans = (build_room_plans(maps[0]), build_room_plans(maps[1]))
    if truth.rooms is not None:
        given = np.array(truth.rooms, np.int64)
        _check_rooms(truth, given, maps)
        pose = find_pose_of_rooms(truth, given, maps)
    else:
        assert truth.matrix is not None
        pose = find_upright_pose(truth, convert_pose_to_maps(truth.matrix, maps[1].levelling, maps[0].levelling), maps[1])
    common = measure_common_area(maps, pose)
    if common < LEAST_COMMON:
        at = ", ".join(f"{x:.1f}" for x in pose.apply(maps[1].grid.compute_centroids().mean(axis=0)[None])[0])
        middle = ", ".join(f"{x:.1f}" for x in maps[0].grid.compute_centroids().mean(axis=0))
        raise InputError(
            f"{truth.a}, {truth.b}: {NO_OVERLAP} under their truth: b's middle comes to {at}, a's is {middle}; "
            f"correct it, or say different: true"
        )
    rooms, fit = find_matches(pose, plans)
    if truth.rooms is not None:
        found = {(int(i), int(j)): float(value) for (i, j), value in zip(rooms, fit, strict=True)}
        return RoomOverlap(pose, given, np.array([found.get((i, j), LAID_IOU) for i, j in truth.rooms]), common)
    return RoomOverlap(pose, rooms[fit >= LAID_IOU], fit[fit >= LAID_IOU], common)


def _check_rooms(truth: PairTruth, given: Array, maps: Sequence[TopometricMap]) -> None:
    for name, column, map in zip((truth.a, truth.b), given.T, maps, strict=True):
        if column.max() >= len(map.rooms):
            has = f"it has rooms 0 to {len(map.rooms) - 1}"
            raise InputError(f"{truth.a}, {truth.b}: rooms: {name} has no room {column.max()}; {has} (topomerge info)")


def find_pose_of_rooms(truth: PairTruth, given: Array, maps: Sequence[TopometricMap]) -> Sim3:
    """Find the pose whose walls agree best among those that lay the given rooms over each other.

    Raises:
        InputError: none lays half of them over each other.
    """
    a, b = maps
    likeness = np.zeros((len(a.rooms), len(b.rooms)))
    likeness[tuple(given.T)] = 1.0
    requested = {(int(i), int(j)) for i, j in given}
    poses = propose_hypotheses(a, b, 1.0 - likeness, likeness)
    counts = [len(requested & {(int(i), int(j)) for i, j in pose.rooms}) for pose in poses]
    if max(counts, default=0) < AGREEING_ROOMS * len(requested):
        raise InputError(
            f"{truth.a}, {truth.b}: rooms: no pose lays these rooms over each other (at most {max(counts, default=0)} of "
            f"{len(requested)}); correct their numbers, or give a transform"
        )
    return poses[int(np.argmax(counts))].transform


def find_upright_pose(truth: PairTruth, matrix: Array, b: TopometricMap) -> Sim3:
    """Find the pose about the vertical of a (4, 4) matrix, which keeps the middle of b.

    Raises:
        InputError: the matrix tips b over.
    """
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    up = matrix[:3, 2] / scale
    tilt = float(np.degrees(np.arccos(np.clip(up[2], -1, 1))))
    if tilt > MOST_TILT:
        raise InputError(
            f"{truth.a}, {truth.b}: transform: tips b over by {tilt:.0f} degrees, and maps stand upright; give a turn about "
            f"the vertical, or tell which axis is up by read: {{up: y}}"
        )
    middle = b.grid.compute_centroids().mean(axis=0)
    turned = Sim3(float(np.arctan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1])), scale=scale)
    x, y, z = (matrix[:3, :3] @ middle + matrix[:3, 3] - turned.apply(middle[None])[0]).tolist()
    return Sim3(turned.yaw, (x, y, z), scale)
