from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
import shapely
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import Building
from topomerge.datasets.simulation.scanner import scan_building
from topomerge.datasets.simulation.sensors import SENSORS, get_sensor
from topomerge.datasets.simulation.walk import plan_walk, sample_part

from tests.datasets.boxes import BARE, one_room, tower, two_rooms
from topomerge.errors import InputError
from topomerge.types import PointCloud, Sim3

PERFECT = {
    "noise": (0.0, 0.0), "quadratic": 0.0, "grazing": 0.0, "dark": 0.0, "lost": 0.0, "mixed": 0.0, "drift": 0.0, "tilt": 0.0,
    "plain": 1.0, "lowest": -1.0, "jitter": (0.0, 0.0), "ghost": 0.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def closed() -> Building:
    return build_building([replace(one_room(), openings=())], BARE)


@pytest.fixture(scope="module")
def office() -> Building:
    return make_building("office", 0)


def off_the_walls(points: np.ndarray) -> np.ndarray:
    """Distance of points to the faces of the room of 4 by 5 by 2.7 m."""
    size = np.array([4, 5, 2.7])
    return np.abs(np.concatenate([points, size - points], axis=1)).min(axis=1)


def off_the_surfaces(building: Building, cloud: PointCloud) -> np.ndarray:
    o3d = pytest.importorskip("open3d", exc_type=ImportError)

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(building.vertices), o3d.core.Tensor(building.triangles.astype(np.uint32)))
    return np.asarray(scene.compute_distance(o3d.core.Tensor(cloud.points)).numpy())


def test_a_perfect_laser_hits_the_planes_exactly(closed: Building) -> None:
    cloud = scan_building(closed, replace(SENSORS["tls"], **PERFECT), seed=1)
    assert len(cloud) > 10_000
    assert off_the_walls(cloud.points).max() < 1e-4
    assert (cloud.labels == 0).all()


@pytest.mark.parametrize("name", list(SENSORS))
def test_points_of_every_sensor_lie_on_the_walls_within_its_noise(closed: Building, name: str) -> None:
    sensor = replace(SENSORS[name], drift=0.0, tilt=0.0, mixed=0.0, jitter=(0.0, 0.0))
    cloud = scan_building(closed, sensor, seed=2)
    sigma = sensor.noise[0] + sensor.noise[1] * 7 + sensor.quadratic * 49
    assert len(cloud) > 200
    assert np.quantile(off_the_walls(cloud.points), 0.99) < 3 * sigma
    ranges = np.linalg.norm(cloud.points - cloud.poses[cloud.pose_of, :3, 3], axis=1)
    assert ranges.max() <= sensor.reach[1] + 1e-3
    if name == "tablet":
        assert cloud.points[:, 2].min() > 0.8
    if name == "laser2d":
        assert np.ptp(cloud.points[:, 2]) < 1e-3 and cloud.points[0, 2] == pytest.approx(0.3)


def test_no_ray_goes_through_a_shut_door_and_labels_tell_the_rooms_apart() -> None:
    shut = build_building([two_rooms(state="shut")], BARE)
    cloud = scan_building(shut, replace(SENSORS["tls"], **PERFECT), rooms=[0])
    assert cloud.points[:, 0].max() < 4.3 and set(cloud.labels.tolist()) == {0}
    both = scan_building(shut, "tls")
    assert (both.labels[both.points[:, 0] < 3.98] == 0).all()
    assert (both.labels[(both.points[:, 0] > 4.22) & (both.points[:, 0] < 8.1)] == 1).all()
    opened = scan_building(build_building([two_rooms(state="open")], BARE), "tls", rooms=[0])
    assert 0 < (opened.labels == 1).mean() < 0.4


def test_labels_of_an_office_are_the_rooms_around_the_points(office: Building) -> None:
    cloud = scan_building(office, replace(SENSORS["tls"], **PERFECT), spacing=0.1)
    for index, room in enumerate(office.rooms):
        mine = shapely.contains_xy(shapely.Polygon(room.polygon).buffer(-0.05), cloud.points[:, :2].astype(float))
        assert mine.sum() > 50 and (cloud.labels[mine] == index).mean() > 0.999


