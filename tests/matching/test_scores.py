"""Ranks, twins and counts of matches, by hand.

Costs of pairs of rooms and what they say, in numbers by hand.
"""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.matching.assignment import (
    assign_certain,
    compute_certainty,
    compute_descriptor_costs,
    compute_similarities,
    compute_usual_best_cost,
    count_pairs,
    has_twin,
    rank_partners,
    select_best_partners,
)


def test_the_rank_of_a_partner_counts_half_of_the_ties():
    similarity = np.array([[0.9, 0.5, 0.7], [0.2, 0.2, 0.2], [0.1, 0.8, 0.3]])
    rooms, ranks = rank_partners(similarity, np.array([[2, 0], [0, 0], [1, 2]]))
    assert rooms.tolist() == [0, 1, 2] and ranks.tolist() == [1.0, 2.0, 3.0]


def test_of_several_partners_the_best_one_ranks():
    similarity = np.array([[0.9, 0.5, 0.7, 0.6]])
    assert rank_partners(similarity, np.array([[0, 1], [0, 2]]))[1].tolist() == [2.0]


def test_twins_differ_in_no_size_by_more_than_15_percent():
    sizes = np.array([[20.0, 5.0, 4.0], [22.0, 5.5, 4.0], [20.0, 8.0, 2.5], [24.0, 6.0, 4.0]])
    matches = np.array([[0, 0], [1, 2], [4, 3]])  # room 3 of b is a fifth larger than room 0, and less than a tenth than room 1
    assert has_twin(sizes, matches, np.array([0, 1, 4])).tolist() == [True, False, True]
    assert has_twin(np.delete(sizes, 1, axis=0), np.array([[0, 0]]), np.array([0])).tolist() == [False]
    both = np.array([[0, 0], [0, 1]])  # two pieces of one room are no twins of each other
    assert has_twin(sizes[:3], both, np.array([0])).tolist() == [False]


def test_certainty_is_the_mean_of_both_ways():
    rows, columns = np.array([[0.81, 0.09, 0.1]]), np.array([[0.25, 0.75], [0.04, 0.96]])
    assert compute_certainty(rows, columns) == pytest.approx(np.array([[0.45, 0.06]]))


def test_certain_pairs_have_the_largest_sum_and_no_doubt():
    certain = np.array([[0.9, 0.8], [0.85, 0.1], [0.3, 0.35]])
    assert assign_certain(certain, 0.5).tolist() == [[0, 1], [1, 0]]
    assert assign_certain(certain, 0.83).tolist() == [[0, 0]]


def test_counts_of_pairs():
    """Of four pairs three are right; of two rooms of a and three of b that have a partner two and three got theirs."""
    matches = np.array([[0, 0], [0, 1], [1, 2]])
    assert count_pairs(np.array([[0, 0], [0, 1], [1, 2], [2, 0]]), matches) == (4, 3, 5, 5)
    assert count_pairs(np.array([[0, 1], [1, 0]]), matches) == (2, 1, 5, 2)
    assert count_pairs(np.zeros((0, 2), int), matches) == (0, 0, 5, 0)


def test_costs_are_distances_over_the_root_of_the_length():
    cost = compute_descriptor_costs(np.array([[0.0, 0.0], [3.0, 4.0]]), np.array([[0.0, 0.0], [6.0, 8.0], [3.0, 0.0]]))
    assert cost == pytest.approx(np.array([[0.0, 10.0, 3.0], [5.0, 5.0, 4.0]]) / np.sqrt(2))


def test_standardised_costs_do_not_depend_on_units():
    rng = np.random.default_rng(0)
    a, b, units = rng.standard_normal((4, 3)), rng.standard_normal((5, 3)), np.array([1.0, 1000.0, 0.01])
    assert compute_descriptor_costs(a * units, b * units, standardise=True) == pytest.approx(
        compute_descriptor_costs(a, b, standardise=True)
    )
    assert compute_descriptor_costs(a * units, b * units) != pytest.approx(compute_descriptor_costs(a, b))
    alike = np.ones((2, 1))  # a column that tells nothing costs nothing
    assert (compute_descriptor_costs(alike, alike, standardise=True) == 0).all()


def test_similarities_are_softmaxes_both_ways_with_the_choice_of_none():
    cost, t, none = np.array([[1.0, 2.0], [3.0, 0.5]]), 0.5, 1.5
    e, d = np.exp(-cost / t), np.exp(-none / t)
    expected = [[np.sqrt(e[i, j] / (e[i].sum() + d) * e[i, j] / (e[:, j].sum() + d)) for j in (0, 1)] for i in (0, 1)]
    assert compute_similarities(cost, t, none) == pytest.approx(np.array(expected))
    assert compute_similarities(cost.T, t, none) == pytest.approx(np.array(expected).T)


def test_temperature_and_dustbin_follow_the_costs():
    cost = np.array([[1.0, 4.0, 5.0], [6.0, 2.0, 7.0]])  # median 4.5; cheapest of rooms 1, 2 and 1, 2, 5
    assert compute_usual_best_cost(cost) == 2.0 and compute_usual_best_cost(np.zeros((0, 3))) == 0.0
    assert compute_similarities(cost) == pytest.approx(compute_similarities(cost, 0.9, 3.0))
    assert compute_similarities(10 * cost) == pytest.approx(compute_similarities(cost))
    assert compute_similarities(np.zeros((2, 0))).shape == (2, 0)


def test_partners_are_the_cheapest_of_a_row_or_of_a_column():
    cost = np.array([[1.0, 2.0, 3.0], [4.0, 9.0, 8.0], [7.0, 5.0, 6.0]])
    assert select_best_partners(cost, 1).tolist() == [[0, 0], [0, 1], [0, 2], [1, 0], [2, 1]]
    assert len(select_best_partners(cost, 3)) == 9 and select_best_partners(np.zeros((0, 2)), 3).shape == (0, 2)
