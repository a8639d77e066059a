"""Rooms paired one to one, left alone, or cut in two."""

from __future__ import annotations

import numpy as np

from topomerge.matching.assignment import assign, by_overlap
from topomerge.matching.costs import descriptor_costs


def test_costs_and_dustbin():
    cost = descriptor_costs(np.array([[0.0], [5.0], [9.0]]), np.array([[0.1], [5.2]]))
    assert assign(cost, 1.0).tolist() == [[0, 0], [1, 1]]
    assert assign(cost, 0.15).tolist() == [[0, 0]]
    assert len(assign(np.zeros((0, 3)))) == 0


def test_rooms_without_a_partner_change_nothing():
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((6, 4)), rng.standard_normal((5, 4))
    plain = assign(descriptor_costs(a, b), 1.2)
    more = assign(descriptor_costs(np.concatenate([a, a[:2] + 50]), np.concatenate([b, b[:3] - 50])), 1.2)
    assert np.array_equal(plain, more)


def test_a_room_cut_in_two_has_two_partners():
    common = np.array([[6.0, 4.0], [0.0, 0.0]])
    pairs, fit = by_overlap(common, np.array([10.0, 5.0]), np.array([6.0, 4.0]))
    assert pairs.tolist() == [[0, 0], [0, 1]] and np.allclose(fit, [0.6, 1.0])
