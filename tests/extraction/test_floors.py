"""A floor for scans that have none: how low it is put, by what is known.

A hall through two storeys' height beside low rooms, seen from outside as well: the low rooms' flat roof is no storey.
"""

import numpy as np
import pytest

import topomerge as tm
from tests.cases import list_longer
from tests.scenes import Scene
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


@pytest.mark.parametrize("lowest", [1.4, *list_longer(1.5)])
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


def gym(parapet: float = 0.0, slab: float = 0.3, hall: float = 7.0) -> np.ndarray:
    """The surfaces of a mesh: four low rooms, 8 x 10 m, and a hall of 14 x 10 m, with the upper sides of both roofs."""
    low = 3.0 + slab
    scene = Scene().floor(0, 0, 8, 10).floor(0, 0, 8, 10, 3.0).floor(-0.2, -0.2, 8, 10.2, low)
    scene.floor(8.2, 0, 22, 10).floor(8.2, 0, 22, 10, hall).floor(8, -0.2, 22.2, 10.2, hall + slab)
    scene.wall((-0.1, -0.1), (8.1, -0.1), 0, low + parapet, doors=(4.0,))
    for a, b in (((-0.1, -0.1), (-0.1, 10.1)), ((-0.1, 10.1), (8.1, 10.1))):
        scene.wall(a, b, 0, low + parapet)
    scene.wall((8.1, -0.1), (8.1, 10.1), 0, hall + slab, doors=(2.5, 7.5))
    for a, b in (((22.1, -0.1), (22.1, 10.1)), ((8.1, -0.1), (22.1, -0.1)), ((8.1, 10.1), (22.1, 10.1))):
        scene.wall(a, b, 0, hall + slab)
    return scene.wall((4, 0), (4, 10), 0, 3.0, doors=(2.5, 7.5)).wall((0, 5), (8, 5), 0, 3.0).points()


@pytest.mark.parametrize("more", [{}, *list_longer({"parapet": 0.6}, {"slab": 0.6}, {"hall": 5.6})])
@pytest.mark.longer
def test_the_flat_roof_beside_a_hall_is_no_storey(more: dict[str, float]) -> None:
    map = tm.extract(gym(**more))
    assert len(map.storeys) == 1 and len(map.rooms) == 5
    assert np.allclose(np.sort(map.rooms["area"])[:4], 20, atol=1.0) and abs(map.rooms["area"].max() - 140) < 3


@pytest.mark.longer
@pytest.mark.parametrize("ceiling", [True, *list_longer(False)])
def test_rooms_upstairs_beside_a_hall_are_a_storey(ceiling: bool) -> None:
    """The same with two rooms on the low ones; also where their own ceiling was not scanned."""
    points = [gym()]
    upstairs = Scene().wall((0.0, 0.0), (8.0, 0.0), 3.3, 2.6).wall((0.0, 10.0), (8.0, 10.0), 3.3, 2.6)
    upstairs.wall((0.0, 0.0), (0.0, 10.0), 3.3, 2.6).wall((0, 5), (8, 5), 3.3, 2.6, doors=(4.0,))
    if ceiling:
        upstairs.floor(0, 0, 8, 10, 5.9)
    map = tm.extract(np.concatenate([*points, upstairs.points()]))
    upper = map.rooms["area"][map.rooms["storey"] == 1]
    assert len(map.storeys) == 2 and np.isclose(upper, 40, atol=4).sum() == 2
