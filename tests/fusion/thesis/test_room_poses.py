"""Poses of matched rooms: point features against a count by hand, sampling on exact partners, and a map fused by its rooms."""

from __future__ import annotations

import numpy as np
import pytest

import topomerge as tm
from tests.fusion.plans_of import MOVE, off, office, part
from tests.scenes import Scene
from topomerge.errors import InputError
from topomerge.fusion.thesis.fpfh import BINS, fpfh
from topomerge.fusion.thesis.room_poses import room_poses, sampled, upright
from topomerge.types import Sim3


@pytest.fixture(scope="module")
def halves():
    points = office().points()
    west, east = part(points, high=(16, 99)), MOVE.apply(part(points, low=(5, -99)))
    return tuple(tm.extract(p.astype(np.float32), name=n) for p, n in ((west, "a"), (east, "b")))


@pytest.fixture(scope="module")
def partners(halves):
    """Rooms of a and b whose middles coincide under the true pose."""
    a, b = (m.rooms["centroid"] for m in halves)
    there = MOVE.inverse().apply(b)
    apart = np.linalg.norm(a[:, None] - there[None], axis=2)
    rooms = np.argwhere(apart < 0.3)
    assert len(rooms) >= 3
    return rooms


def test_two_points_by_hand():
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    found = fpfh(points, normals, 2.0)
    # Both normals are across the line between them: the three angles are 0, in the middle bin of each.
    expected = np.zeros(3 * BINS)
    expected[[BINS // 2 + BINS * k for k in range(3)]] = 100
    assert np.allclose(found, [expected, expected])


def test_a_right_angle_by_hand():
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    first = fpfh(points, normals, 2.0)[0]
    # From the first point: across = z x x = y, so alpha = y . y = 1; from the second one: y x -x = z, alpha = z . z = 1.
    assert first[BINS - 1] == pytest.approx(100) and first[:BINS].sum() == pytest.approx(100)


def test_features_do_not_change_when_all_is_turned():
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(0, 3, (300, 3)), rng.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turn = Sim3(1.0, (3.0, -2.0, 1.0))
    there = fpfh(turn.apply(points), Sim3(1.0).apply(normals), 0.8)
    same = np.isclose(there, fpfh(points, normals, 0.8), atol=1e-6).all(axis=1)
    assert same.mean() > 0.98  # an angle on the border of two bins may fall on either side


def test_lonely_points_have_no_features():
    assert not fpfh(np.array([[0.0, 0, 0], [9.0, 0, 0]]), np.eye(3)[:2], 1.0).any()
    assert fpfh(np.zeros((0, 3)), np.zeros((0, 3)), 1.0).shape == (0, 3 * BINS)


@pytest.mark.parametrize("yaw", [0.0, 1.0, 3.1, -3.1])
def test_sampling_finds_the_pose_among_wrong_partners(yaw):
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 6, (200, 3))
    truth = Sim3(yaw, (4.0, -7.0, 0.5))
    to = truth.apply(points)
    to[:120] = rng.uniform(-9, 9, (120, 3))  # 60 % are wrong
    found = sampled(to, points)
    assert np.allclose(found.apply(points[120:]), to[120:], atol=1e-6)


def test_upright_is_exact_for_many_at_once():
    rng = np.random.default_rng(2)
    points, truths = rng.uniform(0, 5, (4, 3, 3)), [Sim3(y, (y, 2.0, 1.0)) for y in (-3.0, 0.0, 1.5, 3.0)]
    yaw, shift = upright(np.array([t.apply(p) for t, p in zip(truths, points, strict=True)]), points)
    assert np.allclose(yaw, [t.yaw for t in truths])
    assert np.allclose(shift, [t.translation for t in truths])


def test_no_triple_with_like_edges_is_no_pose():
    points = np.random.default_rng(3).uniform(0, 6, (50, 3))
    assert sampled(points * 3, points) is None


def test_rooms_that_match_agree_about_the_pose(halves, partners):
    found = room_poses(*halves, partners, np.ones(len(partners)))
    metres, degrees = off(found[0][0], MOVE.inverse(), tuple(MOVE.apply(np.array([[10.0, 7.0, 1.0]]))[0]))
    assert metres < 0.1 and degrees < 0.5
    assert [w for _, w in found] == sorted((w for _, w in found), reverse=True)


def test_one_wrong_match_is_outvoted(halves, partners):
    wrong = np.array([[partners[0, 0], partners[1, 1]]])
    found = room_poses(*halves, np.concatenate([wrong, partners]), np.ones(len(partners) + 1))
    assert off(found[0][0], MOVE.inverse(), (0.0, 0.0, 0.0))[1] < 0.5


def test_no_matches_give_no_pose(halves):
    assert room_poses(*halves, np.zeros((0, 2), np.int64), np.zeros(0)) == []


@pytest.fixture(scope="module")
def flats():
    """A flat of three rooms that differ in size, and most of it in another frame."""
    points = Scene().shell(0, 0, 13, 9).wall((5, 0), (5, 9), doors=(2.0,)).wall((5, 5), (13, 5), doors=(4.0,)).points()
    other = MOVE.apply(part(points, high=(11, 99)))
    return tuple(tm.extract(p.astype(np.float32), name=n) for p, n in ((points, "a"), (other, "b")))


def test_merge_by_rooms_alone(flats):
    found = tm.merge(flats, poses="rooms")
    metres, degrees = off(found.registration.transform, MOVE.inverse(), tuple(MOVE.apply(np.array([[6.0, 4.0, 1.0]]))[0]))
    assert metres < 0.1 and degrees < 0.5
    back = tm.merge(flats[::-1], poses="rooms")
    assert np.allclose((found.registration.transform @ back.registration.transform).matrix, np.eye(4), atol=1e-6)


def test_merge_by_rooms_is_for_two_maps_of_one_scale(halves):
    with pytest.raises(InputError, match="two maps of one scale"):
        tm.merge(halves, poses="rooms", scale="free")
    with pytest.raises(InputError, match="two maps of one scale"):
        tm.merge([*halves, halves[0]], poses="rooms")
    with pytest.raises(InputError, match="search or rooms, not 'thesis'"):
        tm.merge(halves, poses="thesis")
