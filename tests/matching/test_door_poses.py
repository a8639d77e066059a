"""Poses that doors propose: one door on the other, rooms on the same side, floors on floors, at the scale that doors tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.matching.turned_maps import turned, uneven
from topomerge.matching.consistency import (
    collect_doors,
    propose_door_poses,
    propose_middle_poses,
    propose_scaled_poses,
    snap_yaws,
)
from topomerge.matching.poses import PoseArrays
from topomerge.matching.room_plans import build_room_plans
from topomerge.types import Array, Sim3, TopometricMap

SHIFT = (7.0, -3.0, 1.5)


@pytest.fixture(scope="module")
def a() -> TopometricMap:
    return uneven()


@pytest.fixture(scope="module")
def moved(a) -> tuple[TopometricMap, Sim3]:
    return turned(a, SHIFT)


@pytest.fixture(scope="module")
def larger(a) -> tuple[TopometricMap, Sim3]:
    """In units of its own."""
    return turned(a, SHIFT, 1.3)


def is_true(poses: PoseArrays, truth: Sim3, b: TopometricMap, metres: float = 0.15) -> Array:
    """(H,) bool: does a pose bring every room of b to its place, its height and its size?"""
    places = b.rooms["centroid"].astype(float)
    gaps = [np.linalg.norm(poses.get_transform(k).apply(places) - truth.apply(places), axis=1).max() for k in range(len(poses))]
    return np.array(gaps) < metres


def test_doors_are_seen_from_both_of_their_rooms(a):
    doors = collect_doors(a, build_room_plans(a))
    assert sorted(zip(doors.room.tolist(), doors.width.tolist(), strict=True)) == sorted(
        (int(room), float(edge["width"])) for edge in a.edges for room in edge["rooms"]
    )
    into = np.stack([np.cos(doors.into), np.sin(doors.into)], axis=1)
    towards = a.rooms["centroid"][doors.room, :2] - doors.centre[:, :2]
    assert (np.einsum("nd,nd->n", into, towards) > 0).all()


def test_the_floor_tells_on_which_side_of_a_door_a_room_is(a):
    """The corridor's middle is put beyond the doors; its floor is where it was."""
    rooms = a.rooms.copy()
    rooms["centroid"][:, 1] = a.rooms["centroid"][::-1, 1]
    plan = build_room_plans(a)
    assert collect_doors(replace(a, rooms=rooms), plan).into == pytest.approx(collect_doors(a, plan).into)


def test_stairs_are_no_doors(a):
    edges = a.edges.copy()
    edges["kind"][0] = "stairs"
    assert len(collect_doors(replace(a, edges=edges), build_room_plans(a)).room) == 2 * (len(edges) - 1)


def test_the_same_door_of_the_same_room_gives_the_true_pose(a, moved):
    b, truth = moved
    plans = (build_room_plans(a), build_room_plans(b))
    poses = propose_door_poses(a, b, plans, np.array([[0, 0]]), np.array([0.7]))
    assert len(poses) == 1 and is_true(poses, truth, b).all() and poses.weight.tolist() == [0.7]
    wrong = propose_door_poses(a, b, plans, np.array([[0, 1]]), np.array([0.7]))
    assert len(wrong) == 1 and not is_true(wrong, truth, b).any()


def test_doors_of_other_widths_are_not_put_on_each_other(a, moved):
    b, _ = moved
    plans = (build_room_plans(a), build_room_plans(b))
    for wider, count in ((0.6, 1), (0.8, 0)):
        edges = b.edges.copy()
        edges["width"] += wider
        assert len(propose_door_poses(a, replace(b, edges=edges), plans, np.array([[0, 0]]), np.ones(1))) == count
    open_edges = b.edges.copy()
    open_edges["width"], open_edges["kind"] = 4.0, "opening"  # how wide an opening is depends on what was seen of it
    assert len(propose_door_poses(a, replace(b, edges=open_edges), plans, np.array([[0, 0]]), np.ones(1))) == 1


def test_one_of_the_poses_of_middles_is_true(a, moved):
    b, truth = moved
    poses = propose_middle_poses(
        a, b, (build_room_plans(a), build_room_plans(b)), np.array([[1, 1], [2, 2]]), np.array([0.7, 0.4])
    )
    assert is_true(poses, truth, b).reshape(2, 4).sum(axis=1).tolist() == [1, 1]
    assert poses.weight.tolist() == [0.7] * 4 + [0.4] * 4
    quarters = np.sort(poses.yaw[:4] % (2 * np.pi))
    assert np.diff(quarters) == pytest.approx([np.pi / 2] * 3)


def test_two_doors_of_one_room_tell_the_scale(a, larger):
    b, truth = larger
    edges = b.edges.copy()
    flat = b.rooms.copy()
    flat["height"] = 0.0  # else the heights of rooms tell it, too
    b = replace(b, rooms=flat, edges=edges)
    hall = len(a.rooms) - 1
    poses = propose_scaled_poses(a, b, (build_room_plans(a), build_room_plans(b)), np.array([[hall, hall]]), np.array([0.3]))
    right = is_true(poses, truth, b)
    assert right.sum() >= 2 and poses.scale[right] == pytest.approx(1 / 1.3, rel=0.02) and (poses.weight == 0.3).all()
    assert ((poses.scale > 0.4) & (poses.scale < 2.5)).all()


def test_the_height_of_a_room_tells_the_scale(a, larger):
    b, truth = larger
    poses = propose_scaled_poses(a, b, (build_room_plans(a), build_room_plans(b)), np.array([[0, 0]]), np.array([0.3]))
    assert len(poses) == 1 and is_true(poses, truth, b).all() and poses.scale[0] == pytest.approx(1 / 1.3, rel=1e-3)
    tall = b.rooms.copy()
    tall["height"] *= 3.0
    assert not len(
        propose_scaled_poses(
            a, replace(b, rooms=tall), (build_room_plans(a), build_room_plans(b)), np.array([[0, 0]]), np.ones(1)
        )
    )


def test_yaws_snap_to_parallel_walls_only_if_they_are_near(a, moved):
    plans = (build_room_plans(a), build_room_plans(moved[0]))
    near, far = np.radians([3.0, 87.0, -179.0]), np.radians([20.0, 70.0])
    assert np.degrees(snap_yaws(near, plans)) == pytest.approx([0.0, 90.0, -180.0], abs=0.5)
    assert snap_yaws(far, plans) == pytest.approx(far)
