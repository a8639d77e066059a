"""What ROS bags hold beside points: signs and tags on pictures, detections, radio and pressure."""

from __future__ import annotations

from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.io.bags import MOUNT, Entry, Messages, walk_messages, write_bag
from tests.io.rgbd import CAMERA, SHAPE, looking
from tests.io.signs import SIGNS, SIZE, TAG_SIGNS, poses_before_signs, take_picture, walk_poses
from tests.io.test_read_signs import assert_hang
from tests.io.walks import START, Walk, room_walk
from topomerge.io import bag_landmarks, read_points
from topomerge.io.bag_file import TRANSFORMS, Message
from topomerge.io.bag_landmarks import (
    LandmarkReader,
    build_pose,
    decode_picture,
    find_radio_readings,
    read_hypothesis,
    read_tag_name,
    render_depth,
)
from topomerge.io.depth_images import Camera
from topomerge.io.piece import ReadOptions

pytest.importorskip("rosbags")
TAG_TYPES = """std_msgs/Header header
apriltag_msgs/AprilTagDetection[] detections
===
MSG: apriltag_msgs/AprilTagDetection
string family
int32 id
int32 hamming
float32 goodness
float32 decision_margin
apriltag_msgs/Point centre
apriltag_msgs/Point[4] corners
float64[9] homography
===
MSG: apriltag_msgs/Point
float64 x
float64 y
"""
WIFI_TYPES = """std_msgs/Header header
wifi_scan/AccessPoint[] access_points
===
MSG: wifi_scan/AccessPoint
string ssid
string bssid
uint16 channel
int32 rssi
"""
BLE_TYPES = """std_msgs/Header header
string mac_address
std_msgs/Float32 strength
"""
OBJECT_TYPES = """std_msgs/Header header
vision_msgs/Detection3D[] detections
===
MSG: vision_msgs/Detection3D
std_msgs/Header header
vision_msgs/ObjectHypothesisWithPose[] results
vision_msgs/BoundingBox3D bbox
string id
===
MSG: vision_msgs/ObjectHypothesisWithPose
vision_msgs/ObjectHypothesis hypothesis
geometry_msgs/PoseWithCovariance pose
===
MSG: vision_msgs/ObjectHypothesis
string class_id
float64 score
===
MSG: vision_msgs/BoundingBox3D
geometry_msgs/Pose center
geometry_msgs/Vector3 size
"""


def learn(m: Messages, name: str, text: str) -> None:
    """Make a type known to the writer of a bag."""
    from rosbags.typesys import get_types_from_msg

    text = text.replace("===", "=" * 80)
    types = get_types_from_msg(text, name)
    m.store.register({k: v for k, v in types.items() if k not in m.store.fielddefs})


def make(m: Messages, kind: str, **values: Any) -> Any:
    return m.store.types[kind](**values)


def pose_message(m: Messages, pose: np.ndarray) -> Any:
    return make(m, "geometry_msgs/msg/Pose", position=m.place(pose), orientation=m.turn(pose))


