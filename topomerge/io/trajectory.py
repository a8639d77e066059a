"""Where a sensor was, and when: trajectories as SLAM leaves them behind, and poses between two times.

KITTI: twelve numbers a line, the upper three rows of a pose, row by row; no times, one pose a scan. A `calib.txt` beside it
with a line `Tr:` says that the poses are a camera's: they become those of the laser, in the frame of the first laser pose.
TUM: `time tx ty tz qx qy qz qw` a line, seconds, metres.
Sources: the development kit of the KITTI odometry benchmark; https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from topomerge.errors import InputError
from topomerge.io.piece import leads_outside, refuse_pointer
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

    def gap(self, times: Array) -> Array:
        """(n,) s from each of the (n,) times to the nearest pose."""
        assert self.times is not None
        after = np.clip(np.searchsorted(self.times, times), 1, max(len(self) - 1, 1))
        last = np.minimum(after, len(self) - 1)
        nearest: Array = np.minimum(np.abs(times - self.times[after - 1]), np.abs(times - self.times[last]))
        return nearest

    def at(self, times: Array) -> Array:
        """(n, 4, 4) poses at (n,) times: between the two around each, turned and moved evenly; the first and last hold on."""
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
    """A trajectory in the format of KITTI or TUM, by how many numbers stand in a line.

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
        lines = _wanted_rows(path, scans, last)
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
    return _kitti(path, numbers, rows) if rows.shape[1] == KITTI_NUMBERS else _tum(path, numbers, rows)


def _wanted_rows(path: Path, scans: int | None, last: int) -> list[tuple[int, Array]]:
    lines: list[tuple[int, Array]] = []
    for number, row in number_rows(path, POSE_NUMBERS):
        if scans is not None:
            if len(row) == KITTI_NUMBERS and len(lines) >= max(scans, last + 1) + SPARE_POSES:
                break
            if len(row) == TUM_NUMBERS and len(lines) >= SPARE_TIMES + POSES_PER_SCAN * scans:
                many = f"more than {len(lines):,} poses for {scans:,} scans"
                raise InputError(f"{path}: has {many}; give the trajectory of these scans, or keep fewer poses a second")
        lines.append((number, np.array(row)))
    return lines


def number_rows(path: Path, widths: Mapping[int, str]) -> Iterator[tuple[int, list[float]]]:
    """(number, values) of each line of a text file; behind # stand comments.

    Args:
        widths: how many numbers a line may have -> what such a file is called; all lines have as many as the first.

    Raises:
        InputError: a line with other words than finite numbers, or with more or fewer; with the number of the line.
    """
    width = 0
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        for number, line in enumerate(stream, 1):
            words = line.split("#", 1)[0].replace(",", " ").split()
            if not words:
                continue
            try:
                row = [float(word) for word in words]
            except ValueError as error:
                shown = "" if leads_outside(path) else f" ({line.strip()[:40]!r})"
                raise InputError(f"{path}: line {number} is not a row of numbers{shown}; mend or remove it") from error
            width = width or len(row)
            if len(row) != width or width not in widths:
                said = ", one of ".join(f"{name} has {count}" for count, name in widths.items())
                raise InputError(f"{path}: line {number} has {len(row)} numbers; a line of {said}: give the trajectory like that")
            if not (np.abs(row) < BEYOND).all():  # so of nan, too
                wrong = f"line {number} holds a number that is not finite, or beyond {BEYOND:g}"
                raise InputError(f"{path}: {wrong}; mend it, or remove it with its scan")
            yield number, row


def _kitti(path: Path, numbers: Array, rows: Array) -> Trajectory:
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    bad = no_rotations(poses)
    if len(bad):
        raise InputError(f"{path}: line {numbers[bad[0]]} is not a rotation and a place (three rows of four numbers); mend it")
    calibration = path.with_name("calib.txt")
    laser = _laser_in_camera(calibration) if calibration.is_file() else None
    if laser is not None:
        poses = np.linalg.inv(laser) @ poses @ laser
    return Trajectory(poses)


def no_rotations(poses: Array) -> Array:
    """Rows of the poses whose upper left part turns nothing, or mirrors."""
    turns = poses[:, :3, :3]
    small = np.abs(turns) <= 1.0 + UNIT_TOLERANCE  # others may be too large to be multiplied, or no numbers
    turning: Array = np.logical_and.reduce(small, axis=(1, 2))
    fits = turns[turning]
    off = np.abs(fits @ fits.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    turning[turning] = (off <= UNIT_TOLERANCE) & (np.linalg.det(fits) > 0)
    rows: Array = np.flatnonzero(~turning)
    return rows


def _laser_in_camera(path: Path) -> Array | None:
    """(4, 4) Tr of a KITTI calibration, laser into camera; None where it has none."""
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        name, _, text = line.partition(":")
        if name.strip() not in ("Tr", "Tr_velo_to_cam"):
            continue
        try:
            matrix = np.vstack([np.array(text.split(), float).reshape(3, 4), (0, 0, 0, 1)])
        except ValueError as error:
            raise InputError(f"{path}: line {number} has not the twelve numbers of Tr; mend it, or remove the file") from error
        if not np.isfinite(matrix).all() or len(no_rotations(matrix[None])):
            raise InputError(f"{path}: line {number} is not a rotation and a place; mend it, or remove the file")
        return matrix
    return None


def _tum(path: Path, numbers: Array, rows: Array) -> Trajectory:
    times = rows[:, 0]
    back = np.flatnonzero(np.diff(times) < 0)
    if len(back):
        line, now, before = numbers[back[0] + 1], times[back[0] + 1], times[back[0]]
        raise InputError(f"{path}: the clock runs backwards at line {line} ({now:.3f} after {before:.3f}); sort or cut the file")
    off = np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1) > UNIT_TOLERANCE
    if off.any():
        where = numbers[int(np.argmax(off))]
        raise InputError(f"{path}: line {where} has no unit quaternion qx qy qz qw; is it time tx ty tz qx qy qz qw?")
    return Trajectory(pose_matrices(rows[:, 1:4], rows[:, 4:]), times)


def pose_matrices(places: Array, quaternions: Array) -> Array:
    """(n, 4, 4) poses from (n, 3) places and (n, 4) quaternions x, y, z, w that are not zero."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    poses[:, :3, 3] = places
    return poses
