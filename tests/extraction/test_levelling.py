"""Tilted clouds: up is found by floors, ceilings and walls; ramps and roofs are not levelled away; what is level stays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import topomerge as tm
from tests import scenes
from tests.cases import list_longer
from topomerge.extraction.levelling import (
    LARGEST_TILT,
    LEAST_TILT,
    LevelledChunks,
    build_rotation_about,
    compute_rotation_to_z,
    find_up,
    measure_degrees_from_z,
    transform_cloud,
    transform_grid,
)
from topomerge.types import PointCloud, VoxelGrid, transform_points

FAR = np.array([431_000.0, 5_812_000.0, 40.0])  # m, in a national grid


def rotation(degrees: float, about: float = 0.0) -> np.ndarray:
    """(3, 3) by degrees about a horizontal axis that lies `about` degrees from x."""
    axis = np.radians(about)
    return Rotation.from_rotvec(np.radians(degrees) * np.array([np.cos(axis), np.sin(axis), 0.0])).as_matrix()


def tilted(points: np.ndarray, degrees: float, about: float = 0.0) -> np.ndarray:
    return (np.asarray(points, np.float64) @ rotation(degrees, about).T).astype(np.float32)


def attic() -> np.ndarray:
    """A room of 8 x 5 m under a roof of 18 degrees that falls to one side."""
    scene = scenes.Scene().shell(0, 0, 8, 5, height=1.6, ceiling=False)
    scene.wall((0, 5), (8, 5), 1.6, 1.6).wall((0, 0), (0, 5), 1.6, 1.2).wall((8, 0), (8, 5), 1.6, 1.2)
    scene.parts.append(scenes.rectangle((0, 0, 1.6), (8, 0, 0), (0, 5, 1.62)))
    return scene.points()


def ramp(length: float, climb: float) -> np.ndarray:
    """A corridor 2 m wide that is all ramp, floor and ceiling, between long walls, with a wall at either end."""
    scene = scenes.Scene()
    for height in (0.0, 2.6):
        scene.parts.append(scenes.rectangle((0, 0, height), (length, 0, climb), (0, 2, 0)))
    for y in (0, 2):
        scene.wall((0, y), (length, y), height=2.6 + climb)
    return scene.wall((0, 0), (0, 2), height=2.6).wall((length, 0), (length, 2), climb, 2.6).points()


@pytest.mark.longer
@pytest.mark.parametrize(("degrees", "noise"), [(1.5, 0.015), (2.0, 0.0), (5.0, 0.015), (12.0, 0.0), (20.0, 0.015)])
def test_up_is_found(degrees: float, noise: float) -> None:
    for about in (0.0, 33.0, 90.0, 250.0):
        up = find_up(tilted(scenes.corridor().points(noise), degrees, about))
        assert up is not None and abs(measure_degrees_from_z(up) - degrees) < 0.2
        off = np.degrees(np.arccos(np.clip(up @ rotation(degrees, about)[:, 2], -1, 1)))
        assert off < 0.2
        assert np.allclose(compute_rotation_to_z(up) @ up, (0, 0, 1)) and np.isclose(
            np.linalg.det(compute_rotation_to_z(up)), 1.0
        )


@pytest.mark.parametrize("degrees", [0.5 * LEAST_TILT, LARGEST_TILT + 8, *list_longer(0.0)])
def test_what_is_level_or_lies_on_its_side_is_left(degrees: float) -> None:
    assert find_up(tilted(scenes.corridor().points(0.01), degrees, 20.0)) is None


@pytest.mark.parametrize(
    "points",
    [scenes.ramp().points(), ramp(16, 1.2), ramp(30, 3.0), attic(), scenes.two_storeys().points(), scenes.mezzanine().points()],
    ids=["ramp", "all ramp", "long ramp", "attic", "stairs", "gallery"],
)
def test_ramps_roofs_and_stairs_are_not_levelled_away(points: np.ndarray) -> None:
    assert find_up(points) is None


@pytest.mark.parametrize("scene", [scenes.ramp, scenes.two_storeys])
def test_a_tilted_building_with_a_ramp_or_stairs_is_levelled_by_the_rest(scene) -> None:
    up = find_up(tilted(scene().points(0.01), 7.0, 40.0))
    assert up is not None and np.degrees(np.arccos(up @ rotation(7.0, 40.0)[:, 2])) < 0.5


def test_few_points_and_points_of_no_building_say_nothing() -> None:
    rng = np.random.default_rng(0)
    for points in (np.zeros((0, 3)), rng.uniform(0, 9, (40_000, 3)), np.full((9, 3), np.nan), np.full((500, 3), 1e30)):
        assert find_up(points) is None


@pytest.mark.longer
def test_rooms_and_doors_are_those_of_the_level_cloud() -> None:
    points = scenes.corridor().points()
    level = tm.extract(points)
    assert level.warnings == () and "levelled" not in level.parameters and np.array_equal(level.levelling, np.eye(4))
    for degrees, about in ((5.0, 75.0), (14.0, 200.0)):
        map = tm.extract(tilted(points, degrees, about))
        assert map.warnings == (f"tilted by {degrees:.1f} degrees: levelled",)
        assert len(map.rooms) == len(level.rooms) == 9 and len(map.storeys) == 1
        assert sorted(map.edges["kind"]) == sorted(level.edges["kind"])
        assert np.allclose(np.sort(map.rooms["area"]), np.sort(level.rooms["area"]), rtol=0.05)
        there = transform_points(map.levelling, tilted(points, degrees, about))
        assert np.abs(np.ptp(there[:, 2]) - np.ptp(points[:, 2])) < 0.1


def test_a_level_cloud_stays_to_the_bit() -> None:
    cloud = PointCloud(scenes.two_rooms().points(0.01))
    chunks = LevelledChunks([cloud])
    assert list(chunks) == [cloud] and chunks.matrix is None and not chunks.warnings
    one, other = tm.extract(cloud), tm.extract(cloud, level=False)
    assert np.array_equal(one.grid.cells, other.grid.cells) and np.array_equal(one.room, other.room)


def test_chunks_are_levelled_alike_however_they_are_cut() -> None:
    points = tilted(scenes.corridor().points(), 6.0, 10.0)
    rng = np.random.default_rng(1)
    points = points[rng.permutation(len(points))]
    few = [PointCloud(points[:300], source="a.ply"), PointCloud(points[300:40_000]), PointCloud(points[40_000:])]
    for chunks in ([PointCloud(points, source="a.ply")], few):
        levelled = LevelledChunks(chunks)
        moved = np.concatenate([chunk.points for chunk in levelled])
        assert levelled.warnings == ["a.ply: tilted by 6.0 degrees: levelled"]
        assert len(moved) == len(points) and abs(np.ptp(moved[:, 2]) - 2.7) < 0.1
        assert np.abs(moved - transform_points(levelled.matrix, points)).max() < 1e-4


def test_far_from_the_origin_heights_stay_near() -> None:
    points = tilted(scenes.corridor().points(), 9.0, 30.0)
    cloud = PointCloud(points, shift=FAR)
    chunks = LevelledChunks([cloud])
    (moved,) = chunks
    assert chunks.matrix is not None and np.array_equal(moved.shift, FAR)
    assert np.abs(moved.points - points).max() < 5.0 and abs(np.ptp(moved.points[:, 2]) - 2.7) < 0.1


def test_poses_and_free_cells_move_along() -> None:
    matrix = build_rotation_about(np.array([3.0, 2.0, 1.0]), rotation(11.0, 50.0))
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = ((1.0, 2.0, 1.5), (4.0, 2.0, 1.5))
    poses[1, :3, :3] = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    cells = np.argwhere(np.ones((20, 12, 8), bool))
    free = VoxelGrid.from_cells(cells, np.array([0.1, -0.3, 0.2]), 0.2)
    cloud = PointCloud(np.float32([[1, 2, 3], [np.nan, 0, 0]]), poses=poses, pose_of=np.int32([0, 1]), free=free)
    moved = transform_cloud(cloud, matrix)
    assert np.allclose(moved.points[0], (matrix @ (1, 2, 3, 1))[:3], atol=1e-5) and np.isnan(moved.points[1]).all()
    assert np.allclose(moved.poses, matrix @ poses) and np.allclose(moved.poses[1, :3, 3], (matrix @ (4.0, 2.0, 1.5, 1))[:3])
    assert moved.free is not None and 0.97 < len(moved.free) / len(free) < 1.03
    back = free.contains(free.locate(transform_points(np.linalg.inv(matrix), moved.free.compute_centroids())))
    assert back.all() and moved.free.contains(moved.free.locate(transform_points(matrix, free.compute_centroids()))).mean() > 0.85
    assert len(transform_grid(free.select_cells(np.zeros(len(free), bool)), matrix)) == 0


def test_rays_of_a_tilted_scan_start_where_the_sensor_was() -> None:
    points = scenes.two_rooms().points()
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = ((2.0, 2.5, 1.5), (5.5, 2.5, 1.5))
    turn = np.eye(4)
    turn[:3, :3] = rotation(8.0, 70.0)
    cloud = PointCloud(tilted(points, 8.0, 70.0), poses=turn @ poses, pose_of=(points[:, 0] > 4).astype(np.int32))
    map = tm.extract(cloud)
    assert len(map.rooms) == 2 and (map.rooms["entered"] > 0.5).all()
    places = transform_points(map.levelling @ turn, poses[:, :3, 3])
    assert map.free is not None and map.free.contains(map.free.locate(places)).all()


@pytest.mark.longer
def test_plans_models_and_slices_are_never_levelled(tmp_path: Path) -> None:
    points = tilted(scenes.corridor().points(), 5.0)
    upright = LevelledChunks([PointCloud(points, upright=True)])
    assert len(list(upright)) == 1 and upright.matrix is None
    flat = scenes.two_rooms().points()
    flat = flat[(flat[:, 2] > 1.0) & (flat[:, 2] < 1.5)]
    for cloud in (flat, tilted(flat, 1.2)):
        sliced = LevelledChunks([PointCloud(cloud)])
        assert len(list(sliced)) == 1 and sliced.matrix is None
    assert tm.extract(points, preset="thesis", level=True).warnings[0].startswith("tilted by 5.0 degrees")


def test_a_scene_can_be_left_as_it_is() -> None:
    map = tm.extract(tilted(scenes.two_rooms().points(), 5.0), level=False)
    assert "levelled" not in map.parameters and not any("tilted" in w for w in map.warnings)


@pytest.mark.data
@pytest.mark.longer
def test_real_scans_that_are_level_are_left(data_dir: Path) -> None:
    for name in ("scans_real_3d/studio_3cm.laz", "scans_real_3d/atrium_two_storeys_2cm.laz"):
        points = tm.read_points(data_dir / name).points
        assert find_up(points) is None
        up = find_up(tilted(points, 6.0, 130.0))
        assert up is not None and np.degrees(np.arccos(up @ rotation(6.0, 130.0)[:, 2])) < 1.0
