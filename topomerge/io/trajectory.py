"""Where a sensor was, and when: trajectories as SLAM leaves them behind, and poses between two times.

KITTI: twelve numbers a line, the upper three rows of a pose, row by row; no times, one pose a scan. A `calib.txt` beside it
with a line `Tr:` says that the poses are a camera's: they become those of the laser, in the frame of the first laser pose.
TUM: `time tx ty tz qx qy qz qw` a line, seconds, metres.
Sources: the development kit of the KITTI odometry benchmark; https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from topomerge.archive import refuse_pointer
from topomerge.errors import InputError
from topomerge.io.piece import is_outside_link
from topomerge.types import Array

KITTI_NUMBERS, TUM_NUMBERS = 12, 8  # a line
POSE_NUMBERS = {KITTI_NUMBERS: "KITTI", TUM_NUMBERS: "TUM"}
SPARE_POSES = 1000  # lines beyond those that numbered scans can need, so that a message can count them
SPARE_TIMES, POSES_PER_SCAN = 200_000, 10_000  # lines with times: 20 minutes at 200 Hz, and of 50 s more for each scan
LONGEST_GAP = 0.2  # s between a scan and the nearest pose
BEYOND = 1e30  # of any number: larger ones are as good as infinite
BACKWARD = 1.0  # s: by less, messages may be out of order; by more the clock was set back
UNIT_TOLERANCE = 0.05  # of a quaternion's length and of the product of a rotation with its transpose


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses (K, 4, 4) of a sensor in a fixed frame, and their times (K,) in ascending order, s; None: no times are known."""

    poses: Array
    times: Array | None = None

    def __len__(self) -> int:
        return len(self.poses)

    @cached_property
    def _turns(self) -> tuple[Array, Array]:
        """(K, 3, 3) rotations of the poses, and (K, 3) rotation vectors from each to the next, 0 of the last."""
        rotations = Rotation.from_matrix(self.poses[:, :3, :3])
        steps = np.zeros((len(self), 3))
        if len(self) > 1:
            steps[:-1] = (rotations[:-1].inv() * rotations[1:]).as_rotvec()
        return rotations.as_matrix(), steps

    def measure_gap(self, times: Array) -> Array:
        """Measure the time, s, from each of the (n,) times to the nearest pose."""
        assert self.times is not None
        after = np.clip(np.searchsorted(self.times, times), 1, max(len(self) - 1, 1))
        last = np.minimum(after, len(self) - 1)
        nearest: Array = np.minimum(np.abs(times - self.times[after - 1]), np.abs(times - self.times[last]))
        return nearest

    def interpolate(self, times: Array) -> Array:
        """Return (n, 4, 4) poses at (n,) times: between the two around each, turned and moved evenly; the first and last hold
        on.
        """
        assert self.times is not None
        last = np.clip(np.searchsorted(self.times, times, side="right"), 1, max(len(self) - 1, 1))
        before, after = last - 1, np.minimum(last, len(self) - 1)
        span = self.times[after] - self.times[before]
        share = np.clip(np.divide(times - self.times[before], span, out=np.zeros(len(times)), where=span > 0), 0.0, 1.0)
        start, steps = self._turns
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, :3, :3] = start[before] @ Rotation.from_rotvec(steps[before] * share[:, None]).as_matrix()
        poses[:, :3, 3] = (1 - share[:, None]) * self.poses[before, :3, 3] + share[:, None] * self.poses[after, :3, 3]
        return poses


def read_trajectory(path: Path, scans: int | None = None, last: int = 0) -> Trajectory:
    """Read a trajectory in the format of KITTI or TUM, by how many numbers stand in a line.

    Args:
        path: of the file.
        scans: how many scans it is for, where that is known. Then no more lines are read than can be of use.
        last: the largest number of a scan, which counts lines of KITTI's from 0.

    Raises:
        InputError: it is neither, a number is missing or not finite, or time runs backwards; with the number of the line. Or far
            more poses than scans.
    """
    try:
        refuse_pointer(path)
        lines = _read_pose_rows(path, scans, last)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; --poses names a trajectory (KITTI or TUM)") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; --poses names a trajectory (KITTI or TUM)") from None
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror or error}); check its permissions") from error
    if not lines:
        raise InputError(f"{path}: holds no poses; give a trajectory with a line for each")
    numbers = np.array([number for number, _ in lines])
    rows = np.array([row for _, row in lines])
    return _parse_kitti(path, numbers, rows) if rows.shape[1] == KITTI_NUMBERS else _parse_tum(path, numbers, rows)


