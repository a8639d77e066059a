"""The development floor among the pairs that the belief in merges is fitted to: real drift, which simulated maps have less of."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from topomerge.datasets.real.cached_grids import build_floor
from topomerge.training.belief_hypotheses import Row, judged_files, place_networks, row_of
from topomerge.training.task_settings import MergeBelief

CAPTURE_GROUPS = 5  # of captures; those of two groups are left out at a time


def floor_rows(settings: MergeBelief, say: Any) -> list[Row]:
    """The pairs of the floor with their judged hypotheses, cached; each weighs `settings.floor`, and none are taken where that
    is 0 or no real data is there."""
    if not settings.floor or not settings.data.folder:
        return []
    networks = place_networks(settings)
    paths = build_floor(settings.data.folder, settings.cache, say)
    rows = [row_of(path, networks) for path in judged_files("development_floor", [[p] for p in paths], settings, say)]
    return [{**row, "weight": settings.floor, "real": True} for row in rows if row["hyps"]]


def captures_left_out(rows: Sequence[Row]) -> Iterator[tuple[list[Row], list[Row]]]:
    """Rows of the floor to fit to and to judge, so that each row is judged once, by fits that saw neither of its captures."""
    names = sorted({name for row in rows for name in row["captures"].split("-")})
    group = {name: k % CAPTURE_GROUPS for k, name in enumerate(names)}
    of = [{group[name] for name in row["captures"].split("-")} for row in rows]
    for first in range(CAPTURE_GROUPS):
        for second in range(first, CAPTURE_GROUPS):
            judged = [row for row, groups in zip(rows, of, strict=True) if groups == {first, second}]
            if judged:
                yield [row for row, groups in zip(rows, of, strict=True) if not groups & {first, second}], judged
