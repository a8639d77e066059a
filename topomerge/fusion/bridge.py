"""From messages of robots to maps that are joined: what comes is put into the maps of `live`, what is found goes back.

Updates run beside the stream, one at a time, and leave most of the processor to it.
"""

from __future__ import annotations

import json
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.fusion.live import LiveMerger
from topomerge.io.bag_file import (
    LASER_SCAN,
    OCCUPANCY_GRID,
    POINT_CLOUD,
    Message,
    decode_laser_scan,
    decode_occupancy_grid,
    decode_point_cloud,
)
from topomerge.io.grid import classify, extrude
from topomerge.io.piece import ReadOptions
from topomerge.io.streams import MESSAGE_ERRORS, PoseBook, Received, infer_kind, read_time, take_poses
from topomerge.types import PointCloud

SHARED_POSES = ("/tf", "/tf_static")
WAITING = 40  # scans whose pose has not come yet
EVENTS_TOPIC, TRANSFORMS_TOPIC = "/topomerge/events", "/topomerge/transforms"
LIVE_NAME = Path("live")  # of what has no file


@dataclass(frozen=True)
class RobotTopics:
    """What a robot sends.

    Args:
        scans: topic of scans, clouds or grids.
        poses: topics of its poses.
    """

    name: str
    scans: str
    poses: tuple[str, ...] = SHARED_POSES


def parse_robot(text: str) -> RobotTopics:
    """Parse ``NAME=SCANS[,POSES...]``.

    Raises:
        InputError: it is something else.
    """
    name, sign, topics = text.partition("=")
    scans, *poses = [topic.strip() for topic in topics.split(",")]
    if not (name and sign and scans) or not all(poses):
        raise InputError(f"--robot {text}: must be NAME=SCANS[,POSES], as a=/a/scan,/a/odom")
    return RobotTopics(name, scans, (*poses, *SHARED_POSES))


