"""Rows of a map whose scale is not known: those at the scale at which the network that sees both maps is surest of its matches."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from topomerge.embedding.turns import Rows
from topomerge.matching.room_matcher import RoomOdds, room_odds
from topomerge.types import TopometricMap

SCALES_TRIED = np.exp(np.linspace(np.log(0.5), np.log(2.0), 15))  # steps of a tenth: crops that much too large still look alike

AtScale = Callable[[TopometricMap, float], Rows]


def odds_at_best_scale(at_scale: AtScale, of_a: Rows, b: TopometricMap) -> tuple[float, tuple[RoomOdds, ...]]:
    """m that the unit of b is taken for, and the partners of the rooms of both maps at each quarter turn then; 1 and none where
    the rows are of an embedder for which there is no such network.

    Args:
        at_scale: map, scale -> rows (`Learned.at_scale`).
        of_a: rows of the first map, whose scale is known.
    """
    best, sureness = (1.0, room_odds(of_a, at_scale(b, 1.0))), -1.0
    if not best[1]:
        return best
    for scale in SCALES_TRIED.tolist():
        odds = room_odds(of_a, at_scale(b, scale))
        surest = max(turned.sureness for turned in odds)
        if surest > sureness:
            best, sureness = (scale, odds), surest
    return best
