"""Storeys of segments that are drawn column by column."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.plans.passages import Pair, Passage
from topomerge.extraction.plans.plan import build_profile_bands
from topomerge.extraction.plans.storey_plan import COLUMN_CLASSES, ClassifiedStorey, StoreyPlan
from topomerge.extraction.segment import Scorer, SegmentedStorey, partition_rooms
from topomerge.types import Array


def storey_of(
    segment: Array, passages: dict[Pair, Passage], clearance: Array | None = None, edge: float = 0.1
) -> SegmentedStorey:
    """A storey at height 0 whose first column is at the origin; what is of no segment is wall."""
    shape, nothing = segment.shape, np.full(segment.shape, np.nan)
    inside, profile = segment >= 0, np.zeros(segment.shape, np.uint64)
    plan = StoreyPlan(
        np.zeros(2), edge, ~inside, inside, profile, build_profile_bands(edge), np.zeros(shape), nothing, np.full(shape, 3.0)
    )
    classes = ClassifiedStorey(np.zeros((*shape, len(COLUMN_CLASSES)), np.float32), np.zeros(2), edge, 0.0)
    return SegmentedStorey(0, plan, classes, np.ones(shape) if clearance is None else clearance, segment, passages)


def find_rooms_of_segments(
    segment: Array,
    clearance: Array,
    passages: dict[Pair, Passage],
    score: Scorer,
    least: float = 0.8,
    edge: float = 0.1,
) -> Array:
    """(n,) room of each segment."""
    return partition_rooms(storey_of(segment, passages, clearance, edge), score, 0.5, least).room_of_segment
