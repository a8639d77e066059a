"""From messages of robots to maps that are joined: what comes is put into the maps of `live`, what is found goes back.

Updates run beside the stream, one at a time, and leave most of the processor to it. A scan waits until it is known where its
frame stood: poses of frames, as messages tell them, stand in a `PoseBook`.
"""

from __future__ import annotations

import json
import logging
import time
from bisect import bisect_right
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
from topomerge.io.streams import MESSAGE_ERRORS, Received, infer_kind
from topomerge.progress import Stopwatch
from topomerge.types import PointCloud

log = logging.getLogger(__name__)
SHARED_POSES = ("/tf", "/tf_static")
WAITING = 40  # scans whose pose has not come yet
SAVING = 60.0  # s between two times that the state is written where nothing is to be told
SETTLED = 3  # scans of a robot after which its frame stays: until then the one above it may not have come yet
EVENTS_TOPIC, TRANSFORMS_TOPIC = "/topomerge/events", "/topomerge/transforms"
LIVE_NAME = Path("live")  # of what has no file
MOST_TRANSFORMS = 1000  # of a message


class PoseBook:
    """Where frames stood of late, as one robot or several tell it; only the newest poses are held.

    Args:
        owners: names of the robots that use it.
        held: samples of each frame.
    """

    GAP = 0.25  # s between a scan and the nearest pose, at most
    FRAMES = 500  # frames at most: a stranger may name any number

    def __init__(self, owners: tuple[str, ...] = (), held: int = 400) -> None:
        self.owners, self.held = owners, held
        self._edges: dict[str, tuple[str, list[tuple[float, Any]]]] = {}
        self._static: dict[str, tuple[str, Any]] = {}

    def add(self, parent: str, child: str, time: float, position: Any, turn: Any, static: bool = False) -> bool:
        """Take in where `child` stands in `parent`; False where it is no pose."""
        values = np.array([position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w], float)
        parent, child = parent.strip("/"), child.strip("/")
        known = child in self._edges or child in self._static
        if not np.isfinite(values).all() or not 0.9 < np.linalg.norm(values[3:]) < 1.1 or parent == child:
            return False
        if not known and len(self._edges) + len(self._static) >= self.FRAMES:
            return False
        from topomerge.io.trajectory import build_pose_matrices

        (matrix,) = build_pose_matrices(values[None, :3], values[None, 3:])
        if static:
            self._static[child] = parent, matrix
            return True
        _, samples = self._edges.get(child, (parent, []))
        samples = [s for s in samples[-self.held :] if s[0] < time]
        self._edges[child] = parent, [*samples, (time, matrix)]
        return True

    def find_step(self, child: str, time: float) -> tuple[str, Any, bool] | None:
        """Find the parent of a frame, its (4, 4) pose in it, None where there is none near that time, and whether it moves.

        None: the frame is not in the book.
        """
        from topomerge.io.trajectory import Trajectory

        if child in self._static:
            return *self._static[child], False
        if child not in self._edges:
            return None
        parent, samples = self._edges[child]
        after = bisect_right(samples, time, key=lambda sample: sample[0])
        around = samples[max(after - 1, 0) : after + 1]  # two of hundreds: this is asked for with every scan
        track = Trajectory(np.array([m for _, m in around]), np.array([t for t, _ in around]))
        if time > samples[-1][0] or track.measure_gap(np.array([time]))[0] > self.GAP:
            return parent, None, True  # a newer one is on its way: the robot has moved since the last one
        return parent, track.interpolate(np.array([time]))[0], True


@dataclass(frozen=True)
class FramePose:
    """Where a frame stood.

    Args:
        frame: the topmost one; `pose`: (4, 4) in it.
        moved: of each book that had a part in it, the first frame that moved.
    """

    frame: str
    pose: Any
    moved: Mapping[PoseBook, str]


