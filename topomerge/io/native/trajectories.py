"""Trajectories written moved: KITTI, TUM, and the ground truth of EuRoC. Times and all else stay as they are written."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from topomerge.errors import InputError
from topomerge.io.native import Doubt, Source, Tally
from topomerge.io.trajectory import (
    KITTI_NUMBERS,
    TUM_NUMBERS,
    UNIT_TOLERANCE,
    build_pose_matrices,
    find_invalid_rotations,
    iter_number_rows,
    read_laser_calibration,
)
from topomerge.types import Array

EUROC_NUMBERS = (8, 11, 17)  # time (ns), place, quaternion w x y z; with velocity; with the biases of gyroscope and accelerometer
LEAST_DECIMALS = 9  # of a moved number: 1e-9 m; more where the file has more
LARGEST_TRAJECTORY = 1 << 28  # bytes
HEADER_LENGTH = 1 << 14  # letters that tell the format


def is_native(path: Path) -> bool:
    """Return whether a text file holds poses, and not points."""
    return _detect_layout(path) is not None


def join(sources: Sequence[Source], target: Path, doubt: Doubt) -> Tally:
    """Write one trajectory with its poses moved.

    Raises:
        InputError: a line is damaged, or the file too large.
    """
    del doubt
    (source,) = sources
    layout = _detect_layout(source.path)
    if layout is None:
        raise InputError(f"{source.path}: is no trajectory of KITTI, TUM or EuRoC; give one with a pose in each line")
    if source.path.stat().st_size > LARGEST_TRAJECTORY:
        raise InputError(f"{source.path}: has more than {LARGEST_TRAJECTORY >> 20} MB, too many for a trajectory; cut it")
    widths = {"KITTI": (KITTI_NUMBERS,), "TUM": (TUM_NUMBERS,), "EuRoC": EUROC_NUMBERS}[layout]
    listed = list(iter_number_rows(source.path, dict.fromkeys(widths, layout)))
    rows = np.array([row for _, row in listed])
    poses = _build_poses(source.path, layout, np.array([number for number, _ in listed]), rows)
    moved = _move(source, layout, poses)
    _write(source.path, target, layout, [number for number, _ in listed], _fill_rows(layout, rows, poses, moved))
    return Tally({"poses": (len(rows), len(rows))})


def _detect_layout(path: Path) -> str | None:
    """Return KITTI, TUM or EuRoC, by how many numbers stand in a line and by which of them are a rotation; None: neither."""
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        lines = stream.read(HEADER_LENGTH).splitlines(keepends=True)
    lines = lines[:-1] if len(lines) > 1 and not lines[-1].endswith("\n") else lines
    rows = []
    for line in lines:
        fields = line.split("#", 1)[0].replace(",", " ").split()
        try:
            rows += [[float(word) for word in fields]] if fields else []
        except ValueError:
            return None
    if not rows or len({len(row) for row in rows}) > 1:
        return None
    table, width = np.array(rows), len(rows[0])
    if not np.isfinite(table).all():
        return None
    if width == KITTI_NUMBERS:
        return None if len(find_invalid_rotations(_as_poses(table))) else "KITTI"
    if width not in EUROC_NUMBERS:
        return None
    units = (np.abs(np.linalg.norm(table[:, 4:8], axis=1) - 1) <= UNIT_TOLERANCE).all()
    euroc = path.suffix.lower() == ".csv" and (width != TUM_NUMBERS or bool((table[:, 0] > 1e15).all()))
    return ("EuRoC" if euroc else "TUM" if width == TUM_NUMBERS else None) if units else None


def _as_poses(rows: Array) -> Array:
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    return poses


def _build_poses(path: Path, layout: str, numbers: Array, rows: Array) -> Array:
    if layout == "KITTI":
        poses = _as_poses(rows)
        bad = find_invalid_rotations(poses)
    else:
        quaternions = rows[:, 4:8] if layout == "TUM" else rows[:, [5, 6, 7, 4]]
        bad = np.flatnonzero(np.abs(np.linalg.norm(quaternions, axis=1) - 1) > UNIT_TOLERANCE)
        poses = build_pose_matrices(rows[:, 1:4], quaternions) if not len(bad) else np.empty((0, 4, 4))
    if len(bad):
        raise InputError(f"{path}: line {numbers[bad[0]]} is not a rotation and a place; mend it")
    return poses


def _move(source: Source, layout: str, poses: Array) -> Array:
    """Return the poses in the joined frame. Those of a camera of KITTI are moved as what the scans are read with: as the
    laser's."""
    calibration = source.path.with_name("calib.txt")
    laser = read_laser_calibration(calibration) if layout == "KITTI" and calibration.is_file() else None
    if laser is None:
        return source.motion.move_poses(poses)
    back = np.linalg.inv(laser)
    moved: Array = laser @ source.motion.move_poses(back @ poses @ laser) @ back
    return moved


def _fill_rows(layout: str, rows: Array, poses: Array, moved: Array) -> Array:
    """Return the numbers of each line: poses, and the velocity of EuRoC, which is that in the fixed frame."""
    if layout == "KITTI":
        return moved[:, :3].reshape(-1, KITTI_NUMBERS)
    out = rows.copy()
    quaternions = Rotation.from_matrix(moved[:, :3, :3]).as_quat()
    columns = [4, 5, 6, 7] if layout == "TUM" else [5, 6, 7, 4]
    signs = np.sign((quaternions * rows[:, columns]).sum(axis=1, keepdims=True))
    out[:, columns] = quaternions * np.where(signs == 0, 1, signs)  # of the two that say the same, the nearer to what stood there
    out[:, 1:4] = moved[:, :3, 3]
    if rows.shape[1] > TUM_NUMBERS:
        turns = moved[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1)
        out[:, 8:11] = (turns @ rows[:, 8:11, None])[:, :, 0]
    return out


def _write(path: Path, target: Path, layout: str, numbers: list[int], rows: Array) -> None:
    """Write the lines of the source with other numbers: comments, separators, times and biases as they stand there."""
    fresh = dict(zip(numbers, rows, strict=True))
    ahead, behind = {"KITTI": (0, KITTI_NUMBERS), "TUM": (1, TUM_NUMBERS), "EuRoC": (1, 11)}[layout]
    with (
        path.open(encoding="utf-8-sig", errors="replace", newline="") as stream,
        target.open("w", encoding="utf-8", newline="") as out,
    ):
        for number, line in enumerate(stream, 1):
            if number not in fresh:
                out.write(line)
                continue
            body, mark, rest = line.partition("#")
            parts = re.split(r"([\s,]+)", body)  # words at even places unless the line begins with blanks
            elements = [k for k, part in enumerate(parts) if part and not re.fullmatch(r"[\s,]+", part)]
            for column, k in list(enumerate(elements))[ahead:behind]:
                parts[k] = format_number(parts[k], float(fresh[number][column]))
            out.write("".join(parts) + mark + rest)


def format_number(like: str, value: float) -> str:
    """Format a number as another one is written, with at least nine digits behind the point."""
    word = like.lower()
    digits = len(re.sub(r"e.*", "", word).partition(".")[2])
    return f"{value:.{max(digits, LEAST_DECIMALS)}{'e' if 'e' in word else 'f'}}"
