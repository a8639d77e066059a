"""Point features do not change when all is turned, and sample consensus gives the pose of a room under gravity."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes import Scene
from topomerge.extraction.extract import extract
from topomerge.registration.surfaces import Features, compute_fpfh, convert_to_upright, described, estimate_pose
from topomerge.types import Sim3

pytest.importorskip("open3d", exc_type=ImportError)


def oriented(count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Random points and normals."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(count, 3))
    return rng.uniform(0, 3, (count, 3)), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def room(frame: Sim3 | None = None) -> Features:
    """A room with a corner cut out, and what stands in it."""
    scene = (
        Scene()
        .shell(0, 0, 7, 5)
        .wall((5, 0), (5, 2))
        .wall((5, 2), (7, 2))
        .box(1, 1, 0, 2.4, 1.8, 0.75)
        .box(0.2, 3, 0, 0.8, 4.6, 1.9)
    )
    map = extract((frame or Sim3()).apply(scene.points()).astype(np.float32), name="room")
    features = described(map, int(map.rooms["area"].argmax()))
    assert features is not None
    return features[1]


def test_features_do_not_change_when_all_is_turned():
    points, normals = oriented()
    there = compute_fpfh(Sim3(1.0, (3.0, -2.0, 1.0)).apply(points), Sim3(1.0).apply(normals)).histograms.data
    same = np.isclose(there, compute_fpfh(points, normals).histograms.data, atol=1e-6).all(axis=0)
    assert there.shape == (33, 300) and same.mean() > 0.98  # an angle on the border of two bins may fall on either side


@pytest.mark.longer
def test_a_turned_room_is_brought_back():
    yaw = -3.1
    truth = Sim3(yaw, (4.0, -7.0, 0.5))
    here, there = room(), room(truth)
    pose = estimate_pose(there, here)
    middle = here.points.mean(axis=0)[None]
    assert np.linalg.norm(pose.apply(middle) - truth.apply(middle)) < 0.3
    assert abs((pose.yaw - yaw + np.pi) % (2 * np.pi) - np.pi) < np.radians(6)
    assert estimate_pose(there, here) == pose


def test_a_room_on_its_side_gives_no_pose():
    here = room()
    side = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    assert estimate_pose(compute_fpfh(here.points @ side, np.asarray(here.cloud.normals) @ side), here) is None


def test_upright_keeps_the_turn_and_the_place():
    truth, anchor = Sim3(2.5, (3.0, -1.0, 0.2)), np.array([4.0, 5.0, 1.0])
    pose = convert_to_upright(truth.matrix, anchor)
    assert np.allclose(pose.matrix, truth.matrix)
    tilt = np.array([[1, 0, 0, 0], [0, np.cos(0.1), -np.sin(0.1), 0], [0, np.sin(0.1), np.cos(0.1), 0], [0, 0, 0, 1]])
    tilted = truth.matrix @ tilt
    assert np.allclose(convert_to_upright(tilted, anchor).apply(anchor[None])[0], tilted[:3, :3] @ anchor + tilted[:3, 3])
