"""Rotations are averaged as rotations, and poses that agree are one cluster."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from topomerge.matching.poses import pose_difference
from topomerge.registration.surfaces import cluster_poses, compute_mean_pose, compute_mean_yaw
from topomerge.types import Sim3


def test_yaws_across_half_a_turn():
    assert abs(compute_mean_yaw(np.radians([179, -179]))) == pytest.approx(np.pi)
    assert compute_mean_yaw(np.radians([170, -170, -170])) == pytest.approx(np.radians(-176.7), abs=0.01)
    assert compute_mean_yaw(np.radians([10, 20]), [1, 3]) == pytest.approx(np.radians(17.5), abs=1e-3)


def test_yaws_that_cancel_have_no_mean():
    with pytest.raises(ValueError, match="cancel"):
        compute_mean_yaw([0.0, np.pi])
    with pytest.raises(ValueError, match="no yaw"):
        compute_mean_yaw([])


@given(st.floats(-3.14, 3.14), st.floats(-50, 50), st.floats(0.5, 2.0))
def test_the_mean_of_one_pose_is_that_pose(yaw, x, scale):
    pose = Sim3(yaw, (x, -x, 1.0), scale)
    mean = compute_mean_pose([pose, pose], [1, 2], np.array([3.0, 4.0, 5.0]))
    assert np.allclose(mean.matrix, pose.matrix, atol=1e-9)


def test_translations_are_averaged_where_the_map_lies():
    anchor = np.array([100.0, 0.0, 0.0])  # far from the origin: 2 degrees move it by 3.5 m
    poses = [Sim3(np.radians(y)) for y in (-1.0, 1.0)]
    poses = [Sim3(p.yaw, tuple((anchor - p.apply(anchor[None])[0]).tolist())) for p in poses]  # both leave it in place
    assert np.allclose(compute_mean_pose(poses, anchor=anchor).apply(anchor[None]), anchor)


def test_clusters_begin_with_the_cluster_with_most_weight():
    rng = np.random.default_rng(0)
    true = Sim3(np.pi - 0.01, (3.0, 4.0, 0.0))
    near = [Sim3(true.yaw + d, (3 + d, 4 - d, 0.0)) for d in rng.normal(0, 0.02, 8)]
    wrong = [Sim3(float(y), (float(x), 0.0, 0.0)) for y, x in rng.uniform(-3, 3, (12, 2))]
    clusters = cluster_poses([*wrong, *near], [1.0] * 20)
    mean, weight, members = clusters[0]
    moved, turned, _ = pose_difference(mean, true, np.zeros(3))
    assert weight >= 8 and set(range(12, 20)) <= set(members) and moved < 0.05 and turned < 0.02
    assert sorted(i for _, _, m in clusters for i in m) == list(range(20))


def test_means_are_weighted():
    """A pose of weight 3 counts as three of weight 1, in its turn, its place and its scale."""
    light, heavy = Sim3(0.1, (0.0, 8.0, 1.0), 1.0), Sim3(0.3, (4.0, 0.0, 2.0), 1.1)
    mean = compute_mean_pose([light, heavy], [1, 3])
    assert np.allclose(mean.matrix, compute_mean_pose([light, heavy, heavy, heavy]).matrix)
    assert mean.translation == pytest.approx((3.0, 2.0, 1.75)) and mean.yaw == pytest.approx(0.25, abs=1e-3)
    assert np.log(mean.scale) == pytest.approx(0.75 * np.log(1.1))


def test_one_heavy_pose_outweighs_several_light_ones():
    """Of three rooms that agree and one large room that says otherwise, the area decides, and the mean leans to what is large."""
    light, heavy = [Sim3(0.0, (0.1 * k, 0.0, 0.0)) for k in range(3)], [Sim3(1.0, (9.0, 0.0, 0.0)), Sim3(1.0, (9.4, 0.0, 0.0))]
    (first, weight, members), (second, rest, others) = cluster_poses([*light, *heavy], [5.0, 5.0, 5.0, 30.0, 10.0])
    assert (weight, members, rest, others) == (40.0, [3, 4], 15.0, [0, 1, 2])
    assert first.translation[0] == pytest.approx(9.1) and second.translation[0] == pytest.approx(0.1)


def test_members_are_those_near_the_mean_not_near_the_seed():
    """The seed lies at 0.3 m; the mean of what is near it at 0.6 m has others around it, and one of the first no more."""
    poses = [Sim3(0.0, (x, 0.0, 0.0)) for x in (0.0, 0.3, 0.75, 0.8, 1.25)]
    mean, weight, members = cluster_poses(poses, [1.0, 2.0, 4.0, 4.0, 0.5])[0]
    assert members == [1, 2, 3] and weight == 10.0 and mean.translation[0] == pytest.approx(6.8 / 10)


@pytest.mark.parametrize("other", [Sim3(0.0, (0.6, 0.0, 0.0)), Sim3(np.radians(6.0)), Sim3(scale=1.06)])
def test_poses_that_differ_in_one_thing_are_two_clusters(other):
    assert len(cluster_poses([Sim3(), other], [1.0, 1.0])) == 2
    assert len(cluster_poses([Sim3(), Sim3(np.radians(4.0), (0.4, 0.0, 0.0), 1.04)], [1.0, 1.0])) == 1


def test_clusters_are_compared_where_the_map_lies():
    """Turns of 2 degrees about the middle of a map 100 m away from the origin are one pose, though their translations differ."""
    anchor = np.array([100.0, 0.0, 0.0])
    turned = [Sim3(np.radians(y)) for y in (-1.0, 1.0)]
    turned = [Sim3(p.yaw, tuple((anchor - p.apply(anchor[None])[0]).tolist())) for p in turned]  # type: ignore[arg-type]
    assert len(cluster_poses(turned, [1.0, 1.0], anchor)) == 1 and len(cluster_poses(turned, [1.0, 1.0])) == 2
