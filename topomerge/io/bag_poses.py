"""Where the sensor of a bag's scans stood: by a trajectory file, by tf, or by odometry."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.bag_file import SAME_LAYOUT, TRANSFORMS, Bag, Topic
from topomerge.io.bag_messages import stamp
from topomerge.io.posed import PosedScan
from topomerge.io.trajectory import LONGEST_GAP, Trajectory, read_trajectory
from topomerge.io.transforms import WORLD_NAMES, Frames
from topomerge.types import Array

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
    by: Trajectory | Frames
    registered: bool = False
    carrier: str | None = None
    warnings: list[str] = field(default_factory=list)

    def place(self, frame: str, time: float, number: int, points: Array) -> PosedScan | None:
        """A scan from points (n, 3) in a frame at a time (s); None: its pose then is not known. Scans are counted from 1."""
        if isinstance(self.by, Trajectory):
            if self.by.times is None:
                pose = self.by.poses[number - 1]
            elif self.by.gap(np.array([time]))[0] > LONGEST_GAP:
                return None
            else:
                pose = self.by.at(np.array([time]))[0]
            return PosedScan(points, pose, registered=self.registered)
        stands = self.by.at(frame, time)
        if stands is None or not self.registered:
            return None if stands is None else PosedScan(points, stands)
        points = points @ stands[:3, :3].T + stands[:3, 3]
        return PosedScan(points, None if self.carrier is None else self.by.at(self.carrier, time), registered=True)


def sensor_poses(bag: Bag, topic: Topic, wanted: str | None, frame: str) -> SensorPoses:
    """The poses of the sensor of a topic.

    Args:
        wanted: the name of a trajectory file or of a topic of the bag; None: tf, or else the only topic of odometry.
        frame: of the first scan.

    Raises:
        InputError: no poses, or none that belong to that frame; a pose that can't be used; a clock that was set back.
    """
    frame = frame.strip("/")
    named = bag.named(wanted) if wanted is not None and not Path(wanted).exists() else None
    if wanted is not None and named is None:
        return _by_file(bag, topic, Path(wanted), frame)
    frames = Frames()
    _add_transforms(bag, frames)
    registered = frame in WORLD_NAMES or (frames.chain(frame) == [frame] and frames.carried(frame) is not None)
    moved = frames.carried(frame) is not None if registered else frames.moves(frame)
    odometry = named if moved or named else _odometry(bag)
    warnings: list[str] = []
    if odometry is not None:
        warnings = _add_odometry(bag, odometry, frames, frame, registered)
    elif not moved and not registered and frames.chain(frame)[-1] not in WORLD_NAMES:
        stands = f"tf says only {', '.join(frames.names())[:200]}" if frames.names() else "it has no tf"
        raise InputError(
            f"{bag.path}: nothing moves the frame {frame!r} of {topic.name}: {stands}, and there is no odometry; {OTHER_POSES}; "
            f"the bag holds {bag.listing()}"
        )
    carrier = frames.carried(frame) if registered else None
    if registered and carrier is None:
        warnings.append(
            f"{topic.name} stands in {frame!r}, and where its sensor was is not known: give --poses for true free space"
        )
    return SensorPoses(odometry.name if odometry else "tf", frames, registered, carrier, warnings)


def _by_file(bag: Bag, topic: Topic, path: Path, frame: str) -> SensorPoses:
    if not path.exists():
        raise InputError(f"{path}: is neither a file nor a topic of {bag.path}; give --poses with one of them: {bag.listing()}")
    trajectory = read_trajectory(path)
    if trajectory.times is None and len(trajectory) != topic.count:
        raise InputError(
            f"{path}: has {len(trajectory):,} poses without times, and {topic.name} has {topic.count:,} messages; give a "
            f"trajectory with times"
        )
    return SensorPoses(path.name, trajectory, frame in WORLD_NAMES)


def _add_transforms(bag: Bag, frames: Frames) -> None:
    for message in bag.messages(bag.of_type(TRANSFORMS, *SAME_LAYOUT)):
        static = message.topic.endswith("tf_static")
        for one in message.content.transforms:
            time = one.header.stamp.sec + one.header.stamp.nanosec * 1e-9
            sample = (time, *_xyz(one.transform.translation), *_xyzw(one.transform.rotation))
            fault = frames.add(one.header.frame_id, one.child_frame_id, sample, static)
            if fault:
                raise message.fault(bag.path, fault, OTHER_POSES)


def _odometry(bag: Bag) -> Topic | None:
    topics = bag.of_type(ODOMETRY)
    if len(topics) > 1:
        shown = ", ".join(t.name for t in topics)
        raise InputError(f"{bag.path}: has several topics of odometry ({shown}); give --poses with one of them, or a file")
    return topics[0] if topics else None


def _add_odometry(bag: Bag, topic: Topic, frames: Frames, frame: str, registered: bool) -> list[str]:
    """Put the poses of a topic into the tree, in place of what tf says of the frame that they move.

    Returns:
        What the user should know.
    """
    if topic.type not in POSE_TYPES:
        raise InputError(f"{bag.path}: the topic {topic.name} holds {topic.kind}, no poses; {OTHER_POSES}: {bag.listing()}")
    rigid = frames.rigid(frame)
    child = None
    for message in bag.messages([topic]):
        content = message.content
        pose = content.pose.pose if hasattr(content.pose, "pose") else content.pose
        if child is None:
            child = str(getattr(content, "child_frame_id", "")).strip("/") or (f"{frame} sensor" if registered else rigid[-1])
            frames.forget(child)
        sample = (stamp(message), *_xyz(pose.position), *_xyzw(pose.orientation))
        fault = frames.add(content.header.frame_id, child, sample)
        if fault:
            raise message.fault(bag.path, fault, OTHER_POSES)
    if child is None or registered or child in rigid:
        return []
    frames.forget(rigid[-1])
    frames.add(child, rigid[-1], (0.0,) * 7 + (1.0,), static=True)
    return [f"tf does not say where {rigid[-1]!r} stands in {child!r}, which {topic.name} moves: taken as the same frame"]


def _xyz(vector: Any) -> Iterable[float]:
    return vector.x, vector.y, vector.z


def _xyzw(turn: Any) -> Iterable[float]:
    return turn.x, turn.y, turn.z, turn.w
