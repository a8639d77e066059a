"""Registrations that agree: a map that lies with neither of two others may say, by those with both, how these two lie (method 4:
agreement around cycles)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3

SAME_PLACE = 4.0  # log odds that an independent registration which gives the same place adds to its own
VOICE_MOST = 3.0  # log odds that one of them adds at most
Hypotheses = Mapping[tuple[int, int], tuple[PoseHypothesis, ...]]
Poses = Mapping[int, Sim3]


def same_place_odds(log_odds: float) -> float:
    """What a registration that gives the same place adds to the log odds of a pose, by its own."""
    return float(np.clip(log_odds + SAME_PLACE, 0.0, VOICE_MOST))


def ways_round(hypotheses: Hypotheses, pair: tuple[int, int], maps: Iterable[int]) -> Iterator[tuple[Sim3, float]]:
    """Poses T_ij by way of each of some other maps: from i to it and on to j by the best hypotheses; with the log odds of the one
    of both that is the less sure."""
    i, j = pair
    for k in maps:
        there, on = _best(hypotheses, i, k), _best(hypotheses, k, j)
        if there is not None and on is not None:
            yield there[0] @ on[0], min(there[1], on[1])


def across(a: Poses, b: Poses, pair: tuple[int, int], pose: Sim3) -> Sim3:
    """Where component b lies in component a, if map j of the one lies at T_ij in map i of the other; in any order."""
    i, j = pair
    if i not in a:
        i, j, pose = j, i, pose.inverse()
    return a[i] @ pose @ b[j].inverse()


def _best(hypotheses: Hypotheses, i: int, j: int) -> tuple[Sim3, float] | None:
    """The most probable T_ij with its log odds, of maps in any order; None where none was looked for or there is none."""
    best = next(iter(hypotheses.get((min(i, j), max(i, j)), ())), None)
    return None if best is None else (best.transform if i < j else best.transform.inverse(), best.log_odds)
