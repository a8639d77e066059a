"""Poses of robots while they come: where frames stood of late."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from topomerge.io.bag_file import Message

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
