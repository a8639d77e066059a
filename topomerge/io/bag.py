"""Read a ROS bag as a cloud: topics, poses, depth images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.bag_file import (
    BAG_KIND,
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    LASER_SCAN,
    OCCUPANCY_GRID,
    POINT_CLOUD,
    SAME_LAYOUT,
    TRANSFORMS,
    Bag,
    Message,
    Topic,
    decode_laser_scan,
    decode_occupancy_grid,
    decode_point_cloud,
    get_time,
    limit_unpacking,
    list_bag_files,
    measure_bag_size,
)
from topomerge.io.bag_landmarks import PACKED, CloudSample, LandmarkReader
from topomerge.io.depth_images import Camera, PosedScan, iter_pieces, read_pixels, unproject_depth
from topomerge.io.floor_masks import check_outside_floor
from topomerge.io.grid import classify, extrude
from topomerge.io.piece import Piece, ReadOptions, build_damage_error, read_in_subprocess
from topomerge.io.trajectory import BACKWARD, LONGEST_GAP, WORLD_NAMES, FrameTree, Trajectory, read_trajectory
from topomerge.types import Array

ENCODINGS = {"16UC1": ("u2", 1000.0), "32FC1": ("f4", 1.0)}  # kind of number, values of depth in a metre
TRANSPORT = "/compressedDepth"  # how the name of a packed topic ends
PACKED_HEAD = 12  # bytes before the image of a packed message
Decoder = Callable[[Path, Message], tuple[Array, Array | None]]


def find_depth_topics(bag: Bag) -> list[Topic]:
    """Find the topics whose first message is a depth image; packed ones only where the plain ones were not recorded."""
    plain = [t for t in bag.find_topics(IMAGE) if _read_first_message(bag, t).encoding in ENCODINGS]
    names = {t.name for t in plain}
    packed = [t for t in bag.find_topics(COMPRESSED_IMAGE) if "compressedDepth" in _read_first_message(bag, t).format]
    return plain + [t for t in packed if t.name.removesuffix(TRANSPORT) not in names]


def build_depth_decoder(bag: Bag, topic: Topic) -> Decoder:
    """Build the decoder of the messages of a topic of depth images to points.

    Raises:
        InputError: there is no CameraInfo for them, or it states no camera.
    """
    camera = _read_camera(bag, topic)

    def decode(path: Path, message: Message) -> tuple[Array, Array | None]:
        depth, metre = _decode_compressed_image(path, message) if topic.type == COMPRESSED_IMAGE else _decode_image(path, message)
        named = f"{path}: message {message.number} of {message.topic}"
        points, _, _ = unproject_depth(named, depth, Camera(camera.focal, camera.centre, metre, camera.size, camera.mend))
        return points, None

    return decode


def _read_first_message(bag: Bag, topic: Topic) -> Any:
    return next(bag.iter_messages([topic])).content


def _read_camera(bag: Bag, topic: Topic) -> Camera:
    """Return the camera of a topic of images, as its CameraInfo states it after rectification (P), else before (K)."""
    companion = bag.find_topic(
        topic.name.removesuffix(TRANSPORT).removesuffix(PACKED).rstrip("/").rpartition("/")[0] + "/camera_info"
    )
    if companion is None or companion.type != CAMERA_INFO or not companion.count:
        frame = _read_first_message(bag, topic).header.frame_id
        fitting = [t for t in bag.find_topics(CAMERA_INFO) if _read_first_message(bag, t).header.frame_id == frame]
        if len(fitting) != 1:
            have = f"no CameraInfo beside {topic.name}, and {len(fitting)} of its frame {frame!r}"
            raise InputError(f"{bag.path}: has {have}; record camera_info, too: the bag holds {bag.format_topics()}")
        companion = fitting[0]
    return _decode_camera(bag, companion)


def _decode_camera(bag: Bag, beside: Topic) -> Camera:
    """Return the camera of a topic of CameraInfo."""
    message = next(bag.iter_messages([beside]))
    info = message.content
    projection, matrix = (np.asarray(getattr(info, name, getattr(info, name.lower(), ())), float) for name in "PK")
    numbers = projection.reshape(3, 4) if projection.size == 12 and projection[0] > 0 else matrix.reshape(3, 3)
    try:
        mend = f"calibrate it, or give another --topic ({beside.name} states the camera)"
        focal, centre = (numbers[0, 0], numbers[1, 1]), (numbers[0, 2], numbers[1, 2])
        return Camera(focal, centre, 1.0, (int(info.height), int(info.width)), mend)
    except ValueError as error:
        raise message.build_error(
            bag.path, "states no camera (its K and P are zero)", "calibrate it, or give another --topic"
        ) from error


def _decode_image(path: Path, message: Message) -> tuple[Array, float]:
    """Return (h, w) values of an Image, and how many of them are a metre."""
    image = message.content
    if image.encoding not in ENCODINGS:
        able = " or ".join(ENCODINGS)
        raise message.build_error(
            path, f"has the encoding {image.encoding[:40]!r}, which is no depth ({able})", "give another --topic"
        )
    kind, metre = ENCODINGS[image.encoding]
    kind = (">" if image.is_bigendian else "<") + kind
    height, width, step = int(image.height), int(image.width), int(image.step)
    size = np.dtype(kind).itemsize
    if not 0 < width * size <= step or not 0 < height * step <= len(image.data) or step % size:
        raise message.build_error(path, f"promises {width} x {height} pixels and has {len(image.data):,} bytes")
    return np.frombuffer(image.data, kind, height * step // size).reshape(height, step // size)[:, :width], metre


def _decode_compressed_image(path: Path, message: Message) -> tuple[Array, float]:
    """Decode the same of a CompressedImage."""
    image = message.content
    if not image.format.startswith("16UC1") or "rvl" in image.format.lower():
        advice = "record the plain images, or unpack them (image_transport republish)"
        raise message.build_error(path, f"is packed as {image.format[:60]!r}; only 16UC1 as PNG is read", advice)
    values = read_pixels(bytes(image.data[PACKED_HEAD:]), f"{path}: message {message.number} of {message.topic}")
    if values.ndim != 2 or values.dtype == np.uint8:
        raise message.build_error(path, "holds no image of 16 bits")
    return values, ENCODINGS["16UC1"][1]


ODOMETRY = "nav_msgs/msg/Odometry"
POSE_TYPES = (ODOMETRY, "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
OTHER_POSES = "give --poses with a trajectory file or a topic of odometry"


@dataclass(frozen=True, eq=False)
class SensorPoses:
    """Places scans in the fixed frame.

    Args:
        source: where the poses come from, for messages.
        by: a trajectory of the sensor, or the tree of frames.
        registered: the points stand in the fixed frame, or in one that is moved only by corrections, already.
        carrier: of registered points, the frame in the tree that their sensor has; None: not known.
        warnings: what the user should know.
    """

    source: str
    by: Trajectory | FrameTree
    registered: bool = False
    carrier: str | None = None
    warnings: list[str] = field(default_factory=list)

    def pose_scan(self, frame: str, time: float, number: int, points: Array) -> PosedScan | None:
        """Return a scan from points (n, 3) in a frame at a time (s); None: its pose then is not known. Scans are counted from
        1.
        """
        if isinstance(self.by, Trajectory):
            if self.by.times is None:
                pose = self.by.poses[number - 1]
            elif self.by.measure_gap(np.array([time]))[0] > LONGEST_GAP:
                return None
            else:
                pose = self.by.interpolate(np.array([time]))[0]
            return PosedScan(points, pose, registered=self.registered)
        stands = self.by.compute_pose(frame, time)
        if stands is None or not self.registered:
            return None if stands is None else PosedScan(points, stands)
        points = points @ stands[:3, :3].T + stands[:3, 3]
        return PosedScan(points, None if self.carrier is None else self.by.compute_pose(self.carrier, time), registered=True)

    def locate(self, sensor: str, frame: str, time: float) -> Array | None:
        """Return the pose (4, 4) of a frame in the fixed one at a time (s).

        Args:
            sensor: the frame of the scans.
            frame: any; None is returned where nothing is known of it.
            time: s.
        """
        frame = frame.strip("/")
        if isinstance(self.by, FrameTree):
            known = frame and self.by.list_chain(frame)[-1] == self.by.list_chain(sensor)[-1]
            return self.by.compute_pose(frame, time) if known else None
        near = self.by.times is not None and self.by.measure_gap(np.array([time]))[0] <= LONGEST_GAP
        return np.asarray(self.by.interpolate(np.array([time]))[0]) if near and frame == sensor else None


def find_sensor_poses(bag: Bag, topic: Topic, requested: str | None, frame: str) -> SensorPoses:
    """Find the poses of the sensor of a topic.

    Args:
        requested: the name of a trajectory file or of a topic of the bag; None: tf, or else the only topic of odometry.
        frame: of the first scan.

    Raises:
        InputError: no poses, or none that belong to that frame; a pose that can't be used; a clock that was set back.
    """
    frame = frame.strip("/")
    named = bag.find_topic(requested) if requested is not None and not Path(requested).exists() else None
    if requested is not None and named is None:
        return _read_pose_file(bag, topic, Path(requested), frame)
    frames = FrameTree()
    _add_transforms(bag, frames)
    registered = frame in WORLD_NAMES or (frames.list_chain(frame) == [frame] and frames.find_moving_child(frame) is not None)
    moved = frames.find_moving_child(frame) is not None if registered else frames.is_moving(frame)
    odometry = named if moved or named else _find_odometry_topic(bag)
    warnings: list[str] = []
    if odometry is not None:
        warnings = _add_odometry(bag, odometry, frames, frame, registered)
    elif not moved and not registered and frames.list_chain(frame)[-1] not in WORLD_NAMES:
        stands = f"tf says only {', '.join(frames.format_frames())[:200]}" if frames.format_frames() else "it has no tf"
        raise InputError(
            f"{bag.path}: nothing moves the frame {frame!r} of {topic.name}: {stands}, and there is no odometry; {OTHER_POSES}; "
            f"the bag holds {bag.format_topics()}"
        )
    carrier = frames.find_moving_child(frame) if registered else None
    if registered and carrier is None:
        warnings.append(
            f"{topic.name} stands in {frame!r}, and where its sensor was is not known: give --poses for true free space"
        )
    return SensorPoses(odometry.name if odometry else "tf", frames, registered, carrier, warnings)


def _read_pose_file(bag: Bag, topic: Topic, path: Path, frame: str) -> SensorPoses:
    if not path.exists():
        raise InputError(
            f"{path}: is neither a file nor a topic of {bag.path}; give --poses with one of them: {bag.format_topics()}"
        )
    trajectory = read_trajectory(path)
    if trajectory.times is None and len(trajectory) != topic.count:
        raise InputError(
            f"{path}: has {len(trajectory):,} poses without times, and {topic.name} has {topic.count:,} messages; give a "
            f"trajectory with times"
        )
    return SensorPoses(path.name, trajectory, frame in WORLD_NAMES)


def _add_transforms(bag: Bag, frames: FrameTree) -> None:
    for message in bag.iter_messages(bag.find_topics(TRANSFORMS, *SAME_LAYOUT)):
        static = message.topic.endswith("tf_static")
        for one in message.content.transforms:
            time = one.header.stamp.sec + one.header.stamp.nanosec * 1e-9
            sample = (time, *_get_xyz(one.transform.translation), *_get_xyzw(one.transform.rotation))
            fault = frames.add(one.header.frame_id, one.child_frame_id, sample, static)
            if fault:
                raise message.build_error(bag.path, fault, OTHER_POSES)


def _find_odometry_topic(bag: Bag) -> Topic | None:
    topics = bag.find_topics(ODOMETRY)
    if len(topics) > 1:
        shown = ", ".join(t.name for t in topics)
        raise InputError(f"{bag.path}: has several topics of odometry ({shown}); give --poses with one of them, or a file")
    return topics[0] if topics else None


def _add_odometry(bag: Bag, topic: Topic, frames: FrameTree, frame: str, registered: bool) -> list[str]:
    """Put the poses of a topic into the tree, in place of what tf says of the frame that they move.

    Returns:
        What the user should know.
    """
    if topic.type not in POSE_TYPES:
        raise InputError(f"{bag.path}: the topic {topic.name} holds {topic.kind}, no poses; {OTHER_POSES}: {bag.format_topics()}")
    rigid = frames.list_rigid_chain(frame)
    child = None
    for message in bag.iter_messages([topic]):
        content = message.content
        pose = content.pose.pose if hasattr(content.pose, "pose") else content.pose
        if child is None:
            child = str(getattr(content, "child_frame_id", "")).strip("/") or (f"{frame} sensor" if registered else rigid[-1])
            frames.forget(child)
        sample = (get_time(message), *_get_xyz(pose.position), *_get_xyzw(pose.orientation))
        fault = frames.add(content.header.frame_id, child, sample)
        if fault:
            raise message.build_error(bag.path, fault, OTHER_POSES)
    if child is None or registered or child in rigid:
        return []
    frames.forget(rigid[-1])
    frames.add(child, rigid[-1], (0.0,) * 7 + (1.0,), static=True)
    return [f"tf does not say where {rigid[-1]!r} stands in {child!r}, which {topic.name} moves: taken as the same frame"]


def _get_xyz(vector: Any) -> Iterable[float]:
    return vector.x, vector.y, vector.z


def _get_xyzw(turn: Any) -> Iterable[float]:
    return turn.x, turn.y, turn.z, turn.w


# Of a bag of any size, and bytes of memory for each of its own: the largest messages, and all poses. At most LARGEST_MEMORY.
LEAST_MEMORY, MEMORY_RATIO, LARGEST_MEMORY = 1 << 30, 16, 4 << 30
PICTURE_MEMORY = 3 << 30  # more, for what reads pictures
LEAST_SECONDS, BYTES_A_SECOND = 30, 250_000  # of the processor for one piece; an old one goes through ten times as many bytes
DECODERS: dict[str, Decoder] = {POINT_CLOUD: decode_point_cloud, LASER_SCAN: decode_laser_scan}
READ_TYPES = (*DECODERS, IMAGE, COMPRESSED_IMAGE, OCCUPANCY_GRID)
READ_NAMES = "PointCloud2, depth images, LaserScan or OccupancyGrid"


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Yield points in the topmost frame, scan by scan, or the walls and floor of a map."""
    if find_spec("rosbags") is None:
        raise ImportError("no rosbags", name="rosbags")
    size = measure_bag_size(list_bag_files(path))
    seconds = LEAST_SECONDS + size // BYTES_A_SECOND
    room = min(LEAST_MEMORY + MEMORY_RATIO * size, LARGEST_MEMORY)
    if options.text is not False and find_spec("rapidocr_onnxruntime") is not None:
        room += PICTURE_MEMORY
    yield from read_in_subprocess("bag", BAG_KIND, path, options, seconds=seconds, room=room)