def _read_pose_rows(path: Path, scans: int | None, last: int) -> list[tuple[int, Array]]:
    lines: list[tuple[int, Array]] = []
    for number, row in iter_number_rows(path, POSE_NUMBERS):
        if scans is not None:
            if len(row) == KITTI_NUMBERS and len(lines) >= max(scans, last + 1) + SPARE_POSES:
                break
            if len(row) == TUM_NUMBERS and len(lines) >= SPARE_TIMES + POSES_PER_SCAN * scans:
                many = f"more than {len(lines):,} poses for {scans:,} scans"
                raise InputError(f"{path}: has {many}; give the trajectory of these scans, or keep fewer poses a second")
        lines.append((number, np.array(row)))
    return lines


def iter_number_rows(path: Path, widths: Mapping[int, str]) -> Iterator[tuple[int, list[float]]]:
    """Yield (number, values) of each line of a text file; behind # stand comments.

    Args:
        widths: how many numbers a line may have -> what such a file is called; all lines have as many as the first.

    Raises:
        InputError: a line with other words than finite numbers, or with more or fewer; with the number of the line.
    """
    width = 0
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        for number, line in enumerate(stream, 1):
            fields = line.split("#", 1)[0].replace(",", " ").split()
            if not fields:
                continue
            try:
                row = [float(word) for word in fields]
            except ValueError as error:
                shown = "" if is_outside_link(path) else f" ({line.strip()[:40]!r})"
                raise InputError(f"{path}: line {number} is not a row of numbers{shown}; mend or remove it") from error
            width = width or len(row)
            if len(row) != width or width not in widths:
                text = ", one of ".join(f"{name} has {count}" for count, name in widths.items())
                raise InputError(f"{path}: line {number} has {len(row)} numbers; a line of {text}: give the trajectory like that")
            if not (np.abs(row) < BEYOND).all():  # so of nan, too
                wrong = f"line {number} holds a number that is not finite, or beyond {BEYOND:g}"
                raise InputError(f"{path}: {wrong}; mend it, or remove it with its scan")
            yield number, row


def _parse_kitti(path: Path, numbers: Array, rows: Array) -> Trajectory:
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    bad = find_invalid_rotations(poses)
    if len(bad):
        raise InputError(f"{path}: line {numbers[bad[0]]} is not a rotation and a place (three rows of four numbers); mend it")
    calibration = path.with_name("calib.txt")
    laser = read_laser_calibration(calibration) if calibration.is_file() else None
    if laser is not None:
        poses = np.linalg.inv(laser) @ poses @ laser
    return Trajectory(poses)


def find_invalid_rotations(poses: Array) -> Array:
    """Find rows of the poses whose upper left part turns nothing, or mirrors."""
    turns = poses[:, :3, :3]
    small = np.abs(turns) <= 1.0 + UNIT_TOLERANCE  # others may be too large to be multiplied, or no numbers
    turning: Array = np.logical_and.reduce(small, axis=(1, 2))
    fits = turns[turning]
    off = np.abs(fits @ fits.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    turning[turning] = (off <= UNIT_TOLERANCE) & (np.linalg.det(fits) > 0)
    rows: Array = np.flatnonzero(~turning)
    return rows


def read_laser_calibration(path: Path) -> Array | None:
    """Read (4, 4) Tr of a KITTI calibration, laser into camera; None where it has none.

    Raises:
        InputError: it is not a rotation and a place.
    """
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        name, _, text = line.partition(":")
        if name.strip() not in ("Tr", "Tr_velo_to_cam"):
            continue
        try:
            matrix = np.vstack([np.array(text.split(), float).reshape(3, 4), (0, 0, 0, 1)])
        except ValueError as error:
            raise InputError(f"{path}: line {number} has not the twelve numbers of Tr; mend it, or remove the file") from error
        if not np.isfinite(matrix).all() or len(find_invalid_rotations(matrix[None])):
            raise InputError(f"{path}: line {number} is not a rotation and a place; mend it, or remove the file")
        return matrix
    return None


def _parse_tum(path: Path, numbers: Array, rows: Array) -> Trajectory:
    times = rows[:, 0]
    back = np.flatnonzero(np.diff(times) < 0)
    if len(back):
        line, now, before = numbers[back[0] + 1], times[back[0] + 1], times[back[0]]
        raise InputError(f"{path}: the clock runs backwards at line {line} ({now:.3f} after {before:.3f}); sort or cut the file")
    off = np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1) > UNIT_TOLERANCE
    if off.any():
        where = numbers[int(np.argmax(off))]
        raise InputError(f"{path}: line {where} has no unit quaternion qx qy qz qw; is it time tx ty tz qx qy qz qw?")
    return Trajectory(build_pose_matrices(rows[:, 1:4], rows[:, 4:]), times)


