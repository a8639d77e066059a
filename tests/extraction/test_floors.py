"""A floor for scans that have none: how low it is put, by what is known."""

import numpy as np
import pytest

import topomerge as tm
from topomerge.types import Array, PointCloud

CEILING = 2.8


def upper_half(lowest: float, step: float = 0.04, ceiling: float = CEILING) -> Array:
    """Points of two rooms of 5 by 4 m with a door between them, from `lowest` up to their ceiling at 2.8 m."""
    across, along, up = np.arange(0, 10, step), np.arange(0, 4, step), np.arange(lowest, ceiling, step)
    sheets = [np.stack(np.meshgrid(across, along, [ceiling]), -1).reshape(-1, 3)]
    sheets += [np.stack(np.meshgrid(across, [y], up), -1).reshape(-1, 3) for y in (0.0, 4.0)]
    sheets += [np.stack(np.meshgrid([x], along, up), -1).reshape(-1, 3) for x in (0.0, 5.0, 10.0)]
    points = np.concatenate(sheets)
    doorway = (abs(points[:, 0] - 5) < 0.1) & (abs(points[:, 1] - 1.5) < 0.5) & (points[:, 2] < 2.1)
    return points[~doorway]


def test_a_floor_lies_as_far_below_the_ceiling_as_in_most_buildings() -> None:
    map = tm.extract(upper_half(1.2))
    assert len(map.storeys) == 1 and map.storeys["floor"][0] == pytest.approx(0.2, abs=0.15)
    assert len(map.rooms) == 2 and any("floor" in w for w in map.warnings)


@pytest.mark.parametrize("lowest", [1.4, 1.5])
def test_a_low_ceiling_close_above_what_was_seen_is_no_floor(lowest: float) -> None:
    map = tm.extract(upper_half(lowest, ceiling=2.3))
    assert map.storeys["floor"][0] == pytest.approx(2.3 - 2.6, abs=0.15)
    assert len(map.rooms) == 2 and any("floor" in w for w in map.warnings)


def test_a_floor_without_a_ceiling_is_one() -> None:
    points = upper_half(1.2) * (1, 1, -1)  # from the floor up to 1.6 m
    map = tm.extract(points)
    assert map.storeys["floor"][0] == pytest.approx(-CEILING, abs=0.1) and not any("floor" in w for w in map.warnings)


def test_points_that_reach_lower_than_that_tell_where_the_floor_is() -> None:
    assert tm.extract(upper_half(-0.3)).storeys["floor"][0] == pytest.approx(-0.3, abs=0.2)


@pytest.mark.longer
@pytest.mark.parametrize("eyes", [1.0, 1.4, 1.7])
def test_the_sensor_was_carried_at_a_usual_height(eyes: float) -> None:
    points = upper_half(1.2)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = [(2.5, 2, eyes), (7.5, 2, eyes)]
    seen_from = (points[:, 0] > 5).astype(np.int32)
    map = tm.extract(PointCloud(points.astype(np.float32), poses=poses, pose_of=seen_from))
    assert map.storeys["floor"][0] == pytest.approx(eyes - 1.4, abs=0.15)


def test_a_sensor_above_the_ceiling_tells_nothing() -> None:
    points = upper_half(1.2)
    poses = np.eye(4)[None].copy()
    poses[0, :3, 3] = 2, 2, 9
    map = tm.extract(PointCloud(points.astype(np.float32), poses=poses, pose_of=np.zeros(len(points), np.int32)))
    assert map.storeys["floor"][0] == pytest.approx(0.2, abs=0.15)
