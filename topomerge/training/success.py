"""Merge success of a network while it is trained: do the rooms that it matches put one map where it belongs in the other?

A cheap stand-in for `merge`, which also looks at walls and free space: only middles of rooms and doors, no cells. So it says less
than a merge finds, and is good to compare epochs and networks.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from topomerge.matching.assignment import align, assign_certain
from topomerge.types import Array, Sim3

LEAST_CERTAINTY = 0.05  # certainty of a match that is looked at
MOST_PLACES = 100  # places
PLACES_APART = 1.0  # m between two places that tell a direction
LARGEST_STRETCH = 0.5  # m by which two places may be farther apart in one map than in the other
DOOR_OFF, MIDDLE_OFF = 0.5, 1.5  # m by which one door, and the middle of one room may be off: a map may have seen a part
LEVEL_OFF = 0.7  # m
REFINEMENT_ROUNDS = 3
RIGHT_WITHIN = (0.5, 5.0)  # m, degrees


class MatchedPlaces(NamedTuple):
    """Places (P,) of both maps that are one if a match is right: middles of its rooms, and their doors with each other."""

    to: Array  # (P, 3) in a
    of: Array  # (P, 3) in b
    match: Array  # (P,) ascending
    off: Array  # (P,) m by which they may differ


def estimate_pose(a: Mapping[str, Array], b: Mapping[str, Array], certain: Array) -> Sim3 | None:
    """T_ab under which the most matches, by their certainty, agree; None where no two places tell one.

    Args:
        a, b: `pos`, `edge_pos` and `edge_index` of both graphs (`embedding.graph`).
        certain: (R_a, R_b) `matching.scores.compute_certainty`.
    """
    pairs = assign_certain(certain, LEAST_CERTAINTY)
    pairs = pairs[np.argsort(-certain[tuple(pairs.T)], kind="stable")]
    places = _collect_places(a, b, pairs)
    turn, move, rise = _compute_candidates(places)
    if not len(turn):
        return None
    flat = [x[:, 0] + 1j * x[:, 1] for x in (places.to, places.of)]
    away = abs(turn[:, None] * flat[1] + move[:, None] - flat[0])
    level = abs(places.of[:, 2] + rise[:, None] - places.to[:, 2]) <= LEVEL_OFF
    fit = np.maximum(1 - away / places.off, 0) * level
    first = np.flatnonzero(np.diff(places.match, prepend=-1))
    score = np.maximum.reduceat(fit, first, axis=1) @ certain[tuple(pairs[places.match[first]].T)]
    best = int(score.argmax())
    agreeing = fit[best] > 0
    for _ in range(REFINEMENT_ROUNDS):
        pose, _ = align(places.to[agreeing], places.of[agreeing], weight=1 / places.off[agreeing] ** 2)
        agreeing = np.linalg.norm(pose.apply(places.of) - places.to, axis=1) <= places.off
        if agreeing.sum() < 2:
            break
    return pose


def _collect_places(a: Mapping[str, Array], b: Mapping[str, Array], pairs: Array) -> MatchedPlaces:
    to: list[Array] = []
    of: list[Array] = []
    match: list[int] = []
    off: list[float] = []
    for k, (i, j) in enumerate(pairs.tolist()):
        if len(to) > MOST_PLACES:
            break
        doors = [g["edge_pos"][g["edge_index"][0] == room] for g, room in ((a, i), (b, j))]
        doors_a, doors_b = (n.ravel() for n in np.meshgrid(*(np.arange(len(d)) for d in doors), indexing="ij"))
        to += [a["pos"][i], *doors[0][doors_a]]
        of += [b["pos"][j], *doors[1][doors_b]]
        match += [k] * (len(doors_a) + 1)
        off += [MIDDLE_OFF, *[DOOR_OFF] * len(doors_a)]
    return MatchedPlaces(np.array(to).reshape(-1, 3), np.array(of).reshape(-1, 3), np.array(match, int), np.array(off))


def _compute_candidates(places: MatchedPlaces) -> tuple[Array, Array, Array]:
    """(C,) turn and move as complex numbers, and rise, m, of every two places that are as far apart in both maps."""
    far = [np.linalg.norm(x[:, None, :2] - x[None, :, :2], axis=2) for x in (places.to, places.of)]
    alike = (np.minimum(*far) >= PLACES_APART) & (abs(far[0] - far[1]) <= LARGEST_STRETCH)
    p, q = np.nonzero(np.triu(alike, 1))
    to, of = (x[:, 0] + 1j * x[:, 1] for x in (places.to, places.of))
    turn = (to[q] - to[p]) / (of[q] - of[p])
    turn = turn / abs(turn)
    rise = (places.to[p, 2] + places.to[q, 2] - places.of[p, 2] - places.of[q, 2]) / 2
    return turn, (to[p] + to[q] - turn * (of[p] + of[q])) / 2, rise


def is_pose_right(pose: Sim3 | None, truth: Array, at: Array) -> bool:
    """Return whether a pose is right within 0.5 m and 5 degrees.

    Args:
        truth: (4, 4) T_ab.
        at: (3,) a point of b, where the error is measured.
    """
    if pose is None:
        return False
    off = pose.apply(at[None])[0] - (truth[:3, :3] @ at + truth[:3, 3])
    turned = pose.yaw - np.arctan2(truth[1, 0], truth[0, 0])
    turned = abs(np.degrees((turned + np.pi) % (2 * np.pi) - np.pi))
    return bool(np.linalg.norm(off) <= RIGHT_WITHIN[0] and turned <= RIGHT_WITHIN[1])