def corridor_messages(poses: np.ndarray, depth: str, packed: bool) -> Any:
    """A camera in the corridor of signs; what it shows is as deep as depth images or a laser say."""

    def messages(m: Messages) -> Iterable[Entry]:
        lidar = np.eye(4)
        lidar[:3, 3] = (0, 0.2, 0)
        yield "/tf_static", TRANSFORMS, START, m.transforms([("optical", "lidar", lidar)], START)
        for number, pose in enumerate(poses):
            time = START + number
            image, metres = take_picture(pose)
            yield "/tf", TRANSFORMS, time, m.transforms([("map", "optical", pose)], time)
            yield "/color/camera_info", "sensor_msgs/msg/CameraInfo", time, m.camera(CAMERA, SHAPE, time, "optical")
            if packed:
                stream = BytesIO()
                Image.fromarray(image).save(stream, "JPEG", quality=95)
                data = np.frombuffer(stream.getvalue(), np.uint8)
                kind, header = "sensor_msgs/msg/CompressedImage", m.header(time, "optical")
                yield (
                    "/color/image/compressed",
                    kind,
                    time,
                    make(m, kind, header=header, format="rgb8; jpeg compressed bgr8", data=data),
                )
            else:
                yield "/color/image", "sensor_msgs/msg/Image", time, m.image(image[..., ::-1], time, "optical", "bgr8")
            if depth == "images":
                yield "/depth/camera_info", "sensor_msgs/msg/CameraInfo", time, m.camera(CAMERA, SHAPE, time, "optical")
                millimetres = np.rint(metres * 1000).astype(np.uint16)
                yield "/depth/image", "sensor_msgs/msg/Image", time, m.image(millimetres, time, "optical")
                continue
            rows, columns = (v.ravel() for v in np.mgrid[0 : SHAPE[0] : 9, 0 : SHAPE[1] : 9])
            rays = np.stack(
                [(columns - CAMERA[0, 2]) / CAMERA[0, 0], (rows - CAMERA[1, 2]) / CAMERA[1, 1], np.ones(len(rows))], axis=1
            )
            points = rays * metres[rows, columns][:, None] - lidar[:3, 3]
            yield "/points", "sensor_msgs/msg/PointCloud2", time, m.cloud(points.astype(np.float32), time, "lidar")

    return messages


@pytest.mark.longer
@pytest.mark.parametrize(("kind", "depth", "packed"), [("bag", "images", False), ("mcap", "laser", True)])
def test_signs_and_tags_on_pictures(tmp_path: Path, kind: str, depth: str, packed: bool) -> None:
    """As deep as the points of the bag say, whatever took them."""
    pytest.importorskip("rapidocr_onnxruntime", exc_type=ImportError)
    pytest.importorskip("pupil_apriltags", exc_type=ImportError)
    path = write_bag(tmp_path, kind, corridor_messages(poses_before_signs(), depth, packed))
    assert_hang(read_points(path).landmarks, SIGNS + TAG_SIGNS, reach=0.12)
    assert read_points(path, text=False).landmarks is None


def test_pictures_without_a_camera_are_told(tmp_path: Path) -> None:
    walk = room_walk()

    def messages(m: Messages) -> Iterable[Entry]:
        yield from walk_messages(walk)(m)
        yield "/eye", "sensor_msgs/msg/Image", START, m.image(np.zeros((300, 300, 3), np.uint8), START, "eye", "rgb8")

    cloud = read_points(write_bag(tmp_path, "mcap", messages))
    assert "the pictures of /eye have no CameraInfo that fits, and are not read" in cloud.warnings


def tag_message(m: Messages, time: float, number: int, corners: np.ndarray | None = None, hamming: int = 0) -> Any:
    learn(m, "apriltag_msgs/msg/AprilTagDetectionArray", TAG_TYPES)
    corners = np.zeros((4, 2)) if corners is None else corners
    points = [make(m, "apriltag_msgs/msg/Point", x=float(x), y=float(y)) for x, y in (corners.mean(axis=0), *corners)]
    known = {"family": "tag36h11", "id": number, "hamming": hamming, "goodness": 0.0, "decision_margin": 5.0}
    places = {"centre": points[0], "corners": points[1:], "homography": np.zeros(9)}
    found = make(m, "apriltag_msgs/msg/AprilTagDetection", **known, **places)
    header = m.header(time, "camera")
    return make(m, "apriltag_msgs/msg/AprilTagDetectionArray", header=header, detections=[found])


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_detected_tags_where_tf_puts_them(tmp_path: Path, kind: str) -> None:
    walk = room_walk()
    tag = looking(1.0, (3.5, 1.0, 1.5))
    camera = np.linalg.inv(MOUNT)  # on the robot: at the origin of the LiDAR's robot

    def messages(m: Messages) -> Iterable[Entry]:
        yield from walk_messages(walk)(m)
        yield "/tf_static", TRANSFORMS, START, m.transforms([("base_link", "camera", camera)], START)
        robot = walk.poses @ np.linalg.inv(MOUNT)
        name = "apriltag_msgs/msg/AprilTagDetectionArray"
        for number, time in enumerate(walk.times.tolist()):
            seen = np.linalg.inv(robot[number] @ camera) @ tag
            yield "/tf", TRANSFORMS, time, m.transforms([("camera", "tag36h11:4", seen)], time)
            yield "/tags", name, time, tag_message(m, time, 4)
            yield "/tags", name, time, tag_message(m, time, 9, hamming=2)  # not sure
            yield "/tags", name, time, tag_message(m, time, 8)  # nobody says where

    found = read_points(write_bag(tmp_path, kind, messages)).landmarks
    assert found is not None and found.get_values().tolist() == ["tag36h11:4"] and found.sources == ("bag",)
    assert found.table["position"][0] == pytest.approx(tag[:3, 3], abs=0.02)


