"""How sure a figure is: intervals over buildings, calibration of probabilities, precision and recall of a verdict.

Pairs of one building are not independent, so intervals are over groups (physical buildings): exact for shares of rare events,
by bootstrap for means; of a few groups their range.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import beta, t

from topomerge.types import Array

OUTSIDE = 0.025  # share of the distribution below, and above, a 95 % interval
FEWEST_GROUPS = 8  # from which on a bootstrap over groups says something
NEAR_ZERO = 0.1  # probabilities below it are the mass near zero, which makes any forecast look calibrated
CHANCE_ROUNDS = 500


def compute_exact_interval(hits: int, n: int) -> tuple[float, float]:
    """Compute the ends of the 95 % interval of a share of which `hits` of `n` were seen (Clopper & Pearson, Biometrika 1934); 0
    and 1 where n is 0.

    Raises:
        ValueError: hits below 0 or above n.
    """
    if not 0 <= hits <= n:
        raise ValueError(f"{hits} hits of {n}")
    low = float(beta.ppf(OUTSIDE, hits, n - hits + 1)) if hits else 0.0
    high = float(beta.ppf(1 - OUTSIDE, hits + 1, n - hits)) if hits < n else 1.0
    return low, high


def estimate_mean(values: Array) -> tuple[float, float, float]:
    """Estimate the mean of a few independent values (n,), such as scores of seeds, and the ends of its 95 % confidence interval
    by Student's t, which are nan where there is one value only."""
    values = np.asarray(values, float)
    mean = float(values.mean())
    if len(values) < 2:
        return mean, float("nan"), float("nan")
    half = float(t.ppf(1 - OUTSIDE, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))
    return mean, mean - half, mean + half


def bootstrap_mean(values: Array, groups: Array, rounds: int = 2000, seed: int = 0) -> tuple[float, float, float]:
    """Return mean of values and the ends of its 95 % confidence interval, drawing whole groups (buildings) with replacement.

    Args:
        values: (n,), nan where a value does not exist: left out.
        groups: (n,) what each value belongs to.
    """
    total, count = _sum_groups(values, groups)
    if not len(total):
        return float("nan"), float("nan"), float("nan")
    drawn = np.random.default_rng(seed).integers(len(total), size=(rounds, len(total)))
    means = total[drawn].sum(axis=1) / count[drawn].sum(axis=1)
    low, high = np.quantile(means, [OUTSIDE, 1 - OUTSIDE]).tolist()
    return float(total.sum() / count.sum()), low, high


def format_interval(values: Array, groups: Array, digits: int = 2, unit: float = 1.0) -> str:
    """Return a mean with its interval by `bootstrap_mean`, `0.62 [0.50, 0.71]`; of fewer than eight groups with the range of the
    groups' means instead, `0.71, 0.62–0.91 (4 buildings)`; a dash where there is no value. A share that is 0 or 1 throughout has
    the `compute_exact_interval` over groups: drawing equal values again says nothing.

    Args:
        values, groups: as of `bootstrap_mean`.
        digits: behind the point.
        unit: what values are multiplied by: 100 for per cent.
    """
    total, count = _sum_groups(values, groups)
    if not len(total):
        return "–"
    share = float(total.sum() / count.sum())
    ends = (
        compute_exact_interval(int(share) * len(total), len(total)) if share in (0.0, 1.0) else bootstrap_mean(values, groups)[1:]
    )
    mean, low, high = (f"{unit * v:.{digits}f}" for v in (share, *ends))
    if len(total) >= FEWEST_GROUPS:
        return f"{mean} [{low}, {high}]"
    if len(total) == 1:
        return f"{mean} (1 building)"
    means = unit * total / count
    return f"{mean}, {means.min():.{digits}f}–{means.max():.{digits}f} ({len(total)} buildings)"


def _sum_groups(values: Array, groups: Array) -> tuple[Array, Array]:
    """Return the sum and number of the finite values of each group that has any."""
    values, groups = np.asarray(values, float), np.asarray(groups)
    finite = np.isfinite(values)
    _, group = np.unique(groups[finite], return_inverse=True)
    return np.bincount(group, values[finite]), np.bincount(group)


@dataclass(frozen=True)
class Calibration:
    """Probabilities against what came true (`measure_calibration`).

    Args:
        error: expected calibration error: mean over all of the distance between a bin's two shares; nan where there are none.
        by_chance: what that error is on average where every probability is true: few values differ from their mean.
        count: (B,) how many are in each bin.
        probability: (B,) mean of each bin, ascending.
        right: (B,) share of each bin that was right.
        above: the same of the probabilities from 0.1 on; None: of none, or this one is.
    """

    error: float
    by_chance: float
    count: Array
    probability: Array
    right: Array
    above: Calibration | None = None


def measure_calibration(probability: Sequence[float] | Array, right: Sequence[bool] | Array, bins: int = 10) -> Calibration:
    """Measure probabilities against what came true, in bins of equal mass, with and without the mass near zero.

    Equal probabilities are in one bin, so that bins differ in size where many are equal; empty ones are left out.

    Args:
        probability: (n,) 0 to 1.
        right: (n,) did it come true?
    """
    p, y = np.asarray(probability, float), np.asarray(right, float)
    high = p >= NEAR_ZERO
    above = Calibration(*_compute_reliability(p[high], y[high], bins)) if high.any() else None
    return Calibration(*_compute_reliability(p, y, bins), above)


def _compute_reliability(p: Array, y: Array, bins: int) -> tuple[float, float, Array, Array, Array]:
    """Return the error, and what it is by chance; number, mean, and share that is right of each bin."""
    if not len(p):
        return float("nan"), float("nan"), np.zeros(0, int), np.zeros(0), np.zeros(0)
    which = np.searchsorted(np.sort(p), p, "left") * bins // len(p)  # of equal ones the rank of the first
    _, which = np.unique(which, return_inverse=True)
    count = np.bincount(which)
    mean, share = np.bincount(which, p) / count, np.bincount(which, y) / count
    drawn = np.random.default_rng(0).random((CHANCE_ROUNDS, len(p))) < p
    members = (which[:, None] == np.arange(len(count))).astype(float)
    by_chance = np.abs(drawn.astype(float) @ members - mean * count).sum(axis=1).mean() / len(p)
    return float(np.abs((share - mean) * count).sum() / len(p)), float(by_chance), count, mean, share


def compute_precision_recall(
    score: Sequence[float] | Array, right: Sequence[bool] | Array, possible: int
) -> tuple[Array, Array, Array]:
    """Compute (thresholds, precision, recall), each (k,), of a verdict for every threshold, the strictest first.

    Args:
        score: (n,) of each answer; believed are those that reach the threshold.
        right: (n,) is the answer right?
        possible: number of pairs that have a right answer: what recall is of; at least one.
    """
    s, y = np.asarray(score, float), np.asarray(right, float)
    order = np.argsort(-s, kind="stable")
    last = np.flatnonzero(np.diff(s[order], append=-np.inf) != 0)  # equal scores are believed together
    hits = np.cumsum(y[order])[last]
    return s[order][last], hits / (last + 1), hits / possible