@dataclass(frozen=True)
class RobotTopics:
    """The topics that a robot sends.

    Args:
        scans: topic of scans, clouds or grids.
        poses: topics of its poses.
    """

    name: str
    scans: str
    poses: tuple[str, ...] = SHARED_POSES


class MixedPosesError(InputError):
    """Poses of two robots come under one name."""


def parse_robot(text: str) -> RobotTopics:
    """Parse ``NAME=SCANS[,POSES...]``. Transforms of a topic of its own, as ``/a/tf``, come in place of those of all robots.

    Raises:
        InputError: it is something else.
    """
    name, sign, listed = text.partition("=")
    topics = [topic.strip().strip("/") for topic in listed.split(",")]
    if not (name and sign and all(topics)):
        raise InputError(f"robot {text}: must be NAME=SCANS[,POSES], as a=/a/scan,/a/odom")
    scans, *poses = [f"/{topic}" for topic in topics]
    own = [topic for topic in poses if topic.endswith("/tf")]
    return RobotTopics(name, scans, tuple(dict.fromkeys((*poses, *([f"{topic}_static" for topic in own] or SHARED_POSES)))))


def parse_robots(texts: Sequence[str]) -> list[RobotTopics]:
    """Parse the robots, each as `parse_robot`.

    Raises:
        InputError: none, or two that have one name or one topic of scans.
    """
    robots = [parse_robot(text) for text in texts]
    if not robots:
        raise InputError("robots: name them: NAME=SCANS[,POSES], as a=/a/scan,/a/odom")
    if len({robot.name for robot in robots}) < len(robots):
        raise InputError("robots: two have one name; give each its own")
    if len({robot.scans for robot in robots}) < len(robots):
        raise InputError("robots: two have one topic of scans; give each its own")
    return robots