def test_detected_tags_by_their_corners(tmp_path: Path) -> None:
    """Where tf says nothing, the points of the bag do."""
    pose = walk_poses()[4]
    place = np.array([6.0, SIZE[1], 1.4])
    square = place + np.array([(-0.15, 0, -0.15), (0.15, 0, -0.15), (0.15, 0, 0.15), (-0.15, 0, 0.15)])
    local = (square - pose[:3, 3]) @ pose[:3, :3]
    corners = local[:, :2] / local[:, 2:] * np.diag(CAMERA)[:2] + CAMERA[:2, 2]

    def messages(m: Messages) -> Iterable[Entry]:
        yield from corridor_messages(np.stack([pose] * 3), "laser", True)(m)
        for k in range(3):
            message = tag_message(m, START + k, 12, corners)
            message.header.frame_id = "optical"
            yield "/tags", "apriltag_msgs/msg/AprilTagDetectionArray", START + k, message

    found = read_points(write_bag(tmp_path, "mcap", messages), text=False).landmarks
    assert found is not None and found.get_values().tolist() == ["tag36h11:12"]
    assert found.table["position"][0] == pytest.approx(place, abs=0.05)
    assert found.table["number"][0] == pytest.approx(-np.pi / 2, abs=0.1)


def readings_messages(walk: Walk) -> Any:
    """WiFi, BLE and pressure on a walk."""

    def messages(m: Messages) -> Iterable[Entry]:
        yield from walk_messages(walk)(m)
        learn(m, "wifi_scan/msg/Scan", WIFI_TYPES)
        learn(m, "ble/msg/Beacon", BLE_TYPES)
        for k, time in enumerate(walk.times.tolist()):
            header = m.header(time, "")
            heard = [("AA:BB:CC:DD:EE:01", -40 - k), ("AA:BB:CC:DD:EE:02", -80), ("AA:BB:CC:DD:EE:03", 127), ("", -50)]
            points = [make(m, "wifi_scan/msg/AccessPoint", ssid="", bssid=b, channel=6, rssi=r) for b, r in heard]
            yield "/wifi", "wifi_scan/msg/Scan", time, make(m, "wifi_scan/msg/Scan", header=header, access_points=points)
            strength = make(m, "std_msgs/msg/Float32", data=-71.5)
            beacon = make(m, "ble/msg/Beacon", header=header, mac_address="c0:ff:ee:00:00:01", strength=strength)
            yield "/ble", "ble/msg/Beacon", time, beacon
            for value in (101_325.0 - k, np.nan, -5.0):
                pressure = make(m, "sensor_msgs/msg/FluidPressure", header=header, fluid_pressure=value, variance=0.0)
                yield "/pressure", "sensor_msgs/msg/FluidPressure", time, pressure

    return messages


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_radio_and_pressure_along_the_walk(tmp_path: Path, kind: str) -> None:
    """Of messages that name sender and strength in a usual way, whatever their type; where the sensor was."""
    walk = room_walk()
    found = read_points(write_bag(tmp_path, kind, readings_messages(walk))).landmarks
    assert found is not None
    radio, pressure = (found.select(found.is_kind(k)) for k in ("radio", "pressure"))
    first = radio.get_values() == "aa:bb:cc:dd:ee:01"
    assert radio.table["number"][first].tolist() == [-40.0, -41.0, -42.0]
    assert radio.table["position"][first] == pytest.approx(walk.poses[:, :3, 3], abs=0.02)
    assert set(radio.get_values()) == {"aa:bb:cc:dd:ee:01", "aa:bb:cc:dd:ee:02", "c0:ff:ee:00:00:01"}
    assert radio.table["group"][first].tolist() == radio.table["group"][radio.get_values() == "aa:bb:cc:dd:ee:02"].tolist()
    assert len(set(radio.table["group"].tolist())) == 6 and radio.table["time"][first] == pytest.approx(walk.times)
    assert pressure.table["number"] == pytest.approx([1013.25, 1013.24, 1013.23])