def build_pose_matrices(places: Array, quaternions: Array) -> Array:
    """Build (n, 4, 4) poses from (n, 3) places and (n, 4) quaternions x, y, z, w that are not zero."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    poses[:, :3, 3] = places
    return poses


WORLD_NAMES = ("map", "odom", "world", "camera_init")  # frames that stand still: points in them are placed already
SAMPLE_NUMBERS = 8
STILL = 1e-6  # m, and of a rotation's entries: an edge that changes by less does not move


@dataclass(eq=False)
class _FrameEdge:
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
        self.track = Trajectory(build_pose_matrices(rows[:, 1:4], rows[:, 4:]), rows[:, 0])
        self.moving = not self.static and bool((np.ptp(self.track.poses, axis=0) > STILL).any())
        if self.moving:
            self.reach = max(LONGEST_GAP, 2.0 * float(np.median(np.diff(rows[:, 0]))))


class FrameTree:
    """Frames by name; a leading slash does not count."""

    def __init__(self) -> None:
        self._edges: dict[str, _FrameEdge] = {}

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
            edge = self._edges[child] = _FrameEdge(parent, static)
        if edge.parent != parent:
            return f"puts the frame {child} into {parent}, and others put it into {edge.parent}"
        if sample[0] < edge.newest - BACKWARD and not static:
            return f"sets the clock back by {edge.newest - sample[0]:.1f} s {where}"
        edge.newest, edge.track = max(edge.newest, sample[0]), None
        edge.samples.extend(sample)
        return ""

    def forget(self, frame: str) -> None:
        """Forget where the frame stands."""
        self._edges.pop(frame, None)

    def list_rigid_chain(self, frame: str) -> list[str]:
        """List the frame and those above it that move with it."""
        names = [frame.strip("/")]
        for name in self.list_chain(frame)[1:]:
            if self._get_edge(names[-1]).moving:
                break
            names.append(name)
        return names

    def format_frames(self) -> list[str]:
        """Format the frames as ``child in parent``."""
        return [f"{child} in {edge.parent}" for child, edge in sorted(self._edges.items())]

    def _get_edge(self, child: str) -> _FrameEdge:
        edge = self._edges[child]
        if edge.track is None:
            edge.settle()
        return edge

    def list_chain(self, frame: str) -> list[str]:
        """List the frame and those above it, up to the one that stands in no other."""
        names = [frame.strip("/")]
        while names[-1] in self._edges and (above := self._edges[names[-1]].parent) not in names:
            names.append(above)
        return names

    def is_moving(self, frame: str) -> bool:
        """Return whether a frame, or one above it, moves."""
        return any(self._get_edge(name).moving for name in self.list_chain(frame) if name in self._edges)

    def find_moving_child(self, frame: str) -> str | None:
        """Find the one frame that moves in this one, or in the one that moves in it, and so on; None: none, or several."""
        name, seen = frame.strip("/"), {frame.strip("/")}
        while True:
            below = [child for child in self._edges if self._edges[child].parent == name and self._get_edge(child).moving]
            if len(below) != 1 or below[0] in seen:
                return name if name != frame.strip("/") and not below else None
            name = below[0]
            seen.add(name)

    def compute_pose(self, frame: str, time: float) -> Array | None:
        """Compute (4, 4) pose of a frame in the topmost one; None: no pose is known near that time."""
        pose = np.eye(4)
        when = np.array([time])
        for name in self.list_chain(frame):
            if name not in self._edges:
                continue
            edge = self._get_edge(name)
            assert edge.track is not None
            if edge.track.measure_gap(when)[0] > edge.reach:
                return None
            pose = edge.track.interpolate(when)[0] @ pose
        return pose
