"""Poses as one type: as arrays and back, and which of several are one.

How far two poses are apart, in numbers by hand.
"""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.matching.poses import (
    PoseArrays,
    PoseHypothesis,
    PoseTolerance,
    concatenate_poses,
    find_distinct_poses,
    pose_difference,
    select_distinct_hypotheses,
)
from topomerge.types import Sim3

TOLERANCE = PoseTolerance(0.5, 0.1, 0.05)


def test_arrays_hold_the_poses_and_their_inverses():
    poses = [Sim3(0.4, (1.0, -2.0, 0.5), 1.3), Sim3(-3.0, (4.0, 0.0, 0.0), 0.8)]
    arrays = PoseArrays.from_transforms(poses)
    point = np.array([2.0, 3.0, -1.0])
    for k, pose in enumerate(poses):
        assert np.allclose(arrays.get_transform(k).matrix, pose.matrix)
        assert np.allclose(arrays.inverse().get_transform(k).matrix, pose.inverse().matrix)
        assert np.allclose(arrays.place_point(point)[k], pose.apply(point[None])[0])
    assert len(concatenate_poses(arrays, arrays.take(np.array([1])))) == 3 and len(PoseArrays.from_transforms([])) == 0


def test_poses_are_compared_where_the_map_is():
    """A small turn about a far origin moves a map away; of a map at the origin it is the same pose."""
    poses = PoseArrays.from_transforms([Sim3(), Sim3(0.05), Sim3(2 * np.pi - 0.02)])
    assert find_distinct_poses(poses, np.zeros(3), TOLERANCE).tolist() == [0]
    assert find_distinct_poses(poses, np.array([100.0, 0.0, 0.0]), TOLERANCE).tolist() == [0, 1, 2]


@pytest.mark.parametrize("other", [Sim3(0.2), Sim3(0.0, (0.6, 0.0, 0.0)), Sim3(0.0, (0.0, 0.0, 0.9)), Sim3(scale=1.1)])
def test_the_first_of_each_group_stays(other):
    near = Sim3(0.05, (0.3, 0.3, 0.5), 1.01)
    hypotheses = [PoseHypothesis(pose) for pose in (Sim3(), near, other, near)]
    assert select_distinct_hypotheses(hypotheses, np.zeros(3), TOLERANCE) == [hypotheses[0], hypotheses[2]]
    assert find_distinct_poses(
        PoseArrays.from_transforms([h.transform for h in hypotheses]), np.zeros(3), TOLERANCE, number=1
    ).tolist() == [0]


def test_log_odds_are_bounded():
    assert PoseHypothesis(Sim3(), probability=0.5).log_odds == 0
    assert PoseHypothesis(Sim3(), probability=1.0).log_odds == 7 == -PoseHypothesis(Sim3()).log_odds


def test_metres_at_the_anchor_radians_and_the_logarithm_of_the_scale():
    p, q = Sim3(0.0, (1.0, 2.0, 2.0)), Sim3(np.pi / 2, (1.0, 2.0, 0.0), 2.0)
    assert pose_difference(p, q, np.zeros(3)) == pytest.approx((2.0, np.pi / 2, np.log(2)))
    at = np.array([3.0, 0.0, 1.0])  # p puts it at (4, 2, 3), q at (1, 8, 2)
    assert pose_difference(p, q, at)[0] == pytest.approx(np.sqrt(9 + 36 + 1))
    assert pose_difference(q, p, at) == pytest.approx(pose_difference(p, q, at))


def test_turns_across_half_a_turn_are_small():
    assert pose_difference(Sim3(3.1), Sim3(-3.1), np.zeros(3))[1] == pytest.approx(2 * np.pi - 6.2)