def test_glass_lets_rays_through_or_returns_them() -> None:
    building = build_building([one_room()], BARE)
    for share in (0.0, 1.0):
        cloud = scan_building(building, replace(SENSORS["tls"], **PERFECT, glass=share))
        pane = (np.abs(cloud.points - [2, -0.15, 1.4]) < [0.9, 0.001, 0.4]).all(axis=1)
        assert pane.any() == (share == 1.0)
        assert (cloud.points[:, 1] < -0.2).any() == (share == 0.0), "the outer half of the reveals, behind the pane"


def test_spacing_and_budget_set_the_number_of_points(office: Building) -> None:
    fine, coarse = (len(scan_building(office, "tls", spacing=s)) for s in (0.1, 0.2))
    assert 2.5 < fine / coarse < 6
    assert 15_000 < len(scan_building(office, "depth", budget=30_000)) <= 33_000


def test_a_frame_moves_points_poses_and_rooms_alike(office: Building) -> None:
    frame = Sim3(0.7, (3.0, -20.0, 1.5), 1.3)
    own, moved = scan_building(office, "depth", spacing=0.2), scan_building(office, "depth", spacing=0.2, frame=frame)
    assert np.allclose(frame.apply(own.points), moved.points, atol=1e-3)
    assert np.allclose(frame.apply(own.poses[:, :3, 3]), moved.poses[:, :3, 3])
    assert np.allclose(frame.apply(np.column_stack([own.rooms[3].polygon, np.zeros(4)]))[:, :2], moved.rooms[3].polygon)
    assert moved.rooms[3].ceiling == pytest.approx(1.5 + 1.3 * own.rooms[3].ceiling)


@pytest.mark.longer
def test_drift_bends_the_map_by_centimetres(office: Building) -> None:
    straight = replace(SENSORS["depth"], drift=0.0, tilt=0.0)
    true, bent = scan_building(office, straight, seed=4), scan_building(office, replace(straight, drift=0.5), seed=4)
    off = np.linalg.norm(true.poses[:, :3, 3] - bent.poses[:, :3, 3], axis=1)
    assert 0.02 < off.max() < 1.0
    assert np.abs(np.diff(off)).max() < 0.05


def test_noise_grows_with_range_and_mixed_pixels_stand_in_the_air(closed: Building, office: Building) -> None:
    sensor = replace(SENSORS["depth"], **{**PERFECT, "quadratic": 0.01})
    cloud = scan_building(closed, sensor)
    ranges = np.linalg.norm(cloud.points - cloud.poses[cloud.pose_of, :3, 3], axis=1)
    error = off_the_walls(cloud.points)
    assert error[ranges > 3.5].mean() > 1.5 * error[ranges < 2.2].mean()
    clean, mixed = (scan_building(office, replace(SENSORS["tls"], **{**PERFECT, "mixed": m}), rooms=[3]) for m in (0.0, 1.0))
    assert (off_the_surfaces(office, clean) > 0.01).mean() == 0
    assert 0.002 < (off_the_surfaces(office, mixed) > 0.03).mean() < 0.1


def test_the_walk_goes_through_doors_and_stays_off_walls_and_furniture(office: Building) -> None:
    rooms = list(range(len(office.rooms)))
    walk = plan_walk(office, rooms, np.random.default_rng(0))
    assert set(walk.room.tolist()) >= set(rooms)
    floor = shapely.union_all([shapely.Polygon(r.polygon).buffer(0.02) for r in office.rooms])
    doors = [shapely.Point(d["centre"][:2]).buffer(d["width"] / 2 + 0.1) for d in office.doors]
    free = shapely.union_all([floor, *doors])
    assert shapely.contains_xy(free, walk.points[:, :2]).all()
    assert np.linalg.norm(np.diff(walk.points, axis=0), axis=1).max() < 0.3
    assert walk.free.mean() > 0.95


def test_the_walk_climbs_stairs() -> None:
    building = build_building(tower("dogleg", 2, 2.5, 3.8), BARE)
    walk = plan_walk(building, [0, 1], np.random.default_rng(0))
    assert walk.points[:, 2].min() == pytest.approx(0, abs=1e-6) and walk.points[:, 2].max() == pytest.approx(3.2)
    cloud = scan_building(building, "depth")
    assert set(cloud.labels.tolist()) >= {0, 1}
    assert (cloud.poses[:, 2, 3] > 2.0).any()


