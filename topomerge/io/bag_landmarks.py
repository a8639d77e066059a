"""Read landmarks of a ROS bag: signs and tags on its pictures, detections, radio and pressure along its trajectory."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from scipy.ndimage import minimum_filter, rank_filter

from topomerge.errors import InputError
from topomerge.io.bag_file import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, Bag, Message, Topic, get_time
from topomerge.io.depth_images import Camera, PosedScan, read_color
from topomerge.io.pictures import LEAST_TAG_MARGIN, Picture, PictureReader, place_box
from topomerge.io.piece import Piece, ReadOptions
from topomerge.io.sightings import MOST_SIGHTINGS, Sighting, clean_text, compute_heading, fuse_sightings
from topomerge.io.trajectory import build_pose_matrices
from topomerge.types import Array, Landmarks, build_landmarks, join_landmarks

PICTURES = {
    "rgb8": (3, False),
    "bgr8": (3, True),
    "rgba8": (4, False),
    "bgra8": (4, True),
    "mono8": (1, False),
}  # values, blue first
PACKED = "/compressed"  # how the name of a packed topic ends
PRESSURE = "sensor_msgs/msg/FluidPressure"
TAGS = ("apriltag_msgs/msg/AprilTagDetectionArray", "apriltag_ros/msg/AprilTagDetectionArray")
OBJECTS = "vision_msgs/msg/Detection3DArray"
# Names under which messages of many packages state a sender and its strength.
ADDRESSES = ("bssid", "mac", "mac_address", "address", "addr", "hwaddr", "uuid", "ssid", "essid")
STRENGTHS = ("rssi", "level", "signal", "signal_level", "signal_strength", "strength", "dbm", "db", "rss")
RADIO_FIELDS = re.compile(rf"(?im)^\s*\S+\s+({'|'.join(ADDRESSES)})\b"), re.compile(rf"(?im)^\s*\S+\s+({'|'.join(STRENGTHS)})\b")
WEAKEST, STRONGEST = -127.0, -1.0  # dBm; 127 stands for none
LOWEST_PRESSURE, HIGHEST_PRESSURE = 300.0, 1200.0  # hPa
MOST_READINGS = 300_000  # of radio and of pressure each; beyond, every second one goes
READING_SIGMA, TAG_SIGMA, OBJECT_SIGMA = 0.5, 0.1, 0.15  # m
CLOUD_CELL = 0.05  # m, between points that say how deep a picture is
MOST_CLOUD_POINTS = 3_000_000
PICTURE_REACH = 10.0  # m
DEPTH_COLUMNS = 64  # of the image of depth that points become
MESSAGES_A_PIECE = 2000
# Of types that bags may hold without their definitions, as of ROS 2 Humble.
DEFINITIONS = {
    TAGS[0]: """std_msgs/Header header
apriltag_msgs/AprilTagDetection[] detections
================================================================================
MSG: apriltag_msgs/AprilTagDetection
string family
int32 id
int32 hamming
float32 goodness
float32 decision_margin
apriltag_msgs/Point centre
apriltag_msgs/Point[4] corners
float64[9] homography
================================================================================
MSG: apriltag_msgs/Point
float64 x
float64 y
""",
    OBJECTS: """std_msgs/Header header
