"""Rows of a map whose scale is not known: at the scale at which the network that sees both maps is surest of its matches."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from topomerge.embedding.turns import Rows
from topomerge.matching.room_matcher import RoomOdds, room_odds

COARSE_SCALES = tuple(np.exp(np.linspace(np.log(0.5), np.log(2.0), 8)).tolist())  # steps of a fifth: crops still look alike
FINE_STEP = COARSE_SCALES[1] / COARSE_SCALES[0]

RowsAt = Callable[[float], Rows]


def odds_at_best_scale(of_a: Rows, of_b: Rows, rows_at: RowsAt) -> tuple[float, tuple[RoomOdds, ...]]:
    """m that the unit of the second map is taken for, and the partners of the rooms of both maps at each quarter turn then; 1 and
    none where the rows are of an embedder for which there is no such network.

    Args:
        of_a: rows of the first map, whose scale is known.
        of_b: rows of the second one as it is.
        rows_at: scale -> rows of the second one (`Learned.at_scales`).
    """
    if not room_odds(of_a, of_b, likeliest=True):
        return 1.0, ()
    rows: dict[float, Rows] = {}

    def sureness(scale: float) -> float:
        """At the quarter turn that most rooms which look alike vote for: all four take four times as long."""
        rows[scale] = rows[scale] if scale in rows else rows_at(scale)
        return room_odds(of_a, rows[scale], likeliest=True)[0].sureness

    best = max(COARSE_SCALES, key=sureness)
    best = max([best, best / FINE_STEP**0.5, best * FINE_STEP**0.5], key=sureness)
    return best, room_odds(of_a, rows[best])
