"""Bent maps of an office are straightened; straight ones stay as they are; what can't be bent says why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.fusion.plans_of import MOVE, grid_of, office, part
from topomerge.registration.bend.bend import NEITHER_BENDS, NO_WALLS_NEAR, Bend, bend, bend_together
from topomerge.registration.bend.pieces import Drift
from topomerge.registration.judge import Judge
from topomerge.registration.prepared import prepare
from topomerge.types import Sim3

PHONE, SCANNER = Drift(0.05, 0.01), Drift(0.0, 0.0)


def bowed(points: np.ndarray, radius: float = 240.0) -> np.ndarray:
    """The office bent to an arc, as by a heading that drifts: 0.3 m aside and 2.9 degrees at the ends, none in the middle."""
    out = np.array(points, np.float64)
    angle, away = (out[:, 0] - 12) / radius, radius - (out[:, 1] - 7)
    out[:, 0], out[:, 1] = 12 + away * np.sin(angle), 7 + radius - away * np.cos(angle)
    return out


@pytest.fixture(scope="module")
def points():
    return office().points()


@pytest.fixture(scope="module")
def straight(points):
    return prepare(grid_of(points))


@pytest.fixture(scope="module")
def bent_map(points):
    return prepare(grid_of(bowed(points), MOVE))


@pytest.fixture(scope="module")
def straightened(straight, bent_map):
    return bend(straight, bent_map, MOVE.inverse(), drift=(SCANNER, PHONE))


def misfit(bent: Bend, points: np.ndarray) -> np.ndarray:
    """(n,) m: how far the places of the bowed map lie from where they are in the straight one."""
    there = bent.transform.apply(bent.deformations[1].apply(MOVE.apply(bowed(points))))
    return np.linalg.norm(bent.deformations[0].apply(points)[:, :2] - there[:, :2], axis=1)


def test_a_bent_corridor_is_straightened(points, straightened):
    assert straightened.reason == ""
    rigid = bowed(points)[:, 1] - points[:, 1]
    assert np.ptp(rigid) > 0.25
    assert np.median(misfit(straightened, points)) < 0.02
    assert np.percentile(misfit(straightened, points), 95) < 0.06


def test_what_speaks_against_a_bent_map_is_drift(straight, bent_map, straightened):
    rigid = Judge(straight.storeys, bent_map.storeys)(straightened.transform)
    judged = Judge(straight.storeys, straightened.bend_storeys(bent_map.storeys))(straightened.transform)
    assert judged["walls"] > 1.05 * rigid["walls"] and judged["ratio"] > 0.99 > rigid["ratio"]
    assert judged["conflict_share"] <= rigid["conflict_share"]


def test_a_scanner_does_not_give_way_to_a_phone(points, straightened):
    assert np.array_equal(straightened.deformations[0].apply(points), points)


def test_two_alike_give_way_alike(points, straight, bent_map):
    both = bend(straight, bent_map, MOVE.inverse(), drift=(PHONE, PHONE))
    assert np.median(misfit(both, points)) < 0.02
    moved = [np.linalg.norm(d.moves[:, :2], axis=1).mean() for d in both.deformations]
    assert 0.5 < moved[0] / moved[1] < 2.0


def test_the_other_way_round_is_the_inverse(points, straight, bent_map, straightened):
    back = bend(bent_map, straight, MOVE, drift=(PHONE, SCANNER))
    assert np.allclose((back.transform @ straightened.transform).matrix, np.eye(4), atol=1e-9)
    for one, other in zip(back.deformations, straightened.deformations[::-1], strict=True):
        assert np.allclose(one.moves, other.moves, atol=1e-4)


def test_what_is_not_bent_stays_as_it_is(points, straight):
    same = bend(straight, prepare(grid_of(points, MOVE)), MOVE.inverse(), drift=(PHONE, PHONE))
    there = same.transform.apply(same.deformations[1].apply(MOVE.apply(points)))
    gap = np.linalg.norm(same.deformations[0].apply(points)[:, :2] - there[:, :2], axis=1)
    assert np.median(gap) < 0.005 and gap.max() < 0.03
    assert same.features["bent"] < 0.02 and same.features["strain"] < 0.15


def test_drift_that_no_phone_has_is_not_explained(points, straight, bent_map):
    stiff = bend(straight, bent_map, MOVE.inverse(), drift=(Drift(0.002, 0.0004), Drift(0.002, 0.0004)))
    assert np.percentile(misfit(stiff, points), 90) > 0.1


def test_the_pose_alone_lays_what_both_saw(points):
    """What one of them saw alone follows its bending, but has no say in the pose (once .08 m off)."""
    east = part(points, low=(14, -99))
    a, b = prepare(grid_of(bowed(points, -240.0))), prepare(grid_of(bowed(east), MOVE))
    bent = bend(a, b, MOVE.inverse(), drift=(PHONE, PHONE))
    gap = (bent.transform.apply(MOVE.apply(bowed(east))) - bowed(east, -240.0))[:, :2]
    assert np.ptp(gap[:, 0]) > 0.5
    assert np.linalg.norm(gap.mean(axis=0)) < 0.03


def test_relative_and_back_undo_each_other(points, straight, bent_map):
    both = bend(straight, bent_map, MOVE.inverse(), drift=(PHONE, PHONE))
    places = MOVE.apply(bowed(points))[::50]
    assert np.allclose(both.unbend_points(both.bend_points(places)), places, atol=1e-6)


@pytest.mark.parametrize(
    ("drift", "pose", "reason"),
    [
        ((SCANNER, SCANNER), MOVE.inverse(), NEITHER_BENDS),
        ((PHONE, PHONE), Sim3(0.0, (0.0, 0.0, 40.0)), "no storeys lie on one level"),
    ],
)
def test_what_cannot_be_bent_stays_rigid_and_says_why(points, straight, bent_map, drift, pose, reason):
    bent = bend(straight, bent_map, pose, drift=drift)
    assert bent.reason == reason and bent.transform == pose
    assert all(len(d) == 0 for d in bent.deformations)


def test_one_room_stays_rigid(points):
    room = part(points, (18.1, -1), (19.9, 4))
    a, b = prepare(grid_of(room)), prepare(grid_of(room, MOVE))
    bent = bend(a, b, MOVE.inverse(), drift=(PHONE, PHONE))
    assert bent.reason == "the maps are one piece each"


@pytest.mark.parametrize(("sensor", "up", "reason"), [("", 40.0, NO_WALLS_NEAR), ("drawing", 0.0, NEITHER_BENDS)])
def test_many_maps_that_cannot_be_bent_say_why(straight, bent_map, sensor, up, reason):
    maps = {k: replace(m, sensor=sensor) if sensor else m for k, m in ((0, straight), (1, bent_map))}
    start = {0: Sim3(), 1: Sim3(0.0, (0.0, 0.0, up))}
    assert bend_together(maps, start, [(0, 1)]) == (start, {}, reason)


@pytest.mark.longer
def test_many_maps_bend_together(points, straight, bent_map):
    """What the second map says straightens the third, which the first never saw."""
    west, east = part(points, high=(14, 99)), part(points, low=(10, -99))
    third = prepare(grid_of(bowed(part(east, low=(14, -99)))))
    maps = {0: prepare(grid_of(west)), 1: prepare(grid_of(points)), 2: third}
    poses, bends, reason = bend_together(maps, dict.fromkeys(maps, Sim3()), [(0, 1), (1, 2)])
    assert not reason
    there = poses[2].apply(bends[2].apply(bowed(east)))
    here = poses[1].apply(bends[1].apply(east))
    gap = np.linalg.norm(there[:, :2] - here[:, :2], axis=1)[east[:, 0] > 15]
    assert np.median(gap) < 0.03
    assert poses[0] == Sim3()
