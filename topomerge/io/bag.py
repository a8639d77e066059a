"""ROS bags: points of a LiDAR, depth images or slices of a 2D laser with the sensor's poses, or a robot's map.

Poses are those of tf; where tf does not move the sensor, those of the odometry; or of a trajectory file or topic (--poses).
The messages with poses are read first, those with points after them, one at a time. A scan counts as taken in one instant.
The library is in a process of its own, within limits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.io.bag_depth import COMPRESSED_IMAGE, IMAGE, Decoder, depth_decoder, depth_topics
from topomerge.io.bag_file import BAG_KIND, Bag, Message, Topic, bag_files
from topomerge.io.bag_messages import LASER_SCAN, OCCUPANCY_GRID, POINT_CLOUD, cloud_points, laser_points, occupancy_plan, stamp
from topomerge.io.bag_poses import SensorPoses, sensor_poses
from topomerge.io.bag_unpacking import bag_size, limit_unpacking
from topomerge.io.grid import classify, extrude
from topomerge.io.grid_doubts import doubt_outside
from topomerge.io.options import ReadOptions
from topomerge.io.piece import Piece, damaged
from topomerge.io.posed import PosedScan, pieces
from topomerge.io.subprocess_reader import read_in_subprocess
from topomerge.io.trajectory import BACKWARD

# Of a bag of any size, and bytes of memory for each of its own: the largest messages, and all poses. At most LARGEST_MEMORY.
LEAST_MEMORY, MEMORY_RATIO, LARGEST_MEMORY = 1 << 30, 16, 4 << 30
LEAST_SECONDS, BYTES_A_SECOND = 30, 250_000  # of the processor for one piece; an old one goes through ten times as many bytes
DECODERS: dict[str, Decoder] = {POINT_CLOUD: cloud_points, LASER_SCAN: laser_points}
READ_TYPES = (*DECODERS, IMAGE, COMPRESSED_IMAGE, OCCUPANCY_GRID)
READ_NAMES = "PointCloud2, depth images, LaserScan or OccupancyGrid"


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Points in the topmost frame, scan by scan, or the walls and floor of a map."""
    if find_spec("rosbags") is None:
        raise ImportError("no rosbags", name="rosbags")
    size = bag_size(bag_files(path))
    seconds = LEAST_SECONDS + size // BYTES_A_SECOND
    room = min(LEAST_MEMORY + MEMORY_RATIO * size, LARGEST_MEMORY)
    yield from read_in_subprocess("bag", BAG_KIND, path, options, seconds=seconds, room=room)


def read_in_process(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """The same in this process."""
    try:
        yield from _read(path, options)
    except MemoryError as error:  # lengths in a damaged bag are believed by the library
        raise damaged(path, BAG_KIND, "one of its parts claims more memory than there is") from error


def _read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    with Bag(path, limit_unpacking(bag_size(bag_files(path)))) as bag:
        topic = _topic(bag, options.topic)
        if topic.type == OCCUPANCY_GRID:
            yield from _map(bag, topic, options)
            return
        poses = sensor_poses(bag, topic, options.poses, _first_frame(bag, topic))
        decode = DECODERS.get(topic.type) or depth_decoder(bag, topic)
        yield from pieces(_scans(bag, topic, decode, poses), poses.warnings)


def _topic(bag: Bag, name: str | None) -> Topic:
    """The topic to read: the one that is named, or the only one with points, else with depth images, slices, or a map.

    Raises:
        InputError: there is none, or are several; with what the bag holds.
    """
    if name is not None:
        topic = bag.named(name)
        if topic is None or topic.type not in READ_TYPES or not topic.count:
            wrong = "is not in the bag" if topic is None else f"holds {topic.count:,} {topic.kind}"
            raise InputError(f"{bag.path}: the topic {name} {wrong}; give --topic with {READ_NAMES}: {bag.listing()}")
        return topic
    for kind in (POINT_CLOUD, IMAGE, LASER_SCAN, OCCUPANCY_GRID):
        topics = depth_topics(bag) if kind == IMAGE else bag.of_type(kind)
        if len(topics) > 1:
            shown = ", ".join(f"{t.name} ({t.count:,} {t.kind})" for t in topics)
            raise InputError(f"{bag.path}: has several topics to read ({shown}); give --topic with one of them")
        if topics:
            return topics[0]
    raise InputError(f"{bag.path}: has no {READ_NAMES}; give another bag, this holds {bag.listing()}")


def _first_frame(bag: Bag, topic: Topic) -> str:
    """The frame of the first message of a topic."""
    return str(next(bag.messages([topic])).content.header.frame_id)


def _map(bag: Bag, topic: Topic, options: ReadOptions) -> Iterator[Piece]:
    """Walls and floor of the newest map of a topic."""
    newest: Message | None = None
    for message in bag.messages([topic]):
        newest = message
    assert newest is not None
    image, plan = occupancy_plan(bag.path, newest)
    occupied, free = classify(image, plan)
    outside = [f"{bag.path}: {doubt}; is unknown (-1) 0 in this map?" for doubt in doubt_outside(occupied, free, plan.resolution)]
    yield Piece(np.empty((0, 3)), warnings=(*plan.warnings, *outside))
    yield from extrude(bag.path, occupied, free, plan, options)


def _scans(bag: Bag, topic: Topic, decode: Decoder, poses: SensorPoses) -> Iterator[PosedScan]:
    """The scans of a topic, one at a time; those without a pose are left out, and counted in the warnings of the poses.

    Raises:
        InputError: the clock was set back, or no scan has a pose.
    """
    newest = -np.inf
    count = lost = 0
    for message in bag.messages([topic]):
        time = stamp(message)
        if time < newest - BACKWARD:
            raise message.fault(bag.path, f"sets the clock back by {newest - time:.1f} s")
        newest, count = max(newest, time), count + 1
        points, colors = decode(bag.path, message)
        scan = poses.place(message.content.header.frame_id, time, count, points)
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
