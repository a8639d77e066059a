"""Poses move to where walls meet; those that end in one place are one."""

from __future__ import annotations

import numpy as np

from tests.fusion.plans_of import MOVE, grid_of, off, office
from topomerge.matching.poses import PlanFields, PoseHypothesis, pair_storeys, refine
from topomerge.registration.storeys import build_plans
from topomerge.types import Sim3


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
    for degrees in (0.0, 20.0, 67.5):
        (plan,) = build_plans(grid_of(office().points(), Sim3(np.radians(degrees))))
        apart = (np.degrees(PlanFields(plan).main_direction) - degrees + 45) % 90 - 45  # along the walls or across
        assert abs(apart) <= 1.0
