"""What matching gives: rooms of two maps that are one room, and the transforms under which they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from topomerge.types import Array, Sim3


def _no_rooms() -> Array:
    return np.zeros((0, 2), np.int64)


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One way to lay map b onto map a.

    Args:
        transform: T_ab.
        rooms: (M, 2) int64 rooms of a and of b that are one room then; a room may be in several.
        fit: (M,) float64 0..1, how well each of these pairs fits (share of floor in common).
        probability: that this is the right one, all hypotheses and "none of them" summing to 1 (`odds`).
        score: what the hypotheses are ranked by, m of walls.
        evidence: name -> number (metres of walls that agree, conflicts, m2 of floor in common, votes).
    """

    transform: Sim3
    rooms: Array
    fit: Array
    probability: float
    score: float
    evidence: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Matching:
    """Rooms of map a that are rooms of map b.

    Args:
        rooms: (M, 2) int64, ascending; most rooms are in one row at most, one that is cut in two in the other map is in two.
        probability: (M,) float64.
        transform: T_ab of the best hypothesis; None where rooms were matched without geometry.
        alternatives: all hypotheses kept, best first (the first one is that of `transform`).
        statistics: of the cost matrix and the search.
    """

    rooms: Array = field(default_factory=_no_rooms)
    probability: Array = field(default_factory=lambda: np.zeros(0))
    transform: Sim3 | None = None
    alternatives: tuple[Hypothesis, ...] = ()
    statistics: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.rooms.shape != (len(self.probability), 2):
            raise ValueError(f"rooms must be (M, 2) with a probability each, not {self.rooms.shape}")
