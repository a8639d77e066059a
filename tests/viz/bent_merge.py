"""The merge of two halves of an office of which the second is bent: drawn by hand, not searched."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

import topomerge as tm
from tests.fusion.plans_of import MOVE, office, part
from topomerge.fusion.fuse import fuse, match_common_rooms
from topomerge.fusion.result import MergeResult, RoomMatch
from topomerge.registration.pipeline import Registration
from topomerge.types import Array, Deformation, Sim3

POSE = MOVE.inverse()
SWAY = 0.4  # m, by which the second half is bowed to either side


def drift(points: Array) -> Array:
    """Points of the office as a map that drifts shows them, in the office's frame."""
    out = np.array(points, np.float64)
    out[:, 1] += SWAY * np.sin((out[:, 0] - 5) / 6)
    return out


def straightening(reach: float = 2.5) -> Deformation:
    """What takes the drift back, in the frame of the second map."""
    x, y = np.meshgrid(np.arange(5, 26, 2.0), np.arange(1, 15, 3.0))
    true = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    there, h = MOVE.apply(drift(true)), 0.01
    moves = np.zeros((len(true), 4))
    moves[:, :2] = (MOVE.apply(true) - there)[:, :2]
    moves[:, 2] = -(drift(true + (h, 0, 0)) - drift(true))[:, 1] / h / 2
    unsure = np.tile(np.diag([1e-3, 1e-3, 1e-5]), (len(true), 1, 1))
    floor = np.array([MOVE.translation[2]])
    return Deformation(
        there[:, :2], np.zeros(len(true), int), floor, moves, unsure, np.arange(len(true), dtype=np.int32) % 6, reach
    )


def bent_merge(bent: bool = True) -> MergeResult:
    """The merge with its joined map."""
    points = office().points()
    a = tm.extract(part(points, high=(16, 99)), name="first.ply")
    b = tm.extract(MOVE.apply(drift(part(points, low=(5, -99)))).astype(np.float32), name="second.ply")
    bends = {1: straightening()} if bent else {}
    joined = fuse((a, b), [(0, Sim3()), (1, POSE)], bends)
    rooms, _ = match_common_rooms(a, b, POSE, (None, bends.get(1)))
    matches = tuple(RoomMatch((0, 1), (i, j), 0.9) for i, j in rooms.tolist())
    registration = Registration(POSE, 0.97, True, defaultdict(float))
    seconds = dict.fromkeys(("read", "extract", "embed", "match", "fuse"), 0.0)
    return MergeResult(
        "merged", 0.97, "merged: probability 0.97", {1: POSE}, matches, seconds, joined, (a, b), registration, bends=bends
    )
