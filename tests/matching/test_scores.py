"""Ranks, twins and counts of matches, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.matching.assignment import assign_certain, compute_certainty, count_pairs, has_twin, rank_partners


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
