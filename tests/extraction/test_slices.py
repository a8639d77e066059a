"""Slices of a 2D laser: points that hang in doorways make no walls, seen walls stay."""

from __future__ import annotations

import numpy as np
import pytest

import topomerge as tm
from tests import scenes
from tests.cases import list_longer
from topomerge.errors import InputError
from topomerge.extraction.scan import Scan
from topomerge.extraction.slices import raise_slice
from topomerge.extraction.voxels import voxelise
from topomerge.kernels.rays import count_rays
from topomerge.types import PointCloud

HEIGHT = 0.4  # m
DOOR = (2.0, 2.9)  # along the wall between the rooms, at x = 4


def counted(starts, ends, shape=(10, 6), margin=1.0):
    passed, met = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
    count_rays(np.array(starts, float), np.array(ends, float), margin, passed, met)
    return passed, met


def test_rays_are_counted_in_the_columns_that_they_cross():
    passed, met = counted([(0.5, 2.5), (0.5, 2.5), (5.5, 0.5)], [(7.5, 2.5), (7.5, 2.5), (5.5, 5.5)])
    along = np.zeros((10, 6), int)
    along[:7, 2] = 2
    along[5, :5] += 1
    assert (passed == along).all() and met[7, 2] == 2 and met[5, 5] == 1 and met.sum() == 3


@pytest.mark.longer
def test_a_slanted_ray_crosses_what_a_fine_walk_along_it_does():
    rng = np.random.default_rng(0)
    for _ in range(20):
        a, b = rng.uniform(0, 30, (2, 2))
        passed, _ = counted([a], [b], (30, 30), 0.0)
        cells = np.unique(np.floor(a + np.linspace(0, 1, 200_001)[:-1, None] * (b - a)).astype(int), axis=0)
        assert passed.sum() == len(cells) and passed[tuple(cells.T)].all()


def test_rays_outside_and_rays_of_no_length_count_nothing():
    passed, met = counted([(-3.0, -3.0), (2.5, 2.5)], [(-1.0, -9.0), (2.5, 2.5)])
    assert passed.sum() == 0 and met.sum() == 1


def two_rooms(strays: int = 0) -> PointCloud:
    """8 x 5 m with a wall at x = 4 and a doorway in it, by a laser that stood at two places in each room; points that hang in the
    doorway, behind which it saw walls."""
    rng = np.random.default_rng(1)
    stood = np.array([(1.0, 1.0), (2.0, 4.0), (6.0, 1.0), (6.5, 4.0), (2.0, 2.45), (6.0, 2.45)])
    walls = [
        ((0, 0), (8, 0)),
        ((8, 0), (8, 5)),
        ((8, 5), (0, 5)),
        ((0, 5), (0, 0)),
        ((4, 0), (4, DOOR[0])),
        ((4, DOOR[1]), (4, 5)),
    ]
    angles = np.linspace(0, 2 * np.pi, 1500, endpoint=False)
    along = np.column_stack([np.cos(angles), np.sin(angles)])
    points, seen_from = [], np.repeat(np.arange(len(stood)), len(angles))
    for place in stood:
        far = nearest(place, along, walls) + rng.normal(0, 0.01, len(angles))
        points.append(place + far[:, None] * along)
    hang = np.column_stack([rng.uniform(3.9, 4.1, strays), rng.uniform(*DOOR, strays)])
    flat = np.concatenate([*points, hang])
    poses = np.tile(np.eye(4), (len(stood), 1, 1))
    poses[:, :2, 3], poses[:, 2, 3] = stood, HEIGHT
    of = np.concatenate([seen_from, rng.integers(0, len(stood), strays)]).astype(np.int32)
    cloud = np.column_stack([flat, np.full(len(flat), HEIGHT)]).astype(np.float32)
    return PointCloud(cloud, poses=poses, pose_of=of)


def nearest(place, along, walls) -> np.ndarray:
    """(n,) m along each of the rays (n, 2) to the first wall."""
    best = np.full(len(along), np.inf)
    for a, b in walls:
        (dx, dy), (x, y) = np.subtract(b, a), np.subtract(a, place)
        across = along[:, 0] * dy - along[:, 1] * dx
        with np.errstate(divide="ignore", invalid="ignore"):
            far, at = (x * dy - y * dx) / across, (x * along[:, 1] - y * along[:, 0]) / across
        met = (np.abs(across) > 1e-9) & (far > 0) & (at >= 0) & (at <= 1)
        best[met] = np.minimum(best[met], far[met])
    return best


def without_poses(cloud: PointCloud) -> PointCloud:
    return PointCloud(cloud.points)


@pytest.mark.parametrize("known", [True, *list_longer(False)])
def test_points_that_hang_in_a_doorway_do_not_shut_it(known):
    cloud = two_rooms(strays=12)
    map = tm.extract(cloud if known else without_poses(cloud))
    (edge,) = map.edges
    assert len(map.rooms) == 2 and edge["open"] and edge["centre"][:2] == pytest.approx([4.0, np.mean(DOOR)], abs=0.2)


def test_columns_that_many_rays_went_through_are_free_and_walls_stay():
    cloud = two_rooms(strays=12)
    rays = cloud.poses[cloud.pose_of, :3, 3], cloud.points
    clear, full = (raise_slice(Scan(voxelise(c), rays=r)).grid for c, r in ((two_rooms(), None), (cloud, rays)))
    assert len(clear) and wall_area(full) == pytest.approx(wall_area(clear), rel=0.03)
    assert not standing(full, 4.0, np.mean(DOOR)) and standing(full, 4.0, 1.0) and standing(full, 0.0, 3.0)


def wall_area(grid) -> float:
    return float((grid.cells[:, 2] > grid.cells[:, 2].min()).sum()) * grid.edge**2


def standing(grid, x: float, y: float) -> bool:
    """Is anything above the floor within 0.1 m?"""
    above = grid.compute_centroids()[grid.cells[:, 2] > grid.cells[:, 2].min() + 3]
    return bool((np.abs(above[:, :2] - (x, y)) < 0.11).all(axis=1).any())


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_a_cloud_of_a_floor_only_is_named_and_no_slice(noise: float) -> None:
    """Cut out of a scan of two rooms: the doorway and what stood on the floor are holes in it."""
    floor = scenes.two_rooms().points(noise)
    floor = floor[floor[:, 2] < 0.15]
    table = (np.abs(floor[:, 0] - 2) < 0.7) & (np.abs(floor[:, 1] - 3) < 0.5)
    for points in (floor, floor[~table], floor[::5], floor + (0, 0, 2.7)):
        with pytest.raises(InputError, match=r"^only a floor or a ceiling was seen .* no walls: .* give a scan that shows walls"):
            tm.extract(points.astype(np.float32))


def test_a_slice_with_furniture_is_still_one() -> None:
    scene = scenes.corridor()
    for x, y in ((1.0, 1.0), (5.0, 7.0), (13.0, 1.0)):
        scene.box(x, y, 0.0, x + 1.4, y + 0.8, 0.9)
    points = scene.points()
    map = tm.extract(points[np.abs(points[:, 2] - 0.6) < 0.2])
    assert len(map.rooms) >= 7 and any("is a slice" in w for w in map.warnings)
