"""Bags of ROS 1 and ROS 2: points with the sensor's places, slices, maps, and what can be wrong with them."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")

from tests.io.bags import KINDS, MOUNT, Entry, Messages, walk_messages, write_bag
from tests.io.test_read_folders import assert_same, refusal_of, refused
from tests.io.walks import START, Walk, room_walk, write_kitti, write_tum
from tests.samples import box_colors, write_plan
from topomerge.io import read_points
from topomerge.io.bag_file import TRANSFORMS

CLOUD, GRID, ODOMETRY = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/OccupancyGrid", "nav_msgs/msg/Odometry"


@pytest.fixture
def walk() -> Walk:
    return room_walk()


Make = Callable[[Messages], Iterable[Entry]]


def changed(make: Make, change: Callable[[Entry, int], Entry | None]) -> Make:
    """The same messages, each (with its number) changed or left out."""
    return lambda m: (new for number, entry in enumerate(make(m)) if (new := change(entry, number)) is not None)


def without(make: Make, *topics: str) -> Make:
    return changed(make, lambda entry, _: None if entry[0] in topics else entry)


def joined(*makes: Make) -> Make:
    return lambda m: sorted((e for make in makes for e in make(m)), key=lambda e: e[2])


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_is_the_walk(tmp_path: Path, walk: Walk, kind: str) -> None:
    assert_same(read_points(write_bag(tmp_path, kind, walk_messages(walk))), walk)


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_odometry_moves_what_tf_does_not(tmp_path: Path, walk: Walk, kind: str) -> None:
    cloud = read_points(write_bag(tmp_path, kind, walk_messages(walk, "odometry")))
    assert_same(cloud, walk)
    assert cloud.warnings == ()


def test_odometry_of_a_frame_without_tf(tmp_path: Path, walk: Walk) -> None:
    robot = Walk(walk.scans, walk.poses @ MOUNT, walk.times)  # then odometry has the poses of the walk
    cloud = read_points(write_bag(tmp_path, "mcap", without(walk_messages(robot, "odometry"), "/tf_static")))
    assert_same(cloud, walk)
    assert cloud.warnings == ("tf does not say where 'lidar' stands in 'base_link', which /odom moves: taken as the same frame",)


@pytest.mark.parametrize("poses", ["tf", "none"])
def test_a_trajectory_goes_before_tf(tmp_path: Path, walk: Walk, poses: str) -> None:
    moved = Walk(walk.scans, walk.poses + np.array([[0, 0, 0, 5.0], *np.zeros((3, 4))]), walk.times)
    path = write_bag(tmp_path, "mcap", walk_messages(walk, poses))
    assert_same(read_points(path, poses=str(write_tum(tmp_path / "a.txt", moved.poses, moved.times))), moved)
    assert_same(read_points(path, poses=str(write_kitti(tmp_path / "b.txt", moved.poses))), moved)
    write_tum(tmp_path / "c.txt", moved.poses[:2], moved.times[:2] - 0.15)
    cloud = read_points(path, poses=str(tmp_path / "c.txt"))
    assert cloud.poses is not None and len(cloud.poses) == 2
    assert cloud.warnings == ("1 of 3 messages of /points have no pose near their time and are left out",)


def test_a_topic_of_poses(tmp_path: Path, walk: Walk) -> None:
    """Two odometries: one has to be named; the one that is named goes before tf."""

    def on_wheels(entry: Entry, _: int) -> Entry | None:
        if entry[0] != "/odom":
            return None
        entry[3].header.frame_id = "start"
        return ("/wheels", *entry[1:])

    wheels = changed(walk_messages(walk, "odometry"), on_wheels)
    path = write_bag(tmp_path, "mcap", joined(walk_messages(walk, "odometry"), wheels))
    assert "has several topics of odometry (/odom, /wheels); give --poses with one of them" in refusal_of(path)
    for name in ("/odom", "wheels"):
        assert_same(read_points(path, poses=name), walk)
    assert "the topic /points holds PointCloud2, no poses" in refusal_of(path, poses="/points")
    assert "/none: is neither a file nor a topic of" in refusal_of(path, poses="/none")
    both = write_bag(tmp_path / "both", "mcap", joined(walk_messages(walk, "tf"), wheels))
    assert_same(read_points(both, poses="/wheels"), walk)


def registered(walk: Walk, carrier: bool) -> Make:
    """What FAST-LIO publishes: points in the fixed frame, and the sensor in tf."""

    def make(m: Messages) -> Iterable[Entry]:
        for points, pose, time in zip(walk.world, walk.poses, walk.times.tolist(), strict=True):
            if carrier:
                yield "/tf", TRANSFORMS, time, m.transforms([("camera_init", "body", pose)], time)
            yield "/cloud_registered", CLOUD, time, m.cloud(points, time, "camera_init")

    return make


def test_registered_points_stay_where_they_are(tmp_path: Path, walk: Walk) -> None:
    assert_same(read_points(write_bag(tmp_path / "a", "bag", registered(walk, True))), walk)
    path = write_bag(tmp_path / "b", "bag", registered(walk, False))
    cloud = read_points(path)
    np.testing.assert_allclose(cloud.points, np.concatenate(walk.world), atol=1e-5)
    assert cloud.poses is None and cloud.pose_of is None
    assert cloud.warnings == (
        "/cloud_registered stands in 'camera_init', and where its sensor was is not known: give --poses for true free space",
    )
    assert_same(read_points(path, poses=str(write_tum(tmp_path / "a.txt", walk.poses, walk.times))), walk)


def test_poses_are_interpolated(tmp_path: Path) -> None:
    """tf ten times a second, and a scan between: half the way, half the turn."""

    def make(m: Messages) -> Iterable[Entry]:
        for number in range(5):
            pose = np.eye(4)
            pose[:2, :2] = [[np.cos(0.4 * number), -np.sin(0.4 * number)], [np.sin(0.4 * number), np.cos(0.4 * number)]]
            pose[0, 3] = number
            time = START + 0.1 * number
            yield "/tf", TRANSFORMS, time, m.transforms([("odom", "lidar", pose)], time)
        yield "/points", CLOUD, START + 0.5, m.cloud(np.array([[1.0, 0, 0]]), START + 0.15, "lidar")

    cloud = read_points(write_bag(tmp_path, "mcap", make))
    np.testing.assert_allclose(cloud.points[0], (1.5 + np.cos(0.6), np.sin(0.6), 0), atol=1e-5)
    assert cloud.poses is not None
    np.testing.assert_allclose(cloud.poses[0, :3, 3], (1.5, 0, 0), atol=1e-5)


def test_slices_of_a_2d_laser(tmp_path: Path) -> None:
    """A round room: every range is 3 m; what is out of the laser's reach or nothing met gives no point."""
    ranges = np.full(360, 3.0)
    ranges[:5] = (np.inf, np.nan, 0.01, 50.0, 0.0)
    pose = np.eye(4)
    pose[:3, 3] = (10, 20, 0.4)

    def make(m: Messages) -> Iterable[Entry]:
        yield "/tf_static", TRANSFORMS, START, m.transforms([("map", "laser", pose)], START)
        yield "/scan", "sensor_msgs/msg/LaserScan", START, m.laser(ranges, START, "laser")

    cloud = read_points(write_bag(tmp_path, "bag", make))
    assert len(cloud) == 355
    np.testing.assert_allclose(np.linalg.norm(cloud.points - pose[:3, 3], axis=1), 3.0, atol=1e-5)
    angle = np.radians(-175)  # the first one that met something
    np.testing.assert_allclose(cloud.points[0], pose[:3, 3] + 3 * np.array([np.cos(angle), np.sin(angle), 0]), atol=1e-5)


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_a_map_is_that_of_map_server(tmp_path: Path, kind: str) -> None:
    """The newest grid of a topic gives the points of the same map saved as yaml and pgm."""
    write_plan(tmp_path / "plan.yaml")
    pixels = np.frombuffer((tmp_path / "plan.pgm").read_bytes()[-1200:], np.uint8).reshape(30, 40)
    cells = np.select([pixels == 0, pixels == 254], [100, 0], -1)[::-1]
    origin = np.eye(4)
    origin[:2, 3] = (-2, -1)

    def make(m: Messages) -> Iterable[Entry]:
        yield "/map", GRID, START, m.grid(np.zeros((3, 3)), 0.1, origin, START)
        yield "/map", GRID, START + 1, m.grid(cells, 0.1, origin, START + 1)

    cloud, expected = read_points(write_bag(tmp_path, kind, make)), read_points(tmp_path / "plan.yaml")
    np.testing.assert_allclose(cloud.points, expected.points, atol=1e-5)


