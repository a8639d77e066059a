"""Sums of counts over groups of pairs, as ratios with intervals: whole buildings are drawn again and again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from topomerge.evaluation.score import GROUPS, WHOLE, Row
from topomerge.types import Array

LEVELS = [2.5, 97.5]  # percent
Ratio = tuple[str, str]  # names of two counts


@dataclass(frozen=True)
class Value:
    """A ratio of counts with its 95 % interval, and how many pairs and buildings it is of; nan where nothing was counted."""

    value: float
    low: float
    high: float
    pairs: int
    buildings: int


def _f1(precision: Array, recall: Array) -> Array:
    both = precision + recall
    return np.where(both > 0, 2 * precision * recall / np.where(both > 0, both, 1), np.where(np.isnan(both), np.nan, 0.0))


RATIOS: dict[str, Ratio] = {
    **{f"precision{g}": (f"right{g}", f"predicted{g}") for g in GROUPS},
    **{f"recall{g}": (f"found{g}", f"units{g}") for g in GROUPS},
    **{f"recall@1{g}": (f"first{g}", f"queries{g}") for g in GROUPS},
    **{f"recall@5{g}": (f"five{g}", f"queries{g}") for g in GROUPS},
    **{f"MRR{g}": (f"reciprocal{g}", f"queries{g}") for g in GROUPS},
    f"recall@1{WHOLE}": (f"first{WHOLE}", f"queries{WHOLE}"),
    "recall@1_after": ("first_after", "queries"),
    "recall@1_single_after": ("first_single_after", "queries_single"),
    "recall@5_after": ("five_after", "queries"),
    "strict recall": ("strict_right", "strict_units"),
    "right poses": ("near", "mergeable"),
    "merged": ("merged", "mergeable"),
    "merged finely": ("merged_fine", "mergeable"),
    "refused": ("refused", "mergeable"),
    "false": ("false", "pairs"),
    "seconds": ("seconds", "pairs"),
}
COMBINED: dict[str, tuple[str, str, Callable[[Array, Array], Array]]] = {
    f"F1{g}": (f"precision{g}", f"recall{g}", _f1) for g in GROUPS
}


def measure(metric: str, counts: Mapping[str, Array]) -> Array:
    """A metric of sums of counts, element by element; nan where there is nothing to divide by."""
    if metric in COMBINED:
        first, second, combine = COMBINED[metric]
        return combine(measure(first, counts), measure(second, counts))
    top, bottom = (np.asarray(counts[name], float) for name in RATIOS[metric])
    return np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1), np.nan)


def needed(metric: str) -> tuple[str, ...]:
    """The counts that a metric is made of."""
    if metric in COMBINED:
        return (*needed(COMBINED[metric][0]), *needed(COMBINED[metric][1]))
    return RATIOS[metric]


def summed(rows: Sequence[Row], names: Iterable[str], buildings: Sequence[str]) -> dict[str, Array]:
    """Counts (buildings,) by name."""
    number = {b: i for i, b in enumerate(buildings)}
    of = np.array([number[r["building"]] for r in rows], int)
    return {n: np.bincount(of, [float(r[n]) for r in rows], len(buildings)) for n in names}


@lru_cache(256)
def draws(buildings: int, rounds: int, seed: int = 0) -> Array:
    """(rounds, buildings) how often each building was drawn, with replacement."""
    drawn = np.random.default_rng(seed).integers(buildings, size=(rounds, buildings))
    rows = np.arange(rounds)[:, None] * buildings
    counts = np.bincount((drawn + rows).ravel(), minlength=rounds * buildings)
    return counts.reshape(rounds, buildings).astype(np.float64)  # a product of integers is no BLAS call


def value(rows: Sequence[Row], metric: str, rounds: int = 2000) -> Value:
    """A metric over rows, all pairs summed, with its interval over buildings."""
    buildings = sorted({r["building"] for r in rows})
    if not rows:
        return Value(np.nan, np.nan, np.nan, 0, 0)
    counts = summed(rows, needed(metric), buildings)
    ratio = float(measure(metric, {n: c.sum() for n, c in counts.items()}))
    low, high = _interval(measure(metric, {n: draws(len(buildings), rounds) @ c for n, c in counts.items()}))
    return Value(ratio, low, high, len({r["pair"] for r in rows}), len(buildings))


def gain(rows: Sequence[Row], others: Sequence[Row], metric: str, rounds: int = 2000) -> Value:
    """How much better rows are than others, of the same pairs; buildings are drawn for both alike."""
    buildings = sorted({r["building"] for r in rows} | {r["building"] for r in others})
    if not rows or not others:
        return Value(np.nan, np.nan, np.nan, 0, 0)
    drawn = draws(len(buildings), rounds)
    ratios, drawn_ratios = [], []
    for compared_rows in (rows, others):
        counts = summed(compared_rows, needed(metric), buildings)
        ratios.append(float(measure(metric, {n: c.sum() for n, c in counts.items()})))
        drawn_ratios.append(measure(metric, {n: drawn @ c for n, c in counts.items()}))
    low, high = _interval(drawn_ratios[0] - drawn_ratios[1])
    return Value(ratios[0] - ratios[1], low, high, len({r["pair"] for r in rows}), len(buildings))


def _interval(values: Array) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    if not len(finite):
        return float("nan"), float("nan")
    low, high = np.percentile(finite, LEVELS).tolist()
    return low, high


@dataclass(frozen=True)
class Calibration:
    """Reliability: of each bin (B,) of predicted probabilities their mean, the share that was right, and how many; and the
    expected calibration error, the mean over all of the difference."""

    probability: Array
    right: Array
    count: Array
    error: float


def calibration(probabilities: Sequence[float], right: Sequence[bool], bins: int = 10) -> Calibration:
    """Probabilities against what came true, in bins of equal width; empty bins are left out."""
    p, y = np.asarray(probabilities, float), np.asarray(right, float)
    which = np.minimum((p * bins).astype(int), bins - 1)
    count = np.bincount(which, minlength=bins)
    held = count > 0
    mean = [np.bincount(which, v, bins)[held] / count[held] for v in (p, y)]
    error = float((count[held] * abs(mean[0] - mean[1])).sum() / len(p)) if len(p) else float("nan")
    return Calibration(mean[0], mean[1], count[held], error)