@dataclass(eq=False)
class Bridge:
    """Puts messages into maps.

    Args:
        every: s between two updates, at least.
        share: of a core that updates may take.
        counts: messages by what became of them: taken, standing (the robot had not moved), without a pose, broken, dropped.
        outbox: operations for rosbridge that wait.
    """

    merger: LiveMerger
    robots: Sequence[RobotTopics]
    tell: Callable[[Mapping[str, Any]], None]
    every: float = 5.0
    share: float = 0.25
    counts: Counter[str] = field(default_factory=Counter)
    outbox: deque[Mapping[str, Any]] = field(default_factory=lambda: deque(maxlen=200))

    def __post_init__(self) -> None:
        owners = {
            topic: tuple(robot.name for robot in self.robots if topic in robot.poses)
            for robot in self.robots
            for topic in robot.poses
        }
        books = {names: PoseBook(names) for names in owners.values()}
        self._books = {topic: books[names] for topic, names in owners.items()}
        self._own_books = {  # those of the fewest robots count first
            robot.name: sorted((b for b in books.values() if robot.name in b.owners), key=lambda b: len(b.owners))
            for robot in self.robots
        }
        self._moving: dict[str, str] = {}
        self._movers: dict[tuple[PoseBook, str], str] = {}
        self._mixed = False
        self._told: set[str] = set()
        self._waiting: deque[tuple[RobotTopics, Message]] = deque(maxlen=WAITING)
        self._free, self._since_saved = 0.0, Stopwatch()
        self._transforms = self._build_transforms()
        for robot in self.robots:
            self.merger.get_robot(robot.name)

    def list_topics(self) -> list[str]:
        """List all topics that are read."""
        return list(dict.fromkeys(t for robot in self.robots for t in (robot.scans, *robot.poses)))

    def greet(self) -> list[Mapping[str, Any]]:
        """List the operations for a rosbridge that was just connected: what is published, and the transforms that hold."""
        kinds = {EVENTS_TOPIC: "std_msgs/String", TRANSFORMS_TOPIC: "tf2_msgs/TFMessage"}
        topics = [
            {"op": "advertise", "topic": topic, "type": of, "latch": topic == TRANSFORMS_TOPIC} for topic, of in kinds.items()
        ]
        return [*topics, *([self._transforms] if self._transforms["msg"]["transforms"] else [])]

    def run(self, source: Received) -> None:
        """Go through a stream to its end, or until an interrupt; the state is written either way.

        Raises:
            MixedPosesError: poses of two robots come under one name; the state stays as it was written last.
        """
        try:
            with ThreadPoolExecutor(1, "update") as workers:
                self._go_through(source, workers)
            self._finish(self.merger.update(), 0.0)
        finally:
            self._save()

    def _go_through(self, source: Received, workers: ThreadPoolExecutor) -> None:
        running: Future[list[dict[str, Any]]] | None = None
        watch = Stopwatch()
        try:
            for message in source:
                if message is not None:
                    self.take(message)
                if running is not None and running.done():
                    done, running = running, None
                    self._finish(done.result(), watch.elapsed)
                if running is None and time.monotonic() >= self._free and (clouds := self.merger.take_changed()):
                    watch = Stopwatch()
                    running = workers.submit(self.merger.update, clouds)
        finally:
            if running is not None:
                self._finish(running.result(), 0.0)

    def _finish(self, events: Sequence[Mapping[str, Any]], took: float) -> None:
        """Tell what an update found."""
        self._free = time.monotonic() + max(self.every, took * (1 / self.share - 1))
        self._tell_all(events)
        if events:
            self._transforms = self._build_transforms()
            self.outbox.append(self._transforms)
        if events or self._since_saved.elapsed > SAVING:
            self._save()

    def _save(self) -> None:
        if not self._mixed:
            self.merger.save()
            self._since_saved = Stopwatch()

    def _tell_all(self, events: Sequence[Mapping[str, Any]]) -> None:
        for event in events:
            self.tell(event)
            self.outbox.append({"op": "publish", "topic": EVENTS_TOPIC, "msg": {"data": json.dumps(event)}})

    def _build_transforms(self) -> Mapping[str, Any]:
        transforms = [_build_transform(*edge) for edge in self.merger.list_transforms()]
        return {"op": "publish", "topic": TRANSFORMS_TOPIC, "msg": {"transforms": transforms}}

    def take(self, message: Message) -> None:
        """Put a message where it belongs; one that can't be used is counted.

        Raises:
            MixedPosesError: poses of two robots come under one name.
        """
        try:
            if message.topic in self._books:
                book = self._books[message.topic]
                moving = take_poses(book, message, f"{' '.join(book.owners)} sensor")
                if len(book.owners) == 1:
                    self._moving.setdefault(book.owners[0], moving)
            for robot in self.robots:
                if message.topic == robot.scans:
                    self._take_scan(robot, message)
            for _ in range(len(self._waiting)):  # poses often come after their scans
                robot, waiting = self._waiting.popleft()
                self._take_scan(robot, waiting)
        except MixedPosesError:
            raise
        except (InputError, *MESSAGE_ERRORS):
            self.counts["broken"] += 1

    def _take_scan(self, robot: RobotTopics, message: Message) -> None:
        kind, header = infer_kind(message.content), message.content.header
        if kind == OCCUPANCY_GRID:
            self.merger.set_grid(robot.name, read_grid(message), str(header.frame_id).strip("/"))
            self.counts["taken"] += 1
            return
        decode = {LASER_SCAN: decode_laser_scan, POINT_CLOUD: decode_point_cloud}[kind]
        found = self._find_pose(robot, str(header.frame_id), read_time(header, message))
        if found is None:
            if len(self._waiting) == WAITING:
                self.counts["without a pose"] += 1
            self._waiting.append((robot, message))
            return
        growing = self.merger.get_robot(robot.name, found.frame)
        taken = growing.add_scan(decode(LIVE_NAME, message)[0], found.pose)
        self.counts["taken" if taken else "standing"] += 1
        if growing.left_out and f"{robot.name} full" not in self._told:
            self._told.add(f"{robot.name} full")
            self._tell_all([{"event": "full", "robots": [robot.name], "points": len(growing.points)}])

    def _find_pose(self, robot: RobotTopics, frame: str, when: float) -> FramePose | None:
        """Return where a frame of a robot stood, in that in which its map grows."""
        growing, books = self.merger.get_robot(robot.name), self._own_books[robot.name]
        top = growing.frame if len(growing.poses) >= SETTLED else ""
        found = find_pose(books, frame or f"{robot.name} sensor", when, top)
        if found is None and self._moving.get(robot.name):
            found = find_pose(books, self._moving[robot.name], when, top)  # taken as the same frame
        if found is None:
            return None
        for book, moved in found.moved.items():
            if len(book.owners) > 1:
                other = self._movers.setdefault((book, moved), robot.name)
                if other != robot.name:
                    self._mixed = True
                    raise MixedPosesError(
                        f"robots {other} and {robot.name}: poses of both come as those of {moved!r}, and can't be told apart; "
                        f"name topics of their own, as {other}=/{other}/scan,/{other}/tf, or give their frames names of their own"
                    )
                break
        if top and found.frame != top:
            if f"{robot.name} elsewhere" not in self._told:
                self._told.add(f"{robot.name} elsewhere")
                log.warning(
                    "robot %s: poses are in %r, its map in %r; scans wait for poses in that", robot.name, found.frame, top
                )
            return None
        return found


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
    """Build a TransformStamped as JSON."""
    x, y, z = pose.translation
    turn = {"x": 0.0, "y": 0.0, "z": float(np.sin(pose.yaw / 2)), "w": float(np.cos(pose.yaw / 2))}
    header = {"stamp": {"sec": int(time.time()), "nanosec": 0}, "frame_id": parent}
    where = {"translation": {"x": x, "y": y, "z": z}, "rotation": turn}
    return {"header": header, "child_frame_id": child, "transform": where}


