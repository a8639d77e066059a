"""Rooms paired one to one, left alone, or cut in two.

Poses move to where walls meet; those that end in one place are one.
"""

from __future__ import annotations

import numpy as np

from tests.fusion.plans_of import MOVE, grid_of, off, office
from topomerge.matching.assignment import assign, compute_descriptor_costs, match_by_overlap
from topomerge.matching.poses import PlanFields, PoseHypothesis, pair_storeys, refine
from topomerge.registration.storeys import build_plans
from topomerge.types import Sim3


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


def test_near_poses_end_as_one_and_a_wrong_height_is_left_out():
    points = office().points()
    a, b = ([PlanFields(p) for p in build_plans(grid)] for grid in (grid_of(points), grid_of(points, MOVE)))
    true = MOVE.inverse()
    x, y, z = true.translation
    near = [Sim3(true.yaw + turn, (x + step, y, z)) for turn, step in ((0.02, 0.25), (-0.02, -0.25))]
    moved = refine(a, b, [PoseHypothesis(pose, from_rooms=True) for pose in (*near, Sim3(true.yaw, (x, y, z + 5.0)))])
    middle = tuple(MOVE.apply(np.array([[10.0, 7.0, 1.0]]))[0])
    assert len(moved) == 1 and moved[0].from_rooms and 0.5 < moved[0].score <= 1
    assert off(moved[0].transform, true, middle)[0] < 0.1
    assert pair_storeys(a, b, z) and not pair_storeys(a, b, z + 5.0)


def test_a_plan_has_the_direction_of_its_walls() -> None:
    for degrees in (20.0, 67.5):
        (plan,) = build_plans(grid_of(office().points(), Sim3(np.radians(degrees))))
        apart = (np.degrees(PlanFields(plan).main_direction) - degrees + 45) % 90 - 45  # along the walls or across
        assert abs(apart) <= 1.0
