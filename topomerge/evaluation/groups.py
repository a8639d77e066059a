"""Sums of counts over groups of pairs, as ratios with intervals: whole physical buildings are drawn again and again; of fewer
than eight their range stands there instead, and shares of rare events have exact intervals."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from topomerge.evaluation.score import GLIMPSED, GROUPS, WHOLE, Row
from topomerge.statistics import FEWEST_GROUPS, compute_exact_interval
from topomerge.types import Array

LEVELS = [2.5, 97.5]  # percent
Ratio = tuple[str, str]  # names of two counts


@dataclass(frozen=True)
class Value:
    """A ratio of counts with its 95 % interval, and what it is of; nan where nothing was counted.

    Args:
        low, high: ends of the interval; of fewer than eight buildings the least and the largest of a building.
        buildings: those of the rows.
        counted: those of them in which anything was counted: what the interval is over.
    """

    value: float
    low: float
    high: float
    pairs: int
    buildings: int
    counted: int = 0

    @property
    def ranged(self) -> bool:
        """Is the interval the range of the buildings?"""
        return self.counted < FEWEST_GROUPS


def _compute_f1(precision: Array, recall: Array) -> Array:
    both = precision + recall
    return np.where(both > 0, 2 * precision * recall / np.where(both > 0, both, 1), np.where(np.isnan(both), np.nan, 0.0))


RATIOS: dict[str, Ratio] = {
    **{f"precision{g}": (f"right{g}", f"predicted{g}") for g in GROUPS},
    **{f"recall{g}": (f"found{g}", f"units{g}") for g in GROUPS},
    **{f"recall@1{g}": (f"first{g}", f"queries{g}") for g in GROUPS},
    **{f"recall@5{g}": (f"five{g}", f"queries{g}") for g in GROUPS},
    **{f"MRR{g}": (f"reciprocal{g}", f"queries{g}") for g in GROUPS},
    **{f"recall@1{g}": (f"first{g}", f"queries{g}") for g in (WHOLE, GLIMPSED)},
    "recall@1_after": ("first_after", "queries"),
    "recall@1_single_after": ("first_single_after", "queries_single"),
    "recall@5_after": ("five_after", "queries"),
    "strict recall": ("strict_right", "strict_units"),
    "right poses": ("near", "mergeable"),
    "right finely": ("fine", "mergeable"),
    "every room": ("every_room", "with_rooms"),
    "rooms": ("rooms_near", "rooms_shared"),
    "merged": ("merged", "mergeable"),
    "merged finely": ("merged_fine", "mergeable"),
    "refused": ("refused", "mergeable"),
    "false": ("false", "pairs"),
    "seconds": ("seconds", "pairs"),
}
COMBINED: dict[str, tuple[str, str, Callable[[Array, Array], Array]]] = {
    f"F1{g}": (f"precision{g}", f"recall{g}", _compute_f1) for g in GROUPS
}


def measure(metric: str, counts: Mapping[str, Array]) -> Array:
    """Return a metric of sums of counts, element by element; nan where there is nothing to divide by."""
    if metric in COMBINED:
        first, second, combine = COMBINED[metric]
        return combine(measure(first, counts), measure(second, counts))
    top, bottom = (np.asarray(counts[name], float) for name in RATIOS[metric])
    return np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1), np.nan)


def list_needed_counts(metric: str) -> tuple[str, ...]:
    """Return the counts that a metric is made of."""
    if metric in COMBINED:
        return (*list_needed_counts(COMBINED[metric][0]), *list_needed_counts(COMBINED[metric][1]))
    return RATIOS[metric]


def sum_counts(rows: Sequence[Row], names: Iterable[str], buildings: Sequence[str]) -> dict[str, Array]:
    """Return counts (buildings,) by name."""
    number = {b: i for i, b in enumerate(buildings)}
    of = np.array([number[r["building"]] for r in rows], int)
    return {n: np.bincount(of, [float(r[n]) for r in rows], len(buildings)) for n in names}


@lru_cache(256)
def draw_buildings(buildings: int, rounds: int, seed: int = 0) -> Array:
    """(rounds, buildings) how often each building was drawn, with replacement."""
    drawn = np.random.default_rng(seed).integers(buildings, size=(rounds, buildings))
    rows = np.arange(rounds)[:, None] * buildings
    counts = np.bincount((drawn + rows).ravel(), minlength=rounds * buildings)
    return counts.reshape(rounds, buildings).astype(np.float64)  # a product of integers is no BLAS call


def compute_value(rows: Sequence[Row], metric: str, rounds: int = 2000) -> Value:
    """Return a metric over rows, all pairs summed, with its interval over buildings."""
    buildings = sorted({r["building"] for r in rows})
    if not rows:
        return Value(np.nan, np.nan, np.nan, 0, 0)
    counts = sum_counts(rows, list_needed_counts(metric), buildings)
    ratio = float(measure(metric, {n: c.sum() for n, c in counts.items()}))
    held, low, high = _estimate_interval(counts, rounds, lambda c: measure(metric, c))
    return Value(ratio, low, high, len({r["pair"] for r in rows}), len(buildings), held)


def compute_gain(rows: Sequence[Row], others: Sequence[Row], metric: str, rounds: int = 2000) -> Value:
    """Compute how much better rows are than others of the same pairs; buildings are drawn for both alike."""
    buildings = sorted({r["building"] for r in rows} | {r["building"] for r in others})
    if not rows or not others:
        return Value(np.nan, np.nan, np.nan, 0, 0)
    both = [sum_counts(compared_rows, list_needed_counts(metric), buildings) for compared_rows in (rows, others)]
    counts = {(side, name): c for side, of in enumerate(both) for name, c in of.items()}

    def better(c: Mapping[tuple[int, str], Array]) -> Array:
        first, second = (measure(metric, {name: v for (s, name), v in c.items() if s == side}) for side in (0, 1))
        return first - second

    held, low, high = _estimate_interval(counts, rounds, better)
    ratio = float(better({key: c.sum() for key, c in counts.items()}))
    return Value(ratio, low, high, len({r["pair"] for r in rows}), len(buildings), held)


def _estimate_interval(counts: Mapping[Any, Array], rounds: int, measured: Callable[[Any], Array]) -> tuple[int, float, float]:
    """Buildings in which anything was counted, and the ends of the interval over them: of draws, or of fewer than eight their
    range.

    Args:
        counts: (buildings,) each.
        measured: the metric of such counts, element by element.
    """
    held = np.any([c != 0 for c in counts.values()], axis=0)
    by_building = {key: c[held] for key, c in counts.items()}
    number = int(held.sum())
    if number >= FEWEST_GROUPS:
        drawn = draw_buildings(number, rounds)
        by_building = {key: drawn @ c for key, c in by_building.items()}
    values = measured(by_building)
    finite = values[np.isfinite(values)]
    if not len(finite):
        return number, float("nan"), float("nan")
    low, high = np.percentile(finite, LEVELS if number >= FEWEST_GROUPS else [0, 100]).tolist()
    return number, low, high


def count_hit_buildings(rows: Sequence[Row], count: str) -> tuple[int, int, float, float]:
    """Buildings with a row that has any of a count, all buildings, and the ends of the exact 95 % interval of their share: for
    what is rare, as wrong merges are."""
    buildings = {r["building"] for r in rows}
    hit = {r["building"] for r in rows if r[count]}
    return len(hit), len(buildings), *compute_exact_interval(len(hit), len(buildings))
