"""Depth images in bags: the same cloud as from files, and what can be wrong."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")

from tests.io.bags import Entry, Messages, write_bag
from tests.io.rgbd import CAMERA, SHAPE, camera_poses, depth_image, write_tum_images
from tests.io.rtabmap_bases import OPTICAL, png
from tests.io.test_read_bags import Make, changed, joined, without
from tests.io.test_read_folders import refusal_of
from tests.io.walks import START, write_tum
from topomerge.io import read_points
from topomerge.io.bag_file import TRANSFORMS
from topomerge.types import PointCloud

IMAGE, PACKED, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
TOPIC, INFO_TOPIC = "/camera/depth/image_raw", "/camera/depth/camera_info"
FRAME = "camera_optical"


def image_messages(form: str = "16UC1", rectified: bool = True, poses: bool = True, order: str = "<", topic: str = TOPIC) -> Make:
    """What a robot with a camera of depth records in the room, its colours beside."""

    def make(m: Messages) -> Iterable[Entry]:
        for number, pose in enumerate(camera_poses()):
            time = START + number
            if poses:
                robot = pose @ np.linalg.inv(OPTICAL)
                yield "/tf", TRANSFORMS, time, m.transforms([("odom", "base", robot), ("base", FRAME, OPTICAL)], time)
            depth = depth_image(pose, 1000.0)
            yield INFO_TOPIC, INFO, time, m.camera(CAMERA, SHAPE, time, FRAME, rectified)
            yield "/camera/color/image_raw", IMAGE, time, m.image(np.zeros((*SHAPE, 3), np.uint8), time, FRAME, "rgb8")
            if form == "packed":
                yield f"{topic}/compressedDepth", PACKED, time, m.packed_image(png(depth), time, FRAME)
            elif form == "32FC1":
                values = np.where(depth == 0, np.nan, depth / np.float32(1000)).astype(np.float32)
                yield topic, IMAGE, time, m.image(values, time, FRAME, form, order)
            else:
                yield topic, IMAGE, time, m.image(depth, time, FRAME, form, order)

    return make


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> PointCloud:
    """The same images as files."""
    return read_points(write_tum_images(tmp_path_factory.mktemp("tum") / "room", camera_poses(), 1000.0))


def assert_the_room(cloud: PointCloud, expected: PointCloud) -> None:
    np.testing.assert_allclose(cloud.points, expected.points, atol=1e-5)
    assert cloud.poses is not None and cloud.warnings == ()
    np.testing.assert_allclose(cloud.poses, camera_poses(), atol=1e-6)


@pytest.mark.longer
@pytest.mark.parametrize("kind", ["bag", "mcap"])
@pytest.mark.parametrize("form", ["16UC1", "32FC1", "packed"])
def test_the_same_cloud_as_from_files(tmp_path: Path, expected: PointCloud, kind: str, form: str) -> None:
    assert_the_room(read_points(write_bag(tmp_path, kind, image_messages(form))), expected)


@pytest.mark.longer
def test_either_order_of_bytes_and_cameras_without_rectification(tmp_path: Path, expected: PointCloud) -> None:
    for number, (form, order) in enumerate((("16UC1", ">"), ("32FC1", ">"))):
        path = write_bag(tmp_path / str(number), "mcap", image_messages(form, rectified=False, order=order))
        assert_the_room(read_points(path), expected)


def test_a_trajectory_places_the_images(tmp_path: Path, expected: PointCloud) -> None:
    path = write_bag(tmp_path, "mcap", image_messages(poses=False))
    poses = write_tum(tmp_path / "a.txt", camera_poses(), START + np.arange(3))
    assert_the_room(read_points(path, poses=str(poses)), expected)
    assert "nothing moves the frame 'camera_optical' of /camera/depth/image_raw" in refusal_of(path)


@pytest.mark.longer
def test_which_topic_is_read(tmp_path: Path, expected: PointCloud) -> None:
    """Plain images before packed ones, points before images, images before slices; of two cameras one has to be named."""
    both = joined(image_messages(), without(image_messages("packed"), "/tf", INFO_TOPIC, "/camera/color/image_raw"))
    assert_the_room(read_points(write_bag(tmp_path / "both", "mcap", both)), expected)

    def laser(m: Messages) -> Iterable[Entry]:
        yield "/scan", "sensor_msgs/msg/LaserScan", START, m.laser(np.ones(90), START, "base")

    assert_the_room(read_points(write_bag(tmp_path / "laser", "mcap", joined(image_messages(), laser))), expected)

    def points(m: Messages) -> Iterable[Entry]:
        yield "/points", "sensor_msgs/msg/PointCloud2", START, m.cloud(np.ones((50, 3)), START, "base")

    path = write_bag(tmp_path / "points", "mcap", joined(image_messages(), points))
    assert len(read_points(path)) == 50
    assert_the_room(read_points(path, topic=TOPIC), expected)
    second = without(image_messages(topic="/rear/depth"), "/tf", INFO_TOPIC, "/camera/color/image_raw")
    path = write_bag(tmp_path / "two", "mcap", joined(image_messages(), second))
    said = refusal_of(path)
    assert "has several topics to read (/camera/depth/image_raw (3 Image), /rear/depth (3 Image)); give --topic" in said
    assert_the_room(read_points(path, topic="/rear/depth"), expected)  # by the only CameraInfo of its frame


def refusal_with(folder: Path, change: object, form: str = "16UC1", topic: str = TOPIC, number: int = 1) -> str:
    """What is said when a message (counted from 0) of a topic has other values."""
    seen = [0]

    def with_change(entry: Entry, _: int) -> Entry:
        if entry[0] == topic:
            if seen[0] == number:
                change(entry[3])  # type: ignore[operator]
            seen[0] += 1
        return entry

    return refusal_of(write_bag(folder, "mcap", changed(image_messages(form), with_change)))


def values(**new: object) -> object:
    return lambda message: message.__dict__.update(new)


@pytest.mark.longer
def test_bad_images(tmp_path: Path) -> None:
    named = "message 2 of /camera/depth/image_raw "
    for number, (change, says) in enumerate(
        (
            (values(encoding="rgb8"), "has the encoding 'rgb8', which is no depth (16UC1 or 32FC1)"),
            (values(data=np.zeros(100, np.uint8)), "promises 640 x 480 pixels and has 100 bytes"),
            (values(width=10_000), "promises 10000 x 480 pixels"),
            (values(step=3), "promises 640 x 480 pixels"),
        )
    ):
        assert named + says in refusal_with(tmp_path / str(number), change)
    smaller = values(width=320)
    said = refusal_with(tmp_path / "small", smaller)
    assert "message 2 of /camera/depth/image_raw: has 320 x 480 pixels, its camera 640 x 480" in said
    assert "camera/depth/camera_info states the camera" in said
    assert f"{named}promises 0 x 0 pixels" in refusal_with(tmp_path / "none", values(height=0, width=0))
    packed = f"{TOPIC}/compressedDepth"
    named = f"message 2 of {packed}"
    for name, change, says in (
        (
            "rvl",
            values(format="16UC1; compressedDepth rvl"),
            " is packed as '16UC1; compressedDepth rvl'; only 16UC1 as PNG is read",
        ),
        ("floats", values(format="32FC1; compressedDepth png"), " is packed as '32FC1; compressedDepth png'"),
        ("cut", values(data=np.zeros(50, np.uint8)), ": damaged"),
    ):
        assert named + says in refusal_with(tmp_path / name, change, "packed", packed)


@pytest.mark.longer
def test_bad_clocks_and_cameras(tmp_path: Path) -> None:
    def back(message: object) -> None:
        message.header.stamp.sec -= 60  # type: ignore[attr-defined]

    assert "message 2 of /camera/depth/image_raw sets the clock back by 59.0 s" in refusal_with(tmp_path / "clock", back)
    nothing = values(k=np.zeros(9), p=np.zeros(12))
    said = refusal_with(tmp_path / "zero", nothing, topic=INFO_TOPIC, number=0)
    assert f"message 1 of {INFO_TOPIC} states no camera (its K and P are zero)" in said
    wrong = values(p=(np.diag([2.0, 2, 1]) @ CAMERA[:3]).ravel())
    said = refusal_with(tmp_path / "wrong", wrong, topic=INFO_TOPIC, number=0)
    assert f"message 1 of {TOPIC}: has 640 x 480 pixels, and a camera of focal lengths 1050 1050" in said
    path = write_bag(tmp_path / "none", "mcap", without(image_messages(), INFO_TOPIC))
    assert f"has no CameraInfo beside {TOPIC}, and 0 of its frame 'camera_optical'" in refusal_of(path)
    path = write_bag(tmp_path / "colors", "mcap", without(image_messages(), TOPIC))
    assert "has no PointCloud2, depth images, LaserScan or OccupancyGrid" in refusal_of(path)
    assert "message 1 of /camera/color/image_raw has the encoding 'rgb8'" in refusal_of(path, topic="/camera/color/image_raw")
