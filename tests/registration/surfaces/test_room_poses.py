"""Poses of matched rooms: those that match agree, and a map is merged by its rooms."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import topomerge as tm
from tests.fusion.plans_of import MOVE, off, part
from tests.scenes import Scene
from tests.scenes_map import building
from topomerge.errors import InputError
from topomerge.registration.surfaces import estimate_room_poses

pytest.importorskip("open3d", exc_type=ImportError)


@pytest.fixture(scope="module")
def flats():
    """A flat of three rooms that differ in size, and most of it in another frame. An empty rectangle looks the same upside down:
    each room has a cupboard in a corner."""
    scene = Scene().shell(0, 0, 13, 9).wall((5, 0), (5, 9), doors=(2.0,)).wall((5, 5), (13, 5), doors=(4.0,))
    for x, y in ((0.1, 7.0), (5.2, 0.1), (5.2, 8.2)):
        scene.box(x, y, 0, x + 1.6, y + 0.7, 2)
    points = scene.points()
    other = MOVE.apply(part(points, high=(11, 99)))
    return tuple(tm.extract(p.astype(np.float32), name=n) for p, n in ((points, "a"), (other, "b")))


@pytest.fixture(scope="module")
def partners(flats):
    """Rooms of a and b whose middles lie near each other under the true pose."""
    a, b = (m.rooms["centroid"] for m in flats)
    there = MOVE.inverse().apply(b)
    apart = np.linalg.norm(a[:, None] - there[None], axis=2)
    rooms = np.argwhere(apart < 1.5)
    assert len(rooms) >= 3
    return rooms


@pytest.fixture(scope="module")
def clusters(flats, partners):
    """Poses of the matched rooms."""
    return estimate_room_poses(*flats, partners, np.ones(len(partners)))


@pytest.mark.longer
def test_rooms_that_match_agree_about_the_pose(clusters):
    metres, degrees = off(clusters[0][0], MOVE.inverse(), tuple(MOVE.apply(np.array([[6.0, 4.0, 1.0]]))[0]))
    assert metres < 0.1 and degrees < 0.5
    assert [w for _, w in clusters] == sorted((w for _, w in clusters), reverse=True)


@pytest.mark.longer
def test_one_wrong_match_is_outvoted(flats, partners):
    wrong = np.array([[partners[0, 0], partners[1, 1]]])
    clusters = estimate_room_poses(*flats, np.concatenate([wrong, partners]), np.ones(len(partners) + 1))
    assert off(clusters[0][0], MOVE.inverse(), (0.0, 0.0, 0.0))[1] < 0.5


def test_no_matches_give_no_pose():
    maps = building(1), building(2)
    assert estimate_room_poses(*maps, np.zeros((0, 2), np.int64), np.zeros(0)) == []


@pytest.mark.longer
@pytest.mark.parametrize("poses", ["rooms", "surfaces"])
def test_merge_by_rooms_alone(flats, poses):
    result = tm.merge(flats, poses=poses)
    metres, degrees = off(result.registration.transform, MOVE.inverse(), tuple(MOVE.apply(np.array([[6.0, 4.0, 1.0]]))[0]))
    assert metres < 0.1 and degrees < 0.5
    back = tm.merge(flats[::-1], poses=poses)
    assert np.allclose((result.registration.transform @ back.registration.transform).matrix, np.eye(4), atol=1e-6)


def test_merge_by_rooms_is_for_two_maps_and_by_surfaces_for_one_scale():
    maps = [building(1), building(2), building(3)]
    for poses in ("rooms", "surfaces"):
        with pytest.raises(InputError, match="poses of rooms alone are for two maps"):
            tm.merge(maps, poses=poses)
    with pytest.raises(InputError, match="poses of surfaces are for two maps of one scale"):
        tm.merge(maps[:2], poses="surfaces", scale="free")
    with pytest.raises(InputError, match="search, rooms or surfaces, not 'thesis'"):
        tm.merge(maps[:2], poses="thesis")


@pytest.mark.longer
def test_the_same_maps_give_the_same_poses(flats, partners, clusters):
    assert estimate_room_poses(*flats, partners, np.ones(len(partners))) == clusters


@pytest.mark.longer
def test_without_open3d_the_message_says_what_to_install(flats, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(InputError, match=r"need Open3D: pip install topomerge\[open3d\]"):
        tm.merge(flats, poses="surfaces")
    assert tm.merge(flats, poses="rooms").registration.transform is not None
