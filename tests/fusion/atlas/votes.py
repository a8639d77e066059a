"""Pairs of maps of which nothing is there but what they show: for the tests of evidence."""

from __future__ import annotations

import numpy as np

from topomerge.fusion.atlas.pairs import Check, Conflict
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3

LIMIT = 2.0  # log odds
PLACE = np.array([[0.0, 0, 0], [3, 0, 0], [-3, 0, 0], [0, 3, 0], [0, -3, 0]])
TRUE = dict(enumerate(
    (Sim3(), Sim3(0.4, (9.0, 1.0, 0.0)), Sim3(-2.5, (3.0, 7.0, 0.2)), Sim3(3.0, (-4.0, 5.0, 0.1)), Sim3(1.0, (2.0, 2.0, 0.0)))
))  # fmt: skip
WRONG = Sim3(0.0, (6.0, 0.0, 0.0))
Pair = tuple[int, int]


def between(i: int, j: int) -> Sim3:
    """The true T_ij."""
    return TRUE[i].inverse() @ TRUE[j]


class Votes:
    """In place of `Checks`: what pairs say to their true pose and to any other one; who has no vote does not overlap."""

    def __init__(self, to_true: dict[Pair, float] | None = None, to_others: dict[Pair, float] | None = None) -> None:
        self.to_true, self.to_others = to_true or {}, to_others or {}
        self.walls: dict[Pair, float] = {}
        self.conflicts: dict[Pair, np.ndarray] = {}  # places, in the frame of the first map
        self.measured: dict[Pair, Sim3] = {}

    def __call__(self, i: int, j: int, pose: Sim3) -> Check:
        if j < i:
            turned = self(j, i, pose.inverse())
            return Check(turned.pose.inverse(), turned.log_odds, turned.overlap, turned.features)
        true = np.allclose(pose.apply(PLACE), between(i, j).apply(PLACE), atol=0.5)
        said = (self.to_true if true else self.to_others).get((i, j))
        walls = {"walls": self.walls.get((i, j), 5.0)}
        at = [Conflict(tuple(self.conflicts[i, j].tolist()), 1.0)] if (i, j) in self.conflicts else []
        return Check(self.measured.get((i, j), pose), said or 0.0, said is not None, walls, tuple(at))

    def locate_place(self, i: int, j: int, pose: Sim3) -> np.ndarray:
        return PLACE

    def fine(self, i: int, j: int, pose: Sim3) -> Sim3:
        return pose


def claim(i: int, j: int, p: float, off: Sim3 | None = None) -> tuple[PoseHypothesis, ...]:
    """A hypothesis of maps i and j, true unless it is `off`."""
    return (PoseHypothesis((off or Sim3()) @ between(i, j), probability=p),)


def odds(p: float) -> float:
    return float(np.log(p / (1 - p)))