def test_colors_and_parts(tmp_path: Path, walk: Walk) -> None:
    """A recording in two files of ROS 1, the first of them with colours."""
    colors = box_colors(len(walk.scans[0]))

    def color(entry: Entry, number: int) -> Entry:
        return entry if number > 2 or entry[0] != "/points" else (*entry[:3], first[0])

    first: list[Any] = []

    def make(m: Messages) -> Iterable[Entry]:
        first.append(m.cloud(walk.scans[0], walk.times[0], "lidar", colors))
        return changed(walk_messages(walk.part(1)), color)(m)

    write_bag(tmp_path / "a", "bag", make, "part_0")
    rest = Walk(walk.scans[1:], walk.poses[1:], walk.times[1:])
    write_bag(tmp_path / "a", "bag", walk_messages(rest), "part_1")
    cloud = read_points(tmp_path / "a")
    np.testing.assert_allclose(cloud.points[: len(colors)], walk.world[0], atol=1e-5)
    assert len(cloud) == sum(map(len, walk.scans)) and cloud.colors is not None
    np.testing.assert_array_equal(cloud.colors[: len(colors)], colors)


def nan_pose(entry: Entry, number: int) -> Entry:
    if entry[0] == "/tf" and number > 2:
        entry[3].transforms[0].transform.translation.x = float("nan")
    return entry


