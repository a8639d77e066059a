"""What the verdict stands on: tables of docs/results/belief.md, of training pairs and of the development floor.

    python -m benchmarks.merging.belief docs/results/belief.md [words of train.py task=merge_belief]

Fits the verdict anew with and without each part of the evidence, each time with buildings left out in turn, and says what is
believed then, right and wrong; on the development floor with both captures of a pair left out. The pairs are those of the task
(``data=grids``, look-alikes, the floor), made and cached where they are missing; no test building is read. The tables of the page
are written anew.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.merging.tables import put
from topomerge.registration.verify import BELIEF_VECTOR, BENT_POSE_VECTOR, PLACE_VECTOR
from topomerge.training import merge_belief
from topomerge.training.belief_floor import captures_left_out, floor_rows
from topomerge.training.belief_hypotheses import belief_rows, fair, kind_of
from topomerge.training.belief_lookalikes import lookalike_rows
from topomerge.training.belief_models import logits, risk_curve, what_it_is
from topomerge.training.task_settings import MergeBelief
from topomerge.training.tasks import settings_of
from topomerge.types import Array

Row = dict[str, Any]
Judged = tuple[Row, float, int]  # of a pair: its row, the probability of its best pose, its label
BENDING = ("margin", "ahead", "alone", "strain", "doubted")
PARTS = {  # what is left out
    "all evidence": (),
    "without places": PLACE_VECTOR,
    "without repetition": ("repeats",),
    "without the lead between bent maps": BENDING,
    "whole-map features only": (*PLACE_VECTOR, *BENDING, "repeats"),
}
SHARES = (0.25, 0.5, 1.0)  # of the simulated pairs
THRESHOLDS = (0.5, 0.6, 0.65, 0.7, 0.8, 0.9)
LARGE_AREAS = ("80-200", ">200")


def without(rows: Sequence[Row], names: Sequence[str]) -> list[Row]:
    """Rows whose hypotheses tell nothing of some features of places; of the rest `silenced` takes care."""
    if not set(names) & set(PLACE_VECTOR):
        return list(rows)
    nothing = {"place_mean": 0.0, "place_worst": 0.0, "place_area": 0.0}
    hyps = [[{**h, "bent": {**h["bent"], **nothing}} if "bent" in h else h for h in row["hyps"]] for row in rows]
    return [{**row, "hyps": given} for row, given in zip(rows, hyps, strict=True)]


def left_out(rows: Sequence[Row], floor: Sequence[Row], settings: MergeBelief) -> tuple[list[Judged], list[Judged]]:
    """Pairs judged by fits that saw none of their building; those of the floor by fits that saw neither of their captures."""
    judged: list[Judged] = []
    for flat in (False, True):
        chosen = [row for row in (*rows, *floor) if flat or "drawing" not in row["sensors"]]
        _, (scored, believed, true) = merge_belief.fit_models(chosen, flat, settings)
        judged += [(r, float(p), int(y)) for r, p, y in zip(scored, believed, true, strict=True) if not r.get("real")]
    of_floor: list[Judged] = []
    for fitted_to, held_back in captures_left_out(floor):
        models, _ = merge_belief.fit_models([*rows, *fitted_to], True, settings)
        of_floor += applied(held_back, models)
    return judged, of_floor


def applied(rows: Sequence[Row], models: Mapping[str, Any]) -> Iterator[Judged]:
    """Pairs judged by given models."""
    t = merge_belief.tabled(list(rows))
    scores = np.where(t.looked, logits(models["bent"], np.nan_to_num(t.bent)), -np.inf)
    for i, row in enumerate(rows):
        if (first := merge_belief.best(t, scores, models["bent"], i)) is not None:
            odds = float(logits(models["winner"], first[1][None])[0])
            yield row, min(1 / (1 + np.exp(-odds)), first[2]), int(t.y[first[0]])


def silenced(names: Sequence[str]) -> Any:
    """`merge_belief.belief_vector` with features that are always 0."""
    usual = merge_belief.belief_vector
    columns = [BELIEF_VECTOR.index(n) for n in names if n not in BENT_POSE_VECTOR]

    def quiet(*given: Any) -> Array:
        x = usual(*given)
        x[columns] = 0.0
        return x

    return quiet


def figures(judged: Sequence[Judged], floor: Sequence[Judged], threshold: float) -> list[str]:
    """Cells of a table: right and believed of simulated pairs that share 80 m2 and of those that share 40 to 80, of the floor;
    falsely believed by kind, and in a thousand pairs."""
    ordinary = [j for j in judged if "lookalike" not in j[0]]

    def believed(chosen: Sequence[Judged], label: int) -> str:
        mine = [j for j in chosen if label == 1 or j[2] == label]
        return f"{sum(p >= threshold and y == label for _, p, y in mine)} of {len(mine)}"

    large = [j for j in ordinary if kind_of(j[0]) in LARGE_AREAS]
    some = [j for j in ordinary if kind_of(j[0]) == "40-80"]
    kinds = [[j for j in ordinary if j[2] == 0 and what_it_is(j[0], 0) == k] for k in ("building", "storey", "wing")]
    alike = [j for j in judged if "lookalike" in j[0] and j[0]["tellable"] and j[2] == 0]
    chosen = [j for j in judged if j[0].get("tellable") is not False]
    arrays = [np.array(x) for x in zip(*((p, y, what_it_is(r, y), r.get("weight", 1.0)) for r, p, y in chosen), strict=True)]
    false = next(f for t, f in risk_curve(*arrays) if t >= threshold - 1e-9)
    cells = [believed(large, 1), believed(some, 1), believed(floor, 1), believed(floor, 0)]
    return [*cells, *(believed(k, 0) for k in (*kinds, alike)), f"{false:.0f}"]


BELIEF_HEADS = (
    "≥ 80 m²", "40–80 m²", "development floor", "floor, pose wrong", "other buildings", "other storeys", "twin wings",
    "look-alikes", "false merges per 1,000",
)  # fmt: skip


def tables(rows: Sequence[Row], floor: Sequence[Row], settings: MergeBelief) -> list[str]:
    """The lines of the page."""
    usual, lines = merge_belief.belief_vector, []
    whole, of_floor = left_out(rows, floor, settings)
    lines += ["### By threshold", "", *head("threshold")]
    lines += [line(f"{t:g}", figures(whole, of_floor, t)) for t in THRESHOLDS]
    threshold = float(merge_belief.model()["threshold"])
    lines += ["", f"### Contribution of each part of the evidence (threshold {threshold:g})", "", *head("evidence")]
    for name, silent in PARTS.items():
        merge_belief.belief_vector = silenced(silent)
        lines.append(line(name, figures(*left_out(without(rows, silent), without(floor, silent), settings), threshold)))
    merge_belief.belief_vector = usual
    lines.append(line("without the development floor in the fit", figures(*without_floor(rows, floor, settings), threshold)))
    lines += ["", f"### Number of training pairs (threshold {threshold:g})", "", *head("simulated pairs")]
    order = np.random.default_rng(0).permutation(len(rows))
    for share in SHARES:
        some = [rows[k] for k in sorted(order[: round(share * len(rows))])]
        models = [merge_belief.fit_models([*some, *floor], flat, settings)[0] for flat in (False, True)]
        lines.append(line(str(models[1]["pairs"]), figures(*left_out(some, floor, settings), threshold)))
    return lines


def without_floor(rows: Sequence[Row], floor: Sequence[Row], settings: MergeBelief) -> tuple[list[Judged], list[Judged]]:
    """As `left_out`, with no pair of the floor in any fit."""
    judged, _ = left_out(rows, [], settings)
    models, _ = merge_belief.fit_models(list(rows), True, settings)
    return judged, list(applied(floor, models))


def head(first: str) -> list[str]:
    """Two lines."""
    return [f"| {first} | {' | '.join(BELIEF_HEADS)} |", "|---" * (len(BELIEF_HEADS) + 1) + "|"]


def line(first: str, cells: Sequence[str]) -> str:
    """A line."""
    return f"| {first} | {' | '.join(cells)} |"


def main(page: str, *words: str) -> None:
    """Write the tables."""
    settings = settings_of(["task=merge_belief", *words])
    rows = [r for r in belief_rows(settings.data, settings, print) if r["hyps"] and fair(r)]
    rows += [r for r in lookalike_rows(settings.alike, settings, print) if r["hyps"]]
    put(Path(page), "\n".join(tables(rows, floor_rows(settings, print), settings)), "belief")


if __name__ == "__main__":
    main(*sys.argv[1:])