def test_many_readings_are_thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag_landmarks, "MOST_READINGS", 100)

    class NoBag:
        path, topics = Path("a.bag"), {}  # type: ignore[var-annotated]

    reader = LandmarkReader(NoBag(), lambda frame, time: np.eye(4), "lidar", None, ReadOptions(text=False))  # type: ignore[arg-type]
    for k in range(10_000):
        reader._add_reading("radio", "a", -50.0, Message("/wifi", k, float(k), None))
    kept = reader._collect_readings("radio")
    assert 50 <= len(kept) <= 100 and np.ptp(kept.table["time"]) > 9000


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_objects_of_detections(tmp_path: Path, kind: str) -> None:
    walk = room_walk()
    chair = np.array([3.0, 1.2, 0.4])

    def messages(m: Messages) -> Iterable[Entry]:
        yield from walk_messages(walk)(m)
        learn(m, "vision_msgs/msg/Detection3DArray", OBJECT_TYPES)
        empty = make(m, "geometry_msgs/msg/PoseWithCovariance", pose=pose_message(m, np.eye(4)), covariance=np.zeros(36))
        size = make(m, "geometry_msgs/msg/Vector3", x=0.5, y=0.5, z=0.8)
        for k, time in enumerate(walk.times.tolist()):
            box = np.eye(4)
            box[:3, 3] = np.linalg.inv(walk.poses[k])[:3, :3] @ (chair - walk.poses[k][:3, 3]) + 0.03 * k
            hypotheses = [
                make(m, "vision_msgs/msg/ObjectHypothesis", class_id=c, score=s) for c, s in (("sofa", 0.2), ("chair\n", 0.9))
            ]
            results = [make(m, "vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=h, pose=empty) for h in hypotheses]
            bbox = make(m, "vision_msgs/msg/BoundingBox3D", center=pose_message(m, box), size=size)
            header = m.header(time, "lidar")
            found = [make(m, "vision_msgs/msg/Detection3D", header=header, results=r, bbox=bbox, id="") for r in (results, [])]
            name = "vision_msgs/msg/Detection3DArray"
            yield "/objects", name, time, make(m, name, header=header, detections=found)

    found = read_points(write_bag(tmp_path, kind, messages)).landmarks
    assert found is not None and found.get_values().tolist() == ["chair"] and found.is_kind("object").all()
    assert found.table["position"][0] == pytest.approx(chair, abs=0.1)
    assert found.table["confidence"][0] == pytest.approx(0.9)


def test_definitions_of_strangers(tmp_path: Path) -> None:
    """A type whose definition can't be used, or that only looks like radio, is passed over."""
    walk = room_walk()

    def messages(m: Messages) -> Iterable[Entry]:
        yield from walk_messages(walk)(m)
        learn(m, "odd/msg/Level", "string address\nfloat32 level\n")
        level = make(m, "odd/msg/Level", address="10.0.0.1", level=3.0)
        yield "/water", "odd/msg/Level", START, level

    path = write_bag(tmp_path, "mcap", messages)
    cloud = read_points(path)
    assert cloud.landmarks is None and len(cloud) > 1000
    data = path.read_bytes()
    path.write_bytes(
        data.replace(
            b"string address\nfloat32 level", b"string address\nfloat32[] $level"[: len("string address\nfloat32 level")]
        )
    )
    assert len(read_points(path)) == len(cloud)


def test_messages_that_are_damaged_end_it_with_a_line(tmp_path: Path) -> None:
    """The points are there all the same."""
    walk = room_walk()

    def messages(m: Messages) -> Iterable[Entry]:
        yield from walk_messages(walk)(m)
        yield "/eye/camera_info", "sensor_msgs/msg/CameraInfo", START, m.camera(CAMERA, SHAPE, START, "lidar")
        kind = "sensor_msgs/msg/CompressedImage"
        data = np.frombuffer(b"\xff\xd8\xff no picture at all", np.uint8)
        yield "/eye/image/compressed", kind, START, make(m, kind, header=m.header(START, "lidar"), format="jpeg", data=data)

    cloud = read_points(write_bag(tmp_path, "mcap", messages))
    assert len(cloud) > 1000 and cloud.landmarks is None
    assert any("not all landmarks are read" in line and "\n" not in line for line in cloud.warnings)


class Body:
    """Stands for a message."""

    def __init__(self, **values: Any) -> None:
        self.__dict__.update(values)
        self.__dataclass_fields__ = dict.fromkeys(values)


def test_pictures_of_all_encodings() -> None:
    pixels = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    for encoding, values in (("rgb8", pixels), ("bgr8", pixels[..., ::-1]), ("mono8", pixels[..., :1])):
        rows = values.reshape(4, -1)
        body = Body(encoding=encoding, height=4, width=6, step=rows.shape[1], data=rows.ravel())
        out = decode_picture(Message("/a", 1, 0.0, body), "a")
        assert out is not None and np.array_equal(out, pixels if values.shape[2] == 3 else np.repeat(values, 3, axis=2))
        for wrong in ({"height": 5}, {"step": 2}, {"width": 0}, {"encoding": "16UC1"}, {"data": rows.ravel()[:5]}):
            assert decode_picture(Message("/a", 1, 0.0, Body(**{**vars(body), **wrong})), "a") is None


def test_poses_tags_and_classes_that_are_none() -> None:
    place, turn = Body(x=1.0, y=2.0, z=3.0), Body(x=0.0, y=0.0, z=0.0, w=0.0)
    pose = build_pose(Body(position=place, orientation=turn))  # many detectors leave the turn at zeros
    assert pose is not None and pose[:3, 3].tolist() == [1, 2, 3] and np.array_equal(pose[:3, :3], np.eye(3))
    assert build_pose(Body(position=Body(x=np.nan, y=0.0, z=0.0), orientation=turn)) is None
    assert read_tag_name(Body(id=np.array([3]), size=[0.1]))[0] == "tag36h11:3" and read_tag_name(Body(id=[]))[0] == ""
    assert read_hypothesis(Body(id=5, score=0.4)) == ("5", 0.4) and read_hypothesis(Body(id="a", score=np.nan)) == ("a", 0.0)
    deep: Any = Body(mac="a", rssi=-50)
    for _ in range(10):
        deep = Body(parts=[deep])
    assert list(find_radio_readings(deep)) == [] and list(find_radio_readings(Body(parts=[Body(mac="A", rssi=-50)]))) == [
        ("a", -50.0)
    ]
    assert list(find_radio_readings(Body(bssid="b", rssi="loud"))) == []


def test_depth_of_points_hides_what_is_behind() -> None:
    """A wall at 2 m in front of one at 4 m, both thinner than the picture's pixels."""
    x, z = (v.ravel() for v in np.meshgrid(np.arange(-2, 2, 0.05), np.arange(0, 2.5, 0.05)))
    walls = np.concatenate([np.stack([x, np.full(len(x), y), z], axis=1) for y in (2.0, 4.0)])
    depth, camera = render_depth(walls, Camera((525, 525), (320, 240), 1.0), looking(np.pi / 2, (0, 0, 1.2)), (480, 640))
    assert depth.shape == (48, 64) and depth[20:28, 28:36] == pytest.approx(2.0, abs=0.01)
    assert camera.focal == (52.5, 52.5)
    empty, _ = render_depth(np.zeros((0, 3)), Camera((525, 525), (320, 240), 1.0), np.eye(4), (480, 640))
    assert not empty.any()
