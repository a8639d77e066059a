"""Merge success while training: poses of matched rooms where the truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.training.validate import estimate_pose, is_pose_right
from topomerge.types import Array, Sim3

ROOMS = 8
Side = dict[str, Array]


def maps(pose: Sim3, seed: int = 0) -> tuple[Side, Side]:
    """A map, and the same one in a frame from which `pose` leads back, with its rooms and doors in another order."""
    rng = np.random.default_rng(seed)
    ends = np.array([*((i, (i + 1) % ROOMS) for i in range(ROOMS)), (0, 4)]).T
    middle, door = rng.uniform(0, 30, (ROOMS, 3)), rng.uniform(0, 30, (ends.shape[1], 3))
    middle[:, 2], door[:, 2] = 1.2, 1.0
    rooms, doors = rng.permutation(ROOMS), rng.permutation(ends.shape[1])
    sides: list[Side] = []
    for k in (0, 1):
        e, d, m = (ends, door, middle) if k == 0 else (rooms.argsort()[ends[:, doors]], door[doors], middle[rooms])
        back = Sim3() if k == 0 else pose.inverse()
        index, twice = np.concatenate([e, e[::-1]], axis=1), np.concatenate([d, d])
        sides.append({"pos": back.apply(m), "edge_pos": back.apply(twice), "edge_index": index, "rooms": rooms})
    return sides[0], sides[1]


def truth_of(b: Side) -> Array:
    """(R, R) certainty of the true matches."""
    out = np.zeros((ROOMS, ROOMS))
    out[b["rooms"], np.arange(ROOMS)] = 0.9
    return out


@pytest.mark.parametrize("yaw", [0.0, 1.3, -2.9])
def test_true_matches_give_the_true_pose(yaw):
    pose = Sim3(yaw, (12.0, -5.0, 3.0))
    a, b = maps(pose)
    estimate = estimate_pose(a, b, truth_of(b))
    assert estimate is not None and np.allclose(estimate.matrix, pose.matrix, atol=1e-6)
    at = b["pos"].mean(axis=0)
    assert is_pose_right(estimate, pose.matrix, at)
    far = Sim3(yaw, (12.0, -4.4, 3.0))
    assert not is_pose_right(far, pose.matrix, at) and not is_pose_right(None, pose.matrix, at)
    assert not is_pose_right(Sim3(yaw + 0.1, pose.translation), pose.matrix, np.zeros(3))
    assert is_pose_right(Sim3(yaw + 2 * np.pi, pose.translation), pose.matrix, at)


def test_wrong_matches_are_outvoted_and_partial_rooms_are_off():
    pose = Sim3(0.7, (3.0, 8.0, -2.0))
    a, b = maps(pose, seed=1)
    certain = truth_of(b)
    wrong = np.flatnonzero(b["rooms"] < 3)  # three of eight rooms of b are taken for each other
    certain[:, wrong] = certain[:, np.roll(wrong, 1)]
    rng = np.random.default_rng(2)
    b["pos"] = b["pos"] + rng.normal(0, 0.4, b["pos"].shape) * [1, 1, 0]
    b["edge_pos"] = b["edge_pos"] + np.tile(rng.normal(0, 0.05, (9, 3)), (2, 1))
    estimate = estimate_pose(a, b, certain)
    assert is_pose_right(estimate, pose.matrix, b["pos"].mean(axis=0))


def test_wrong_matches_give_no_true_pose():
    pose = Sim3(0.7, (3.0, 8.0, -2.0))
    for seed in range(10):
        a, b = maps(pose, seed)
        certain = np.roll(truth_of(b), 2, axis=0)  # of a room two doors further, which has no door in common with the right one
        assert not is_pose_right(estimate_pose(a, b, certain), pose.matrix, b["pos"].mean(axis=0))


def test_without_matches_there_is_no_pose():
    a, b = maps(Sim3())
    assert estimate_pose(a, b, np.zeros((ROOMS, ROOMS))) is None
    one = np.zeros((ROOMS, ROOMS))
    one[0, 0] = 0.9
    bare = {"edge_pos": np.zeros((0, 3)), "edge_index": np.zeros((2, 0), int)}
    assert estimate_pose({**a, **bare}, {**b, **bare}, one) is None
    assert estimate_pose({**a, **bare, "pos": a["pos"][:0]}, b, one[:0]) is None