vision_msgs/Detection3D[] detections
================================================================================
MSG: vision_msgs/Detection3D
std_msgs/Header header
vision_msgs/ObjectHypothesisWithPose[] results
vision_msgs/BoundingBox3D bbox
string id
================================================================================
MSG: vision_msgs/ObjectHypothesisWithPose
vision_msgs/ObjectHypothesis hypothesis
geometry_msgs/PoseWithCovariance pose
================================================================================
MSG: vision_msgs/ObjectHypothesis
string class_id
float64 score
================================================================================
MSG: vision_msgs/BoundingBox3D
geometry_msgs/Pose center
geometry_msgs/Vector3 size
""",
}
Locate = Callable[[str, float], Array | None]  # frame, time -> pose (4, 4) in the fixed frame
CameraOf = Callable[[Bag, Topic], Camera]
Decoders = dict[str, tuple[Topic, Callable[[Message], None]]]


class CloudSample:
    """Thins the points of a bag in the fixed frame, to tell how far away is what its pictures show."""

    def __init__(self) -> None:
        self._parts: list[Array] = []
        self._held = 0

    def watch(self, scans: Iterable[PosedScan]) -> Iterator[PosedScan]:
        """Pass scans on, and keep some of their points."""
        for scan in scans:
            if self._held < MOST_CLOUD_POINTS:
                self._add(scan)
            yield scan

    def _add(self, scan: PosedScan) -> None:
        points = np.asarray(scan.points, np.float64)
        points = _drop_wild(points)
        if scan.pose is not None and not scan.registered:
            points = _drop_wild(points @ scan.pose[:3, :3].T + scan.pose[:3, 3])  # a damaged pose is wild, too
        self._parts.append(_thin(points))
        self._held += len(self._parts[-1])
        if len(self._parts) > 200:
            self._parts = [_thin(np.concatenate(self._parts))]
            self._held = len(self._parts[0])

    def get_points(self) -> Array:
        """Return (n, 3) m."""
        self._parts = [_thin(np.concatenate(self._parts))] if self._parts else [np.zeros((0, 3))]
        return self._parts[0]


def _drop_wild(points: Array) -> Array:
    return points[np.isfinite(points).all(axis=1) & (np.abs(points).max(axis=1, initial=0) < 1e6)]


def _thin(points: Array) -> Array:
    cells = np.floor(points / CLOUD_CELL).astype(np.int64)
    codes = (cells[:, 0] << 42) ^ ((cells[:, 1] & 0x1FFFFF) << 21) ^ (cells[:, 2] & 0x1FFFFF)
    return points[np.unique(codes, return_index=True)[1]]


def render_depth(points: Array, camera: Camera, pose: Array, shape: tuple[int, ...]) -> tuple[Array, Camera]:
    """Render how far away points (n, 3) are in a picture of a shape (h, w), as a small image of depth, m, and its camera."""
    near = points[np.abs(points - pose[:3, 3]).max(axis=1, initial=0) <= PICTURE_REACH]
    local = (near - pose[:3, 3]) @ pose[:3, :3]
    local = local[local[:, 2] > 0.1]
    factor = shape[1] / DEPTH_COLUMNS
    small = Camera(
        (camera.focal[0] / factor, camera.focal[1] / factor), (camera.centre[0] / factor, camera.centre[1] / factor), 1.0
    )
    depth = np.full((max(round(shape[0] / factor), 1), DEPTH_COLUMNS), np.inf)
    columns, rows = (np.floor(local[:, k] / local[:, 2] * small.focal[k] + small.centre[k]).astype(np.int64) for k in (0, 1))
    inside = (columns >= 0) & (columns < depth.shape[1]) & (rows >= 0) & (rows < depth.shape[0])
    np.minimum.at(depth, (rows[inside], columns[inside]), local[inside, 2])
    near = np.minimum(depth, rank_filter(depth, 3, 3, mode="nearest"))  # of gaps in a wall, the wall and not what is behind it
    filled = np.where(np.isfinite(near), near, minimum_filter(depth, 3, mode="nearest"))
    return np.where(np.isfinite(filled), filled, 0), small


def find_picture_topics(bag: Bag) -> list[Topic]:
    """Find the topics whose first message is a picture; packed ones only where the plain ones were not recorded."""

    def read_first(topic: Topic) -> Any:
        return next(bag.iter_messages([topic])).content

    plain = [t for t in bag.find_topics(IMAGE) if read_first(t).encoding in PICTURES]
    names = {t.name for t in plain}
    packed = [
        t
        for t in bag.find_topics(COMPRESSED_IMAGE)
        if re.search(r"(?i)jpe?g|png", kind := read_first(t).format) and "epth" not in kind
    ]
    return plain + [t for t in packed if t.name.removesuffix(PACKED) not in names]


def decode_picture(message: Message, name: str) -> Array | None:
    """Decode (h, w, 3) uint8 of an Image or CompressedImage; None: it is no picture of 8 bits, or is cut short.

    Args:
        message: of it.
        name: for messages.
    """
    image = message.content
    if hasattr(image, "format"):
        return read_color(bytes(image.data), name)
    values, blue_first = PICTURES.get(str(image.encoding), (0, False))
    height, width, step = int(image.height), int(image.width), int(image.step)
    if not values or not 0 < width * values <= step or not 0 < height * step <= len(image.data):
        return None
    rows = np.frombuffer(image.data, np.uint8, height * step).reshape(height, step)[:, : width * values]
    pixels = rows.reshape(height, width, values)[..., :3]
    return np.ascontiguousarray(np.repeat(pixels, 3, axis=2) if values == 1 else pixels[..., ::-1] if blue_first else pixels)


def build_pose(pose: Any) -> Array | None:
    """Build (4, 4) of a geometry_msgs Pose; None: it is none."""
    place, turn = pose.position, pose.orientation
    numbers = np.array([place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w], float)
    if not np.isfinite(numbers).all():
        return None
    quaternion = numbers[3:] if np.linalg.norm(numbers[3:]) > 0.5 else np.array([0, 0, 0, 1.0])  # zeros: not stated
    return np.asarray(build_pose_matrices(numbers[None, :3], quaternion[None])[0])


def read_tag_name(tag: Any) -> tuple[str, tuple[str, ...]]:
    """Read what a detection names its tag ("": it is not sure), and the frames of tf that may state its place."""
    if hasattr(tag, "family"):
        family, number = clean_text(tag.family).removeprefix("tag"), int(tag.id)
        sure = int(tag.hamming) == 0 or float(tag.decision_margin) >= LEAST_TAG_MARGIN
        return f"tag{family}:{number}" if sure else "", (f"tag{family}:{number}", f"{family}:{number}")
    numbers = np.ravel(tag.id)
    return (f"tag36h11:{int(numbers[0])}" if len(numbers) else ""), ()


def read_hypothesis(result: Any) -> tuple[str, float]:
    """Read the class and its score of a result of vision_msgs, of any version; a score that is none is 0."""
    stated = getattr(result, "hypothesis", result)
    value, score = getattr(stated, "class_id", getattr(stated, "id", "")), float(stated.score)
    return clean_text(value), min(max(score, 0.0), 1.0) if math.isfinite(score) else 0.0


def find_radio_readings(content: Any, depth: int = 3) -> Iterator[tuple[str, float]]:
    """Find senders and their strengths, dBm, in a message of any type that names them in a usual way."""
    fields = {name.lower().strip("_"): getattr(content, name) for name in getattr(content, "__dataclass_fields__", ())}
    sender = next(
        (clean_text(_unwrap(fields[name])).lower() for name in ADDRESSES if name in fields and _unwrap(fields[name]) != ""), ""
    )
    stated = next((_unwrap(fields[name]) for name in STRENGTHS if name in fields), None)
    try:
        strength = float(stated) if stated is not None else math.nan
    except (TypeError, ValueError):
        strength = math.nan
    if sender and WEAKEST <= strength <= STRONGEST:
        yield sender, strength
        return
    for value in fields.values() if depth else ():
        for part in value if isinstance(value, list) else ():
            yield from find_radio_readings(part, depth - 1)


def _unwrap(value: Any) -> Any:
    """Return the value of a message of std_msgs, or of an array of a single number."""
    return getattr(value, "data", value)


class LandmarkReader:
    """Reads the landmarks of one bag.

    Args:
        bag: open.
        locate: gives the pose of a frame.
        carrier: the frame of the sensor whose trajectory is known, that carries radios and barometers.
        camera_of: finds the camera of a topic of images.
        options: of reading pictures.
    """

    def __init__(self, bag: Bag, locate: Locate, carrier: str, camera_of: CameraOf, options: ReadOptions) -> None:
        self.bag, self.locate, self.carrier, self.camera_of = bag, locate, carrier, camera_of
        self.frame_cameras: dict[str, Camera | None] = {}
        self.moment = 0
        self.pictures = PictureReader(options.text, options.tag_size)
        self.cameras: dict[str, tuple[Topic, Camera]] = {}
        self.cloud = np.zeros((0, 3))
        self.sightings: list[Sighting] = []
        self.readings: dict[str, list[tuple[str, float, float, int, Array]]] = {"radio": [], "pressure": []}
        self.step = {"radio": 1, "pressure": 1}
        self.count = {"radio": 0, "pressure": 0}

    def read(self, cloud: CloudSample) -> Iterator[Piece]:
        """Yield empty pieces while it reads, and the landmarks with the last.

        Args:
            cloud: what the bag's scans show.
        """
        decoders = self._find_decoders()
        for topic in find_picture_topics(self.bag) if self.pictures.reads_text else ():
            try:
                self.cameras[topic.name] = (topic, self.camera_of(self.bag, topic))
                decoders[topic.name] = (topic, self._read_picture)
            except InputError:
                self.pictures.warnings.append(f"the pictures of {topic.name} have no CameraInfo that fits, and are not read")
        if decoders:
            self.cloud = cloud.get_points()
            yield from self._read_messages(decoders)
        parts = [self.pictures.collect(), fuse_sightings(self.sightings, "bag")]
        found = join_landmarks([*parts, *(self._collect_readings(kind) for kind in self.readings)])
        yield Piece(np.empty((0, 3)), landmarks=found, warnings=tuple(self.pictures.warnings), done=1.0)

    def _read_messages(self, decoders: Decoders) -> Iterator[Piece]:
        """Read what the topics hold; what can't be decoded ends it with a warning, as the points are there."""
        before = self.pictures.read
        try:
            for number, message in enumerate(self.bag.iter_messages([topic for topic, _ in decoders.values()])):
                self.moment = number
                decoders[message.topic][1](message)
                if self.pictures.read > before or self.moment % MESSAGES_A_PIECE == 0:
                    before = self.pictures.read
                    yield Piece(np.empty((0, 3)), done=1.0)
        except (InputError, AttributeError, TypeError, ValueError, OverflowError) as error:
            reason = " ".join(str(error).split())[:200]
            self.pictures.warnings.append(f"not all landmarks are read: {reason}")

    def _find_decoders(self) -> Decoders:
        """Find the decoders of the topics that are known, but for pictures."""
        decoders: Decoders = {}
        for types, decode in ((TAGS, self._read_tags), ((OBJECTS,), self._read_objects), ((PRESSURE,), self._read_pressure)):
            for topic in self.bag.find_topics(*types):
                if self.bag.learn_type(topic, DEFINITIONS.get(topic.type, "")):
                    decoders[topic.name] = (topic, decode)
        for topic in self.bag.topics.values():
            stated = topic.count and topic.name not in decoders and not self.bag.is_known(topic)
            radio = stated and all(pattern.search(self.bag.get_definition(topic)) for pattern in RADIO_FIELDS)
            if radio and self.bag.learn_type(topic):
                decoders[topic.name] = (topic, self._read_radio)
        return decoders

    def _read_picture(self, message: Message) -> None:
        topic, camera = self.cameras[message.topic]
        header, time = message.content.header, get_time(message)
        pose = self.locate(str(header.frame_id), time)
        if pose is None or not self.pictures.is_due(pose, message.number / topic.count):
            return
        image = decode_picture(message, f"{self.bag.path}: message {message.number} of {message.topic}")
        if image is None or (camera.size is not None and image.shape[:2] != camera.size):
            return
        depth, small = render_depth(self.cloud, camera, pose, image.shape)
        self.pictures.read_picture(Picture(image, camera, depth, small, pose, time))

    def _read_tags(self, message: Message) -> None:
        """Read the tags whose place the message or tf states, else the points of the bag at their corners."""
        header, time = message.content.header, get_time(message)
        camera = self.locate(str(header.frame_id), time)
        for tag in message.content.detections:
            value, names = read_tag_name(tag)
            seen = build_pose(tag.pose.pose.pose) if hasattr(tag, "pose") else None
            known = (pose for name in names if (pose := self.locate(name, time)) is not None)
            pose = next(known, None) if seen is None or camera is None else camera @ seen
            if not value or (pose is None and camera is None):
                continue
            if pose is not None:
                away = camera is not None and pose[:3, 2] @ (camera[:3, 3] - pose[:3, 3]) < 0
                place = (pose[:3, 3], TAG_SIGMA, compute_heading(-pose[:3, 2] if away else pose[:3, 2]))
            elif (found := self._place_corners(tag, str(header.frame_id), camera)) is not None:
                place = found
            else:
                continue
            self._add(Sighting("tag", value, place[0], place[1], 1.0, place[2], time, message.number))

    def _place_corners(self, tag: Any, frame: str, pose: Array | None) -> tuple[Array, float, float] | None:
        """Return where a tag stands by its corners on a picture."""
        camera = self._find_frame_camera(frame)
        if camera is None or camera.size is None or pose is None:
            return None
        depth, small = render_depth(self.cloud, camera, pose, camera.size)
        corners = np.array([(corner.x, corner.y) for corner in tag.corners], float)
        return place_box(corners, Picture(np.zeros((1, 1, 3), np.uint8), camera, depth, small, pose))

    def _find_frame_camera(self, frame: str) -> Camera | None:
        """Return the camera of the only CameraInfo of a frame."""
        if frame not in self.frame_cameras:
            fitting = []
            for topic in self.bag.find_topics(CAMERA_INFO):
                if str(next(self.bag.iter_messages([topic])).content.header.frame_id) == frame:
                    fitting.append(topic)
            self.frame_cameras[frame] = self.camera_of(self.bag, fitting[0]) if len(fitting) == 1 else None
        return self.frame_cameras[frame]

    def _read_objects(self, message: Message) -> None:
        content = message.content
        pose = self.locate(str(content.header.frame_id), get_time(message))
        for found in content.detections if pose is not None else ():
            named = [read_hypothesis(result) for result in found.results]
            value, score = max(named, key=lambda pair: pair[1], default=("", 0.0))
            box = build_pose(found.bbox.center)
            if value and box is not None and pose is not None:
                place = (pose @ box)[:3, 3]
                self._add(Sighting("object", value, place, OBJECT_SIGMA, score, time=get_time(message), picture=message.number))

    def _add(self, sighting: Sighting) -> None:
        if len(self.sightings) < MOST_SIGHTINGS:
            self.sightings.append(sighting)

    def _read_pressure(self, message: Message) -> None:
        value = float(message.content.fluid_pressure) / 100
        if LOWEST_PRESSURE <= value <= HIGHEST_PRESSURE:
            self._add_reading("pressure", "", value, message)

    def _read_radio(self, message: Message) -> None:
        for address, strength in find_radio_readings(message.content):
            self._add_reading("radio", address, strength, message)

    def _add_reading(self, kind: str, value: str, number: float, message: Message) -> None:
        """Keep a reading where the carrier was; of too many every second one goes."""
        self.count[kind] += 1
        header = getattr(message.content, "header", None)
        time = message.recorded if header is None else get_time(message)
        if self.count[kind] % self.step[kind] or (pose := self.locate(self.carrier, time)) is None:
            return
        self.readings[kind].append((value, number, time, self.moment, pose[:3, 3]))
        if len(self.readings[kind]) > MOST_READINGS:
            self.readings[kind] = self.readings[kind][::2]
            self.step[kind] *= 2

    def _collect_readings(self, kind: str) -> Landmarks:
        rows = self.readings[kind]
        if not rows:
            return Landmarks()
        values, numbers, times, groups, places = zip(*rows, strict=True)
        columns = {"number": np.array(numbers), "time": np.array(times), "group": np.array(groups)}
        return build_landmarks(kind, values, "bag", np.array(places), sigma=READING_SIGMA, **columns)