@dataclass(eq=False)
class Bridge:
    """Puts messages into maps.

    Args:
        every: s between two updates, at least.
        share: of a core that updates may take.
        counts: messages by what became of them: taken, standing (the robot had not moved), without a pose, broken.
    """

    merger: LiveMerger
    robots: Sequence[RobotTopics]
    tell: Callable[[Mapping[str, Any]], None]
    every: float = 5.0
    share: float = 0.25
    counts: Counter[str] = field(default_factory=Counter)
    outbox: deque[Mapping[str, Any]] = field(default_factory=lambda: deque(maxlen=200))

    def __post_init__(self) -> None:
        self._books = {robot.name: PoseBook() for robot in self.robots}
        self._moving: dict[str, str] = {}
        self._waiting: deque[tuple[RobotTopics, Message]] = deque(maxlen=WAITING)
        self._free = 0.0
        self._advertised = False

    def list_topics(self) -> list[str]:
        """List all topics that are read."""
        return list(dict.fromkeys(t for robot in self.robots for t in (robot.scans, *robot.poses)))

    def take_outbox(self) -> list[Mapping[str, Any]]:
        """Take the operations for rosbridge that have gathered."""
        out = list(self.outbox)
        self.outbox.clear()
        return out

    def run(self, source: Received) -> None:
        """Go through a stream to its end, or until an interrupt; the state is written either way."""
        with ThreadPoolExecutor(1, "update") as workers:
            running: Future[list[dict[str, Any]]] | None = None
            began = 0.0
            try:
                for message in source:
                    if message is not None:
                        self.take(message)
                    if running is not None and running.done():
                        self._finish(running.result(), time.monotonic() - began)
                        running = None
                    if running is None and time.monotonic() >= self._free and (clouds := self.merger.take_changed()):
                        began = time.monotonic()
                        running = workers.submit(self.merger.update, clouds)
                if running is not None:
                    self._finish(running.result(), 0.0)
                    running = None
                self._finish(self.merger.update(), 0.0)
            finally:
                if running is not None:
                    running.result()
                self.merger.save()

    def _finish(self, events: Sequence[Mapping[str, Any]], took: float) -> None:
        """Tell what an update found."""
        self._free = time.monotonic() + max(self.every, took * (1 / self.share - 1))
        for event in events:
            self.tell(event)
            self._publish(EVENTS_TOPIC, "std_msgs/String", {"data": json.dumps(event)})
        if events:
            transforms = [_build_transform(*edge) for edge in self.merger.list_transforms()]
            self._publish(TRANSFORMS_TOPIC, "tf2_msgs/TFMessage", {"transforms": transforms})
            self.merger.save()

    def _publish(self, topic: str, kind: str, content: Mapping[str, Any]) -> None:
        if not self._advertised:
            for name, of in ((EVENTS_TOPIC, "std_msgs/String"), (TRANSFORMS_TOPIC, "tf2_msgs/TFMessage")):
                self.outbox.append({"op": "advertise", "topic": name, "type": of})
            self._advertised = True
        self.outbox.append({"op": "publish", "topic": topic, "type": kind, "msg": content})

    def take(self, message: Message) -> None:
        """Put a message where it belongs; one that can't be used is counted."""
        try:
            for robot in self.robots:
                if message.topic in robot.poses:
                    moving = take_poses(self._books[robot.name], message, f"{robot.name} sensor")
                    self._moving.setdefault(robot.name, moving)
                if message.topic == robot.scans:
                    self._take_scan(robot, message)
            for _ in range(len(self._waiting)):  # poses often come after their scans
                robot, waiting = self._waiting.popleft()
                self._take_scan(robot, waiting)
        except (InputError, *MESSAGE_ERRORS):
            self.counts["broken"] += 1

    def _take_scan(self, robot: RobotTopics, message: Message) -> None:
        kind, header = infer_kind(message.content), message.content.header
        if kind == OCCUPANCY_GRID:
            self.merger.set_grid(robot.name, read_grid(message), str(header.frame_id).strip("/"))
            self.counts["taken"] += 1
            return
        decode = {LASER_SCAN: decode_laser_scan, POINT_CLOUD: decode_point_cloud}[kind]
        frame, book = str(header.frame_id) or f"{robot.name} sensor", self._books[robot.name]
        found = book.find_pose(frame, read_time(header, message))
        if found is None and self._moving.get(robot.name):
            found = book.find_pose(self._moving[robot.name], read_time(header, message))  # taken as the same frame
        if found is None:
            if len(self._waiting) == WAITING:
                self.counts["without a pose"] += 1
            self._waiting.append((robot, message))
            return
        taken = self.merger.get_robot(robot.name, found[0]).add_scan(decode(LIVE_NAME, message)[0], found[1])
        self.counts["taken" if taken else "standing"] += 1


def read_grid(message: Message) -> PointCloud:
    """Read the walls and the floor of an occupancy grid.

    Raises:
        InputError: it holds none.
    """
    image, plan = decode_occupancy_grid(LIVE_NAME, message)
    occupied, free = classify(image, plan)
    pieces = [piece.points for piece in extrude(LIVE_NAME, occupied, free, plan, ReadOptions())]
    if not pieces:
        raise InputError("the grid shows nothing")
    return PointCloud(np.concatenate(pieces).astype(np.float32), upright=True)


def _build_transform(parent: str, child: str, pose: Any) -> dict[str, Any]:
    """A TransformStamped as JSON."""
    x, y, z = pose.translation
    turn = {"x": 0.0, "y": 0.0, "z": float(np.sin(pose.yaw / 2)), "w": float(np.cos(pose.yaw / 2))}
    header = {"stamp": {"sec": int(time.time()), "nanosec": 0}, "frame_id": parent}
    where = {"translation": {"x": x, "y": y, "z": z}, "rotation": turn}
    return {"header": header, "child_frame_id": child, "transform": where}
