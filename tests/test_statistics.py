"""Statistics against values worked out by hand, published tables, and simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from topomerge.statistics import (
    bootstrap_mean,
    compute_exact_interval,
    compute_precision_recall,
    format_interval,
    measure_calibration,
)


@pytest.mark.parametrize(
    ("hits", "n", "low", "high"),
    [
        (0, 10, 0.0, 1 - 0.025**0.1),
        (10, 10, 0.025**0.1, 1.0),
        (1, 20, 0.0012651, 0.2487328),
        (0, 0, 0.0, 1.0),
        (5, 5, 0.4781762, 1.0),
    ],
)  # the ends of 0 and n hits in closed form; 1 of 20 as in Clopper and Pearson's tables
def test_exact_intervals(hits, n, low, high) -> None:
    assert compute_exact_interval(hits, n) == pytest.approx((low, high), abs=1e-6)


@pytest.mark.parametrize(("hits", "n"), [(3, 17), (8, 9), (40, 90)])
def test_an_exact_interval_leaves_a_fortieth_on_either_side(hits, n) -> None:
    low, high = compute_exact_interval(hits, n)
    assert binom.sf(hits - 1, n, low) == pytest.approx(0.025)
    assert binom.cdf(hits, n, high) == pytest.approx(0.025)


@pytest.mark.parametrize("hits", [-1, 4])
def test_more_hits_than_trials_are_refused(hits) -> None:
    with pytest.raises(ValueError, match="of 3"):
        compute_exact_interval(hits, 3)


def test_intervals_over_buildings() -> None:
    mean, low, high = bootstrap_mean([0.2, 0.4, 0.9, np.nan], ["a", "a", "b", "c"])
    assert mean == pytest.approx(0.5)
    assert low == pytest.approx(0.3) and high == pytest.approx(0.9)
    assert bootstrap_mean([0.5, 0.7], ["a", "a"]) == pytest.approx((0.6, 0.6, 0.6))
    assert np.isnan(bootstrap_mean([np.nan], ["a"])).all()


def test_few_buildings_show_their_range() -> None:
    values, groups = [0.2, 0.4, 0.9, 0.5, np.nan], ["a", "a", "b", "c", "d"]
    assert format_interval(values, groups) == "0.50, 0.30–0.90 (3 buildings)"
    assert format_interval(values, groups, 0, 100) == "50, 30–90 (3 buildings)"
    assert format_interval([0.25, 0.75], ["a", "a"]) == "0.50 (1 building)"
    assert format_interval([], []) == format_interval([np.nan], ["a"]) == "–"


def test_eight_buildings_are_drawn_again_and_again() -> None:
    seven, eight = [0.0, 1.0] * 3 + [1.0], [0.0, 1.0] * 4
    assert "(7 buildings)" in format_interval(seven, range(7))
    mean, low, high = bootstrap_mean(eight, range(8))
    assert format_interval(eight, range(8)) == f"{mean:.2f} [{low:.2f}, {high:.2f}]" and low < 0.5 < high


def test_a_share_of_all_or_nothing_is_not_certain() -> None:
    assert format_interval(np.ones(20), np.arange(20) // 2) == "1.00 [0.69, 1.00]"  # ten buildings: 0.025 ** 0.1
    assert format_interval(np.zeros(10), range(10), 0, 100) == "0 [0, 31]"


def test_calibration_by_hand() -> None:
    result = measure_calibration([0.0, 0.05, 0.2, 0.4, 0.8, 0.9], [False, False, True, False, True, True], bins=3)
    assert result.count.tolist() == [2, 2, 2]
    assert result.probability == pytest.approx([0.025, 0.3, 0.85])
    assert result.right.tolist() == [0.0, 0.5, 1.0]
    assert result.error == pytest.approx((0.025 + 0.2 + 0.15) / 3)
    assert result.above is not None and result.above.count.sum() == 4 and result.above.above is None
    assert measure_calibration([0.2, 0.9], [True, True], bins=1).error == pytest.approx(0.45)


def test_mass_near_zero_hides_what_is_wrong_above_it() -> None:
    p, y = np.r_[np.zeros(960), np.full(40, 0.8)], np.r_[np.zeros(960, bool), np.ones(40, bool)]
    result = measure_calibration(p, y)
    assert result.error == pytest.approx(0.04 * 0.2)
    assert result.above is not None and result.above.error == pytest.approx(0.2)


def test_equal_probabilities_are_in_one_bin_in_any_order() -> None:
    p = np.repeat([0.3, 0.6], [7, 5])
    y = np.arange(12) % 2 == 0
    order = np.random.default_rng(0).permutation(12)
    one, other = measure_calibration(p, y, 5), measure_calibration(p[order], y[order], 5)
    assert one.count.tolist() == other.count.tolist() == [7, 5]
    assert one.error == pytest.approx(other.error)


def test_the_error_by_chance_is_that_of_true_probabilities() -> None:
    rng = np.random.default_rng(1)
    p = rng.random(60)
    errors = [measure_calibration(p, rng.random(60) < p).error for _ in range(200)]
    assert measure_calibration(p, p > 0.5).by_chance == pytest.approx(np.mean(errors), rel=0.1)
    assert measure_calibration([0.0, 1.0], [False, True]).by_chance == 0


def test_nothing_is_neither_right_nor_wrong() -> None:
    empty = measure_calibration([], [])
    assert np.isnan(empty.error) and len(empty.count) == 0 and empty.above is None
    assert measure_calibration([0.05], [False]).above is None


def test_precision_and_recall_of_every_threshold() -> None:
    score, right = [0.5, 0.9, 0.7, 0.7, 0.1], [False, True, True, False, True]
    thresholds, precision, recall = compute_precision_recall(score, right, possible=4)
    assert thresholds.tolist() == [0.9, 0.7, 0.5, 0.1]
    assert precision == pytest.approx([1, 2 / 3, 2 / 4, 3 / 5])
    assert recall == pytest.approx([1 / 4, 2 / 4, 2 / 4, 3 / 4])
    order = [3, 0, 4, 2, 1]
    again = compute_precision_recall(np.array(score)[order], np.array(right)[order], 4)
    assert all((x == y).all() for x, y in zip(again, (thresholds, precision, recall), strict=True))
    assert [len(x) for x in compute_precision_recall([], [], 3)] == [0, 0, 0]
