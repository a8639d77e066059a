"""The tree of frames of a robot: which frame stands where in which other one, and when (what ROS calls tf)."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

import numpy as np

from topomerge.io.trajectory import BACKWARD, LONGEST_GAP, UNIT_TOLERANCE, Trajectory, pose_matrices
from topomerge.types import Array

WORLD_NAMES = ("map", "odom", "world", "camera_init")  # frames that stand still: points in them are placed already
SAMPLE_NUMBERS = 8
STILL = 1e-6  # m, and of a rotation's entries: an edge that changes by less does not move


@dataclass(eq=False)
class _Edge:
    """Samples of where a frame stands in its parent: time, x, y, z and quaternion x, y, z, w."""

    parent: str
    static: bool
    samples: array[float] = field(default_factory=lambda: array("d"))  # a tuple each would take four times the memory
    newest: float = -np.inf
    track: Trajectory | None = None
    moving: bool = False
    reach: float = np.inf  # s from the nearest sample, up to which the edge is believed

    def settle(self) -> None:
        """Make the track of all samples; of a static edge the last one counts."""
        rows = np.array(self.samples).reshape(-1, SAMPLE_NUMBERS)[-1 if self.static else 0 :]
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        self.track = Trajectory(pose_matrices(rows[:, 1:4], rows[:, 4:]), rows[:, 0])
        self.moving = not self.static and bool((np.ptp(self.track.poses, axis=0) > STILL).any())
        if self.moving:
            self.reach = max(LONGEST_GAP, 2.0 * float(np.median(np.diff(rows[:, 0]))))


class Frames:
    """Frames by name; a leading slash does not count."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}

    def add(self, parent: str, child: str, sample: tuple[float, ...], static: bool = False) -> str:
        """Take in where `child` stands in `parent`: (time s, x, y, z m, quaternion x, y, z, w).

        Returns:
            What is wrong with it; "": nothing.
        """
        parent, child = parent.strip("/"), child.strip("/")
        where = f"({child} in {parent})"
        if not np.isfinite(sample).all():
            return f"holds a pose that is not finite {where}"
        if abs(float(np.linalg.norm(sample[4:])) - 1) > UNIT_TOLERANCE:
            return f"holds a pose without a unit quaternion {where}"
        edge = self._edges.get(child)
        if edge is None:
            edge = self._edges[child] = _Edge(parent, static)
        if edge.parent != parent:
            return f"puts the frame {child} into {parent}, and others put it into {edge.parent}"
        if sample[0] < edge.newest - BACKWARD and not static:
            return f"sets the clock back by {edge.newest - sample[0]:.1f} s {where}"
        edge.newest, edge.track = max(edge.newest, sample[0]), None
        edge.samples.extend(sample)
        return ""

    def forget(self, frame: str) -> None:
        """Nothing is known of where the frame stands."""
        self._edges.pop(frame, None)

    def rigid(self, frame: str) -> list[str]:
        """The frame and those above it that move with it."""
        names = [frame.strip("/")]
        for name in self.chain(frame)[1:]:
            if self._edge(names[-1]).moving:
                break
            names.append(name)
        return names

    def names(self) -> list[str]:
        """What stands in what, as ``child in parent``."""
        return [f"{child} in {edge.parent}" for child, edge in sorted(self._edges.items())]

    def _edge(self, child: str) -> _Edge:
        edge = self._edges[child]
        if edge.track is None:
            edge.settle()
        return edge

    def chain(self, frame: str) -> list[str]:
        """The frame and those above it, up to the one that stands in no other."""
        names = [frame.strip("/")]
        while names[-1] in self._edges and (above := self._edges[names[-1]].parent) not in names:
            names.append(above)
        return names

    def moves(self, frame: str) -> bool:
        """Does it, or a frame above it, move?"""
        return any(self._edge(name).moving for name in self.chain(frame) if name in self._edges)

    def carried(self, frame: str) -> str | None:
        """The one frame that moves in this one, or in the one that moves in it, and so on; None: none, or several."""
        name, seen = frame.strip("/"), {frame.strip("/")}
        while True:
            below = [child for child in self._edges if self._edges[child].parent == name and self._edge(child).moving]
            if len(below) != 1 or below[0] in seen:
                return name if name != frame.strip("/") and not below else None
            name = below[0]
            seen.add(name)

    def at(self, frame: str, time: float) -> Array | None:
        """(4, 4) pose of a frame in the topmost one; None: no pose is known near that time."""
        pose = np.eye(4)
        when = np.array([time])
        for name in self.chain(frame):
            if name not in self._edges:
                continue
            edge = self._edge(name)
            assert edge.track is not None
            if edge.track.gap(when)[0] > edge.reach:
                return None
            pose = edge.track.at(when)[0] @ pose
        return pose