def read_in_process(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Yield the same in this process."""
    try:
        yield from _read(path, options)
    except MemoryError as error:  # lengths in a damaged bag are believed by the library
        raise build_damage_error(path, BAG_KIND, "one of its parts claims more memory than there is") from error


def _read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    with Bag(path, limit_unpacking(measure_bag_size(list_bag_files(path)))) as bag:
        topic = _select_topic(bag, options.topic)
        if topic.type == OCCUPANCY_GRID:
            yield from _read_map(bag, topic, options)
            return
        poses = find_sensor_poses(bag, topic, options.poses, _read_first_frame(bag, topic))
        decode = DECODERS.get(topic.type) or build_depth_decoder(bag, topic)
        sample = CloudSample()
        yield from iter_pieces(sample.watch(_iter_scans(bag, topic, decode, poses)), poses.warnings)
        frame = _read_first_frame(bag, topic).strip("/")
        carrier = frame if not poses.registered else poses.carrier or ""
        reader = LandmarkReader(bag, partial(poses.locate, frame), carrier, _read_camera, options)
        yield from reader.read(sample)


def _select_topic(bag: Bag, name: str | None) -> Topic:
    """Return the topic to read: the one that is named, or the only one with points, else with depth images, slices, or a map.

    Raises:
        InputError: there is none, or are several; with what the bag holds.
    """
    if name is not None:
        topic = bag.find_topic(name)
        if topic is None or topic.type not in READ_TYPES or not topic.count:
            wrong = "is not in the bag" if topic is None else f"holds {topic.count:,} {topic.kind}"
            raise InputError(f"{bag.path}: the topic {name} {wrong}; give --topic with {READ_NAMES}: {bag.format_topics()}")
        return topic
    for kind in (POINT_CLOUD, IMAGE, LASER_SCAN, OCCUPANCY_GRID):
        topics = find_depth_topics(bag) if kind == IMAGE else bag.find_topics(kind)
        if len(topics) > 1:
            shown = ", ".join(f"{t.name} ({t.count:,} {t.kind})" for t in topics)
            raise InputError(f"{bag.path}: has several topics to read ({shown}); give --topic with one of them")
        if topics:
            return topics[0]
    raise InputError(f"{bag.path}: has no {READ_NAMES}; give another bag, this holds {bag.format_topics()}")


def _read_first_frame(bag: Bag, topic: Topic) -> str:
    """Return the frame of the first message of a topic."""
    return str(next(bag.iter_messages([topic])).content.header.frame_id)


def _read_map(bag: Bag, topic: Topic, options: ReadOptions) -> Iterator[Piece]:
    """Yield walls and floor of the newest map of a topic."""
    newest: Message | None = None
    for message in bag.iter_messages([topic]):
        newest = message
    assert newest is not None
    image, plan = decode_occupancy_grid(bag.path, newest)
    occupied, free = classify(image, plan)
    outside = [
        f"{bag.path}: {doubt}; is unknown (-1) 0 in this map?" for doubt in check_outside_floor(occupied, free, plan.resolution)
    ]
    yield Piece(np.empty((0, 3)), warnings=(*plan.warnings, *outside))
    yield from extrude(bag.path, occupied, free, plan, options)


def _iter_scans(bag: Bag, topic: Topic, decode: Decoder, poses: SensorPoses) -> Iterator[PosedScan]:
    """Yield the scans of a topic, one at a time; those without a pose are left out, and counted in the warnings of the poses.

    Raises:
        InputError: the clock was set back, or no scan has a pose.
    """
    newest = -np.inf
    count = lost = 0
    for message in bag.iter_messages([topic]):
        time = get_time(message)
        if time < newest - BACKWARD:
            raise message.build_error(bag.path, f"sets the clock back by {newest - time:.1f} s")
        newest, count = max(newest, time), count + 1
        points, colors = decode(bag.path, message)
        scan = poses.pose_scan(message.content.header.frame_id, time, count, points)
        if scan is None:
            lost += 1
        else:
            yield replace(scan, colors=colors, done=count / topic.count)
    if lost == count:
        raise InputError(
            f"{bag.path}: none of the {count:,} messages of {topic.name} has a pose at its time (poses: {poses.source}); give "
            f"--poses with a trajectory of the same clock"
        )
    if lost:
        poses.warnings.append(f"{lost:,} of {count:,} messages of {topic.name} have no pose near their time and are left out")
