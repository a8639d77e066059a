"""What is measured of maps that are bent onto each other: errors of rooms, and their intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from topomerge.datasets.pairs.bent_pairs import BentPair
from topomerge.statistics import FEWEST_GROUPS, OUTSIDE
from topomerge.types import Array, Sim3

MATCHED = 0.75  # m between places of both maps that are compared
LEAST_COMMON = 2.0  # m2 of a room that both maps show
COLUMN = 0.5  # m, of the places
DRAWS = 400
ROOM_LIMITS = (0.1, 1.0)  # m, degrees


class Bending(Protocol):
    """What moves the points of a map (`fusion.bend.deformation.Deformation`)."""

    def apply(self, points: Array) -> Array: ...


def misplaced(bent: BentPair, side: int, pose: Sim3, bending: Bending | None = None) -> tuple[Array, Array]:
    """Places of a map in the building's frame (n, 3), and by how much (n, 3) m, in the frame of map a, they are laid beside it.

    Args:
        side: 0: map a, which stays where it is; 1: map b, laid by `pose`.
    """
    undrift, frames = bent.undrift[side], bent.frames
    true = frames[side].inverse().apply(undrift.places + undrift.shifts)
    laid = undrift.places if bending is None else bending.apply(undrift.places)
    return true, (laid if side == 0 else pose.apply(laid)) - frames[0].apply(true)


def room_errors(bent: BentPair, pose: Sim3, bendings: Sequence[Bending | None] = (None, None)) -> list[dict[str, float]]:
    """Of each room that both surveyors were in: how far (m, horizontally) and by how many degrees b's lies off a's.

    The mean displacement and the turn that fits best, over the places of b that are near one of a in the same room; rooms of
    which both show less than `LEAST_COMMON` are left out.
    """
    (at_a, off_a), (at_b, off_b) = (misplaced(bent, side, pose, bendings[side]) for side in (0, 1))
    out = []
    for room in bent.shared.tolist():
        rows_a, rows_b = (np.flatnonzero(u.rooms == room) for u in bent.undrift)
        if not len(rows_a) or not len(rows_b):
            continue
        far, nearest = cKDTree(at_a[rows_a]).query(at_b[rows_b])
        rows_b, rows_a = rows_b[far <= MATCHED], rows_a[nearest[far <= MATCHED]]
        area = len(np.unique(np.floor(at_b[rows_b, :2] / COLUMN), axis=0)) * COLUMN**2
        if area >= LEAST_COMMON:
            shift, turn = shift_and_turn(bent.frames[0].apply(at_b[rows_b])[:, :2], (off_b[rows_b] - off_a[rows_a])[:, :2])
            out.append({"room": room, "area": area, "shift": shift, "turn": turn})
    return out


def shift_and_turn(points: Array, off: Array) -> tuple[float, float]:
    """Length of the mean (m), and turn (degrees) of the rigid move that explains displacements (n, 2) of points (n, 2) best."""
    mean = off.mean(axis=0)
    rel = (points - points.mean(axis=0)) @ (1, 1j)
    turned = rel + (off - mean) @ (1, 1j)
    return float(np.hypot(*mean)), float(np.degrees(abs(np.angle((np.conj(rel) * turned).sum()))))


def within(rooms: Sequence[dict[str, float]], limits: tuple[float, float] = ROOM_LIMITS) -> bool:
    """Is every room within m and degrees?"""
    return all(r["shift"] <= limits[0] and r["turn"] <= limits[1] for r in rooms)


def with_interval(statistic: Callable[[Array], float], groups: Sequence[str], digits: int) -> str:
    """What a statistic of chosen rows is of all rows, with its 95 % interval by drawing whole groups (buildings) with
    replacement; without one where there are fewer than `FEWEST_GROUPS`.

    Args:
        statistic: of row numbers (n,), which may come more than once.
        groups: of each row.
    """
    names, owner = np.unique(np.asarray(groups), return_inverse=True)
    every = f"{statistic(np.arange(len(owner))):.{digits}f}"
    if len(names) < FEWEST_GROUPS:
        return every
    members, rng = [np.flatnonzero(owner == k) for k in range(len(names))], np.random.default_rng(0)
    drawn = [np.concatenate([members[k] for k in rng.integers(len(names), size=len(names))]) for _ in range(DRAWS)]
    low, high = np.nanquantile([statistic(rows) for rows in drawn], [OUTSIDE, 1 - OUTSIDE])
    return f"{every} [{low:.{digits}f}, {high:.{digits}f}]"
