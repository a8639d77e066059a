"""What matching gives: rooms of two maps that are one room, and the transforms under which they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Array, Sim3


def _no_rooms() -> Array:
    return np.zeros((0, 2), np.int64)


@dataclass(frozen=True, eq=False)
class Matching:
    """Rooms of map a that are rooms of map b.

    Args:
        rooms: (M, 2) int64, ascending; most rooms are in one row at most, one that is cut in two in the other map is in two.
        probability: (M,) float64.
        transform: T_ab of the best hypothesis; None where rooms were matched without geometry.
        alternatives: all hypotheses, best first (the first one is that of `transform`).
        statistics: of the cost matrix and the search.
    """

    rooms: Array = field(default_factory=_no_rooms)
    probability: Array = field(default_factory=lambda: np.zeros(0))
    transform: Sim3 | None = None
    alternatives: tuple[PoseHypothesis, ...] = ()
    statistics: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.rooms.shape != (len(self.probability), 2):
            raise ValueError(f"rooms must be (M, 2) with a probability each, not {self.rooms.shape}")
