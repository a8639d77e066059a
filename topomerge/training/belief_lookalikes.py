"""Look-alikes (`datasets.pairs.lookalikes`) among the pairs that the belief in merges is fitted to and judged by.

A pair that somebody can tell apart is a wrong merge like any other. Of those that nobody can tell apart, only those whose
repetition a map shows by itself (two equal modules or more) train: their best pose has rivals a period away, from which the
verdict can learn to abstain. The others (two whole corridors, two empty rooms of one size) show nothing that a right merge would
not show, too; like twin wings that are the same where both maps look, they train nothing (`belief_hypotheses.fair`), and are
counted by themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from topomerge.datasets.pairs.lookalikes import LookalikeRecipe, build_lookalikes
from topomerge.training.belief_hypotheses import Row, judged_files, place_networks, row_of
from topomerge.training.task_settings import MergeBelief
from topomerge.types import Array


def lookalike_rows(recipe: LookalikeRecipe, settings: MergeBelief, say: Any) -> list[Row]:
    """The look-alikes of a set with their judged hypotheses, cached; none where the task takes none. ``judged_only``: trains
    nothing."""
    if settings.lookalikes == "none":
        return []
    paths, _ = build_lookalikes(recipe, settings, say)
    networks = place_networks(settings)
    rows = [row_of(file, networks) for file in judged_files(recipe.name, [[path] for path in paths], settings, say)]
    judged = [settings.lookalikes == "judged" or not teaches(row) for row in rows]
    return [{**row, "judged_only": only, "weight": settings.alike_weight} for row, only in zip(rows, judged, strict=True)]


def teaches(row: Row) -> bool:
    """May a look-alike train the belief?"""
    return bool(row["tellable"] or row["repeats"])


def lookalike_scores(rows: Sequence[Row], believed: Array, true: Array, threshold: float) -> dict[str, float]:
    """Shares of look-alikes that are wrong and believed, of those that somebody can tell apart (``tellable``) and of the others
    (``untellable``), and their numbers. Ordinary pairs are passed over; pairs that fit in no one pose are not wrong."""
    out: dict[str, float] = {}
    wrong = (np.asarray(true) == 0) & (np.asarray(believed) >= threshold)
    for name, tellable in (("tellable", True), ("untellable", False)):
        chosen = np.array([row.get("tellable") is tellable for row in rows], bool)
        if chosen.any():
            out |= {f"wrong_believed_{name}": float(wrong[chosen].mean()), f"pairs_{name}": float(chosen.sum())}
    return out
