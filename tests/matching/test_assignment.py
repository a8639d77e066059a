"""Rooms paired one to one, left alone, or cut in two."""

from __future__ import annotations

import numpy as np

from topomerge.matching.assignment import assign, compute_descriptor_costs, match_by_overlap


def test_costs_and_dustbin():
    cost = compute_descriptor_costs(np.array([[0.0], [5.0], [9.0]]), np.array([[0.1], [5.2]]))
    assert assign(cost, 1.0).tolist() == [[0, 0], [1, 1]]
    assert assign(cost, 0.15).tolist() == [[0, 0]]
    assert len(assign(np.zeros((0, 3)))) == 0


def test_rooms_without_a_partner_change_nothing():
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((6, 4)), rng.standard_normal((5, 4))
    plain = assign(compute_descriptor_costs(a, b), 1.2)
    more = assign(compute_descriptor_costs(np.concatenate([a, a[:2] + 50]), np.concatenate([b, b[:3] - 50])), 1.2)
    assert np.array_equal(plain, more)


def test_a_room_cut_in_two_has_two_partners():
    common = np.array([[6.0, 4.0], [0.0, 0.0]])
    pairs, fit = match_by_overlap(common, np.array([10.0, 5.0]), np.array([6.0, 4.0]))
    assert pairs.tolist() == [[0, 0], [0, 1]] and np.allclose(fit, [0.6, 1.0])


def test_staying_alone_costs_half_the_largest_cost_each():
    """One good pair and two rooms alone (0.2 + 0.5 + 0.5) are cheaper than two fair pairs (0.75 + 0.75)."""
    assert assign(np.array([[0.2, 0.75], [0.75, 9.0]]), 1.0).tolist() == [[0, 0]]
    assert assign(np.array([[0.45, 0.75], [0.75, 9.0]]), 1.2).tolist() == [[0, 1], [1, 0]]
    assert assign(np.array([[0.95]]), 1.0).tolist() == [[0, 0]] and not len(assign(np.array([[1.05]]), 1.0))


def test_pieces_are_joined_either_way_round():
    """Room 1 of a lies in room 0 of b to three quarters, room 2 to a third only."""
    common, areas = np.array([[9.0, 0.0], [3.0, 0.0], [2.0, 0.0]]), (np.array([12.0, 4.0, 6.0]), np.array([20.0, 7.0]))
    pairs, fit = match_by_overlap(common, *areas)
    assert pairs.tolist() == [[0, 0], [1, 0]] and np.allclose(fit, [9 / 23, 0.75])
    turned, again = match_by_overlap(common.T, *areas[::-1])
    assert turned.tolist() == [[0, 0], [0, 1]] and np.allclose(again, fit)


def test_rooms_that_share_a_corner_are_two():
    assert not len(match_by_overlap(np.array([[2.0]]), np.array([10.0]), np.array([10.0]))[0])  # 2 of 18 m2
    assert len(match_by_overlap(np.array([[3.0]]), np.array([10.0]), np.array([10.0]))[0]) == 1  # 3 of 17 m2