def test_parts_hang_together(office: Building) -> None:
    rooms = sample_part(office, 6, np.random.default_rng(1))
    assert len(rooms) == 6
    edges = {tuple(sorted(e)) for e in office.list_edges().tolist()}
    seen = {int(rooms[0])}
    for _ in rooms:
        seen |= {int(r) for r in rooms for s in seen if tuple(sorted((int(r), s))) in edges}
    assert seen == set(rooms.tolist())


def test_the_same_seed_gives_the_same_points(office: Building) -> None:
    def digest(cloud: PointCloud) -> bytes:
        return cloud.points.tobytes() + cloud.labels.tobytes()

    one, same, other = (scan_building(office, "lidar", rooms=[0, 3, 4], seed=s, spacing=0.1) for s in (1, 1, 2))
    assert digest(one) == digest(same) != digest(other)


def test_wrong_arguments_are_refused(office: Building) -> None:
    with pytest.raises(InputError, match="sensor 'sonar'"):
        get_sensor("sonar")
    with pytest.raises(InputError, match=r"rooms to visit must be among 0\.\.15"):
        scan_building(office, rooms=[99])
    with pytest.raises(InputError, match="spacing must be"):
        scan_building(office, spacing=0.0)
    with pytest.raises(InputError, match="saw nothing"):
        scan_building(office, replace(SENSORS["tls"], reach=(0.01, 0.02)), rooms=[3])


def test_a_room_that_cannot_be_reached_is_named() -> None:
    building = build_building([replace(two_rooms(), openings=())], BARE)
    with pytest.raises(InputError, match=r"cannot be reached"):
        scan_building(building)


@pytest.mark.longer
def test_a_scan_of_a_storey_is_quick(office: Building) -> None:
    scan_building(office, "tls")
    start = time.process_time()
    scan_building(office, "tls")
    assert time.process_time() - start < 4.0  # 0.9 s on an idle core


def test_a_long_room_may_be_left_half_way(office: Building) -> None:
    corridor = max(range(len(office.rooms)), key=lambda i: float(np.ptp(office.rooms[i].polygon, axis=0).max()))
    whole, half = (plan_walk(office, [corridor], np.random.default_rng(1), unfinished=u) for u in (0.0, 1.0))
    reach = [float(np.ptp(w.points[:, :2], axis=0).max()) for w in (whole, half)]
    assert reach[1] < 0.85 * reach[0] and len(half.stops) < len(whole.stops)
    every = plan_walk(office, list(range(len(office.rooms))), np.random.default_rng(1), unfinished=1.0)
    assert set(every.room.tolist()) >= set(range(len(office.rooms))), "every room that was asked for is entered"


def test_a_pane_mirrors_the_room_behind_it() -> None:
    building = build_building([one_room()], BARE)
    cloud = scan_building(building, replace(SENSORS["tls"], **{**PERFECT, "glass": 0.0, "ghost": 1.0}))
    ghosts = cloud.points[cloud.labels == -1].astype(float)
    assert len(ghosts) > 50 and (ghosts[:, 1] < -0.14).all()
    image = ghosts * [1, -1, 1] + [0, -0.3, 0]  # the pane stands at y = -0.15
    inside = image[image[:, 1] > 0.05]
    assert len(inside) > 50 and np.quantile(off_the_walls(inside), 0.9) < 0.01, "but for the reveals of door and window"
    assert not (scan_building(building, replace(SENSORS["tls"], **PERFECT, glass=1.0)).labels == -1).any()


def test_jitter_makes_walls_thick_where_views_overlap(closed: Building) -> None:
    still = {"noise": (0.0, 0.0), "quadratic": 0.0, "drift": 0.0, "tilt": 0.0, "mixed": 0.0}
    off = [
        off_the_walls(scan_building(closed, replace(SENSORS["depth"], **still, jitter=(j, 0.0)), seed=3).points).std()
        for j in (0.0, 0.02)
    ]
    assert off[0] < 1e-3 and 0.008 < off[1] < 0.04
