"""What the columns of two maps say to a pose."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fusion.plans_of import grid_of
from tests.scenes import Scene
from topomerge.matching.poses import PlanFields
from topomerge.registration.judge import Judge, _features, _smooth_blocks
from topomerge.registration.storeys import build_plans
from topomerge.types import Sim3


def test_free_space_speaks_against_a_wall():
    hall, cut = Scene().shell(0, 0, 10, 8), Scene().shell(0, 0, 10, 8).wall((5, 0), (5, 8), doors=(3.0,))
    a, b = ([PlanFields(p) for p in build_plans(grid_of(s.points()))] for s in (hall, cut))
    judged = Judge(a, b)(Sim3())
    assert judged["conflict"] > 0.3 and judged["conflict_share"] > 0.1
    assert Judge(a, a)(Sim3())["conflict"] == 0 and Judge(a, a)(Sim3())["ratio"] > 0.95


def test_features_are_sums_and_shares_of_what_columns_meet():
    """Columns of b, and of a: walls that could meet, that do, back to back, on free floor; free; clutter, ...; all walls."""
    b = [20.0, 12.0, 1.0, 3.0, 0.0, 50.0, 8.0, 6.0, 40.0, 4.0, 30.0]
    a = [10.0, 8.0, 0.0, 0.0, 0.0, 54.0, 2.0, 2.0, 60.0, 6.0, 10.0]
    f = _features(np.array([b, a]), 0.3)
    assert (f["walls"], f["conflict"], f["free"], f["clutter"], f["level"]) == (10.0, 1.5, 52.0, 5.0, 0.3)
    assert f["ratio"] == pytest.approx(20 / 30) and f["opposed"] == pytest.approx(1 / 21) and f["share"] == pytest.approx(0.8)
    assert f["conflict_share"] == pytest.approx(3 / 23) and f["worst_conflict"] == pytest.approx(3 / 15)
    assert (f["met"], f["chance"], f["clutter_lift"]) == pytest.approx((0.8, 0.1, 0.7))
    nothing = _features(np.zeros((2, 11)), 0.0)
    assert all(value == 0 for value in nothing.values())


def test_ceilings_are_smoothed_by_the_median_of_their_block():
    columns = np.array([[0, 0], [1, 3], [11, 11], [12, 0], [0, 12]])
    assert _smooth_blocks(np.array([1.0, 9.0, 2.0, 5.0, 7.0]), columns).tolist() == [2.0, 2.0, 2.0, 5.0, 7.0]


def fields(points, edge: float = 0.1) -> list[PlanFields]:
    return [PlanFields(p) for p in build_plans(grid_of(points, edge=edge))]


@pytest.fixture(scope="module")
def room() -> np.ndarray:
    """6 x 4 m and 2.7 m high."""
    return Scene().shell(0, 0, 6, 4).points()


def test_areas_are_those_of_the_first_map(room):
    """The second one shows the same room in a unit of its own."""
    a, b = fields(room), fields(room * 1.25, 0.125)
    same, other = Judge(a, a)(Sim3()), Judge(a, b)(Sim3(scale=0.8))
    for name in ("walls", "free", "ratio"):
        assert other[name] == pytest.approx(same[name], rel=0.12), name
    assert same["free"] == pytest.approx(24.0, rel=0.05) and other["level"] < 0.06


def test_floors_and_ceilings_that_do_not_meet_are_told(room):
    a, b = fields(room), fields(Scene().shell(0, 0, 6, 4, height=3.2).points())
    judge = Judge(a, b)
    assert judge(Sim3())["level"] == pytest.approx(0.5, abs=0.06)
    assert judge(Sim3(0.0, (0.0, 0.0, 0.1)))["level"] == pytest.approx(0.6, abs=0.06)
    assert Judge(a, a)(Sim3(0.0, (0.0, 0.0, 0.2)))["level"] == pytest.approx(0.2, abs=0.02)


def test_ceilings_are_compared_where_both_maps_saw_free_floor(room):
    """1.4 of 6 m of the ceiling hang 0.3 m lower in one map: the mean deviation from the median is that share of 0.3 m."""
    lower = room.copy()
    lower[(room[:, 2] > 2.6) & (room[:, 0] > 4.6)] -= (0.0, 0.0, 0.3)
    a, b = fields(room), fields(lower)
    judged = Judge(a, b)(Sim3())
    assert judged["ceilings"] == pytest.approx(0.07, abs=0.02) and judged["ceiling_area"] == pytest.approx(24.0, rel=0.1)
    assert Judge(a, a)(Sim3())["ceilings"] < 0.01


def test_a_map_without_floor_is_lifted_to_the_ceiling(room):
    a, b = fields(room), fields(room[room[:, 2] > 1.0])
    assert Judge(a, b).lift_pose(Sim3(0.0, (0.0, 0.0, 0.4))).translation[2] == pytest.approx(0.0, abs=0.06)
    assert Judge(a, a).lift_pose(Sim3(0.0, (0.0, 0.0, 0.1))).translation[2] == 0.1  # floors tell the height
