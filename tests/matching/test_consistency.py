"""Poses are ranked by what lies on what: votes, storeys, metres of walls and m2 of floor, by hand and on maps made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tests.matching.turned_maps import turned, uneven
from tests.scenes_map import building
from topomerge.matching.consistency import (
    CONSISTENCY,
    _score_poses,
    count_votes,
    find_matches,
    map_storeys,
    rank,
    select_best_poses,
)
from topomerge.matching.poses import PoseArrays
from topomerge.matching.room_plans import RoomPlans, build_room_plans
from topomerge.types import Sim3

SHIFT = (7.0, -3.0, 1.5)


@pytest.fixture(scope="module")
def plan() -> RoomPlans:
    return build_room_plans(uneven())


def test_poses_that_are_near_vote_for_each_other():
    near, far = Sim3(0.0, (0.9, 0.0, 0.0)), Sim3(0.0, (9.0, 0.0, 0.0))
    poses = PoseArrays.from_transforms([Sim3(), Sim3(np.radians(8.0)), near, far, Sim3(scale=1.1)])
    poses.weight[:] = (1.0, 2.0, 4.0, 8.0, 16.0)
    assert np.expm1(count_votes(poses)) == pytest.approx([7.0, 3.0, 5.0, 8.0, 16.0])
    assert np.expm1(count_votes(PoseArrays.from_transforms([Sim3(), Sim3(np.radians(11.0))]))) == pytest.approx([1.0, 1.0])
    assert np.expm1(count_votes(PoseArrays.from_transforms([Sim3(3.13), Sim3(-3.13)]))) == pytest.approx([2.0, 2.0])


def test_poses_of_the_highest_score_come_first_and_once():
    poses = PoseArrays.from_transforms([Sim3(0.0, (x, 0.0, 0.0)) for x in (0.0, 5.0, 0.2, 9.0)])
    best = select_best_poses(poses, np.array([3.0, 1.0, 4.0, 2.0]), np.zeros(3), 2)
    assert best.shift[:, 0].tolist() == [0.2, 9.0]


def test_storeys_are_those_whose_floors_meet():
    lower, lifted, halved = Sim3(), Sim3(0.0, (0.0, 0.0, 3.4)), Sim3(0.0, (0.0, 0.0, 0.0), 0.5)
    storeys = map_storeys(PoseArrays.from_transforms([lower, lifted, halved]), np.array([0.0, 3.0]), np.array([0.0, 3.2, 6.1]))
    assert storeys.tolist() == [[0, 1, -1], [1, -1, -1], [0, -1, 1]]


def test_a_map_on_itself_agrees_in_all_walls_and_all_floor(plan):
    evidence = _score_poses(PoseArrays.from_transforms([Sim3()]), (plan, plan), 1)[0]
    assert evidence[3] == pytest.approx((plan.label >= 0).sum() * 0.01, rel=0.01)
    assert evidence[1] == pytest.approx(plan.walls.sum() * 0.1 / 2, rel=0.01) and evidence[2] == 0.0
    assert evidence[0] == pytest.approx(evidence[1] + 0.1 * evidence[3])


def test_walls_on_seen_floor_conflict(plan):
    """Moved by a room's half, walls stand in rooms; beyond the other map nothing meets anything."""
    aside, away = _score_poses(
        PoseArrays.from_transforms([Sim3(0.0, (2.0, 1.0, 0.0)), Sim3(0.0, (99.0, 0.0, 0.0))]), (plan, plan), 1
    )
    assert aside[2] > 5.0 and aside[0] == pytest.approx(aside[1] - 2 * aside[2] + 0.1 * aside[3])
    assert away[1:].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("scale", [1.0, 1.3])
def test_both_ways_give_one_score(scale):
    a, (b, truth) = uneven(), turned(uneven(), SHIFT, scale)
    plans = (build_room_plans(a), build_room_plans(b))
    there = PoseArrays.from_transforms([truth, truth @ Sim3(0.1, (1.0, 0.5, 0.0))])
    forth, back = _score_poses(there, plans, 1), _score_poses(there.inverse(), plans[::-1], 1)
    assert forth == pytest.approx(back)
    assert forth[0, 0] > 20 > forth[1, 0]


def test_hypotheses_that_explain_little_rank_last_however_clean(plan):
    poses = PoseArrays.from_transforms([Sim3(0.0, (x, 0.0, 0.0)) for x in (0.0, 1.0, 2.0)])
    agree, conflict, floor = np.array([10.0, 100.0, 80.0]), np.array([0.0, 60.0, 55.0]), np.array([50.0, 100.0, 10.0])
    evidence = np.column_stack([agree - 2 * conflict + 0.1 * floor, agree, conflict, floor])
    ranked = rank(poses, evidence, (plan, plan))
    assert [h.transform.translation[0] for h in ranked] == [1.0, 2.0, 0.0]
    assert dict(ranked[0].features) == {"agree_m": 100.0, "conflict_m": 60.0, "floor_m2": 100.0}
    assert ranked[0].score == pytest.approx(-10.0) and sum(h.probability for h in ranked) < 1
    assert CONSISTENCY.shortlist * 110 < 81 and CONSISTENCY.shortlist * 110 > 15


@pytest.mark.parametrize("scale", [1.0, 1.3])
def test_rooms_meet_under_the_true_transform_only(scale):
    a, (b, truth) = uneven(), turned(uneven(), SHIFT, scale)
    plans = (build_room_plans(a), build_room_plans(b))
    rooms, fit = find_matches(truth, plans)
    assert rooms.tolist() == [[k, k] for k in range(4)] and (fit > 0.9).all()
    assert not len(find_matches(truth.inverse(), plans)[0])
    back, again = find_matches(truth.inverse(), plans[::-1])
    assert back.tolist() == rooms.tolist() and again == pytest.approx(fit, abs=0.05)


def test_rooms_of_other_storeys_do_not_meet():
    """Two storeys of one plan: under a lift by one storey the lower rooms of b lie in the upper rooms of a."""
    plans = build_room_plans(building(1, storeys=2))
    rooms, _ = find_matches(Sim3(0.0, (0.0, 0.0, 3.0)), (plans, plans))
    assert rooms.tolist() == [[3, 0], [4, 1], [5, 2]]