def find_pose(books: Sequence[PoseBook], frame: str, time: float, top: str = "") -> FramePose | None:
    """Find where a frame stood; None where it is not known at that time yet.

    Args:
        books: of which the first one that has a frame counts.
        top: frame at which the way up ends, where it comes by it.
    """
    name, pose, moved = frame.strip("/"), np.eye(4), dict[PoseBook, str]()
    for _ in range(32):
        if name == top:
            break
        book, step = next(((b, found) for b in books if (found := b.find_step(name, time)) is not None), (None, None))
        if book is None or step is None:
            break
        parent, matrix, moving = step
        if matrix is None:
            return None
        if moving:
            moved.setdefault(book, name)
        name, pose = parent, matrix @ pose
    return FramePose(name, pose, moved) if moved else None


def take_poses(book: PoseBook, message: Message, fallback: str) -> str:
    """Take the poses of a message of transforms, odometry or poses into a book.

    Args:
        fallback: frame that moves, where the message names none.

    Returns:
        The frame that moves; empty where it holds no pose that can be used.
    """
    content = message.content
    if hasattr(content, "transforms"):
        static, taken = message.topic.endswith("tf_static"), ""
        for one in content.transforms[:MOST_TRANSFORMS]:
            where, child = one.transform, str(one.child_frame_id)
            good = book.add(
                str(one.header.frame_id), child, read_time(one.header, message), where.translation, where.rotation, static
            )
            taken = child if good and not static else taken
        return taken
    pose = content.pose.pose if hasattr(content.pose, "pose") else content.pose
    child = str(getattr(content, "child_frame_id", "")) or fallback
    time = read_time(content.header, message)
    return child if book.add(str(content.header.frame_id), child, time, pose.position, pose.orientation) else ""


def read_time(header: Any, message: Message) -> float:
    """Read the time of a header, s; that of the recording where it has none."""
    stamp = header.stamp
    time = float(stamp.sec) + float(stamp.nanosec) * 1e-9
    return time if time else message.recorded