def no_turn(entry: Entry, _: int) -> Entry:
    if entry[0] == "/odom":
        entry[3].pose.pose.orientation.w = entry[3].pose.pose.orientation.z = 0.0
    return entry


def clock_back(topic: str) -> Callable[[Entry, int], Entry]:
    def change(entry: Entry, number: int) -> Entry:
        if entry[0] == topic and number > 4:
            header = entry[3].transforms[0].header if topic == "/tf" else entry[3].header
            header.stamp.sec -= 100
        return entry

    return change


def short_data(entry: Entry, number: int) -> Entry:
    if entry[0] == "/points" and number > 2:
        entry[3].data = entry[3].data[:-7]
    return entry


def other_names(entry: Entry, _: int) -> Entry:
    for field in entry[3].fields if entry[0] == "/points" else ():
        field.name = {"x": "range", "y": "azimuth", "z": "ring"}.get(field.name, field.name)
    return entry


def two_parents(m: Messages) -> Iterable[Entry]:
    for parent in ("odom", "map"):
        yield "/tf", TRANSFORMS, START, m.transforms([(parent, "lidar", np.eye(4))], START)


BAD = {
    "missing tf": (
        lambda w: without(walk_messages(w), "/tf"),
        r"nothing moves the frame 'lidar' of /points: tf says only lidar in base_link.*--poses",
    ),
    "no tf": (
        lambda w: walk_messages(w, "none"),
        r"it has no tf, and there is no odometry; give --poses .*the bag holds /points \(3 PointCloud2\)",
    ),
    "nan": (
        lambda w: changed(walk_messages(w), nan_pose),
        r"message 2 of /tf holds a pose that is not finite \(base_link in odom\)",
    ),
    "zero turn": (
        lambda w: changed(walk_messages(w, "odometry"), no_turn),
        r"message 1 of /odom holds a pose without a unit quaternion",
    ),
    "tf's clock": (lambda w: changed(walk_messages(w), clock_back("/tf")), r"message 3 of /tf sets the clock back by 99\.[89] s"),
    "scans' clock": (
        lambda w: changed(walk_messages(w), clock_back("/points")),
        r"message 3 of /points sets the clock back by 99\.[89] s",
    ),
    "two sensors": (
        lambda w: joined(walk_messages(w), walk_messages(w, "none", "/rear")),
        r"has several topics to read \(/points \(3 PointCloud2\), /rear \(3 PointCloud2\)\); give --topic",
    ),
    "short data": (
        lambda w: changed(walk_messages(w), short_data),
        r"message 2 of /points promises 1 x \d+ points of 16 bytes and has",
    ),
    "no coordinates": (
        lambda w: changed(walk_messages(w), other_names),
        r"message 1 of /points has the fields range azimuth ring intensity but not x y z",
    ),
    "nothing": (
        lambda w: without(walk_messages(w), "/points"),
        r"has no PointCloud2, depth images, LaserScan or OccupancyGrid; .*this holds /tf \(3 TFMessage\)",
    ),
    "two parents": (
        lambda w: joined(two_parents, walk_messages(w, "none")),
        r"puts the frame lidar into map, and others put it into odom",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_bags(tmp_path: Path, walk: Walk, name: str) -> None:
    make, says = BAD[name]
    path = write_bag(tmp_path, "bag" if name == "nan" else "mcap", make(walk))
    assert re.search(says, refusal_of(path)), refusal_of(path)
    assert refusal_of(path).startswith(f"{path}: ")


def test_bad_choices(tmp_path: Path, walk: Walk) -> None:
    both = joined(walk_messages(walk), walk_messages(walk, "none", "/rear"))
    path = write_bag(tmp_path, "mcap", both)
    assert_same(read_points(path, topic="points"), walk)
    assert_same(read_points(path, topic="/rear"), walk)
    says = refusal_of(path, topic="/front")
    assert "the topic /front is not in the bag; give --topic" in says and "/rear (3 PointCloud2), /tf (3 TFMessage)" in says
    assert "the topic /tf holds 3 TFMessage; give --topic with PointCloud2" in refusal_of(path, topic="/tf")
    few = str(write_kitti(tmp_path / "few.txt", walk.poses[:2]))
    assert f"{few}: has 2 poses without times, and /rear has 3 messages" in refusal_of(path, topic="/rear", poses=few)
    late = refusal_of(path, topic="/rear", poses=str(write_tum(tmp_path / "late.txt", walk.poses, walk.times + 60)))
    assert "none of the 3 messages of /rear has a pose at its time (poses: late.txt)" in late


def test_a_cut_bag_is_refused_by_the_process_that_reads(tmp_path: Path, walk: Walk) -> None:
    path = write_bag(tmp_path, "mcap", walk_messages(walk))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert refusal_of(path).startswith(f"{path}: ")


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_cut_bags(tmp_path: Path, walk: Walk, kind: str) -> None:
    data = write_bag(tmp_path, kind, walk_messages(walk)).read_bytes()
    path = tmp_path / f"cut.{kind}"
    for length in (20, len(data) // 2, len(data) - 40):
        path.write_bytes(data[:length])
        assert refusal_of(path).startswith(f"{path}: ")


@pytest.mark.longer
@pytest.mark.usefixtures("bags_here")
@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_damaged_bags(tmp_path: Path, walk: Walk, kind: str) -> None:
    """Points or one line, whatever is flipped."""
    data = write_bag(tmp_path, kind, walk_messages(walk.part(2))).read_bytes()
    path = tmp_path / f"damaged.{kind}"
    rng = np.random.default_rng(1)
    for attempt in range(40):
        broken = bytearray(data)
        for at in rng.integers(0, len(data) if attempt % 2 else 600, 1 + attempt % 4):
            broken[at] = int(rng.integers(256))
        path.write_bytes(bytes(broken))
        said = refused(path)
        assert said is None or (said.startswith(f"{path}: ") and "\n" not in said)
    for other in (b"hello\n" * 50, bytes(range(256)) * 8):
        path.write_bytes(other)
        assert refusal_of(path).startswith(f"{path}: ")


def test_bags_need_their_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    monkeypatch.setitem(sys.modules, "rosbags", None)
    assert "reading a ROS bag needs rosbags: pip install topomerge[ros]" in refusal_of(tmp_path / "a.bag")
