"""Folders of scans with a trajectory, as LiDAR odometry and SLAM leave them behind.

Scans are PLY, PCD or KITTI's BIN (float32 x y z intensity), each in the frame of its sensor, in the folder or in one below it;
the trajectory is a file in the folder or beside the scans (`topomerge.io.trajectory`). Scans are matched with poses by the time
in their names, by their number, or in their order. PCD files that state their viewpoints need no trajectory.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.io import pcd, ply
from topomerge.io.depth_images import PosedScan, iter_pieces
from topomerge.io.piece import BLOCK_POINTS, Piece, ReadOptions, build_damage_error
from topomerge.io.trajectory import LONGEST_GAP, Trajectory, read_trajectory
from topomerge.types import Array

SCAN_SUFFIXES = (".ply", ".pcd", ".bin")
OTHER_CLOUDS = (".las", ".laz", ".e57", ".npy", ".npz", ".xyz", ".pts", ".asc")  # which know nothing of sensors, or all
BIN_ROW = 16  # bytes: x, y, z and intensity
# What GLIM, loop-closing systems, KISS-ICP and KISS-SLAM, FAST-LIO's followers and the KITTI benchmark call their trajectories;
# the better one first: after loop closure, and with times.
TRAJECTORY_NAMES = (
    *("traj_lidar.txt", "optimized_poses_tum.txt", "slam_poses_tum.txt", "*_poses_tum.txt", "*_tum.txt", "*.tum"),
    *("slam_poses_kitti.txt", "*_poses_kitti.txt", "poses.txt", "poses_tum.txt", "poses_kitti.txt", "*_kitti.txt"),
    *("trajectory.txt", "odom_lidar.txt", "groundtruth.txt"),
)
# Seconds of the epoch and their fraction, or the last number of a name with the fraction that follows a point.
NAME_TIME = re.compile(r"(?<!\d)(\d{9,10})[._](\d{1,9})\D*$|(\d+(?:\.\d+)?)\D*$")
EPOCH_UNITS = {19: 1e-9, 16: 1e-6, 13: 1e-3}  # s, by how many digits a time of our decades has
LAST_SCAN = 1_000_000  # number of a scan; lines for later ones are not looked for
INDEX_DIGITS = 8  # at most, of the number of a scan


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read the points of all scans in the frame of the trajectory, scan by scan."""
    scans = find_scans(path)
    trajectory_file = Path(options.poses) if options.poses else find_trajectory(path, scans[0].parent)
    if trajectory_file is None:
        yield from iter_pieces(_iter_viewpoint_scans(path, scans, options))
        return
    numbers = [int(t) for scan in scans if _is_numbered(scan) and (t := parse_name_time(scan.stem)) is not None]
    trajectory = read_trajectory(trajectory_file, len(scans), min(max(numbers, default=0), LAST_SCAN))
    poses, warnings = match_poses(path, scans, trajectory, trajectory_file)
    yield from iter_pieces(_iter_posed_scans(scans, poses, options), warnings)


def find_scans(path: Path) -> list[Path]:
    """Find the scans in a folder, or in the only folder below it that has some, in the order of their numbers.

    Raises:
        InputError: there are none, or of several kinds.
    """
    scans = _list_scans(path)
    if not scans:
        below = {p.name: s for p in sorted(path.iterdir()) if p.is_dir() and (s := _list_scans(p))}
        if len(below) > 1:
            raise InputError(f"{path}: holds several folders of scans ({', '.join(below)[:200]}); give one of them and --poses")
        scans = next(iter(below.values()), [])
    if not scans:
        others = Counter(p.suffix.lower() for p in path.iterdir() if p.suffix.lower() in OTHER_CLOUDS and p.is_file())
        if others:
            counts = ", ".join(f"{count} {kind[1:]}" for kind, count in others.most_common())
            raise InputError(f"{path}: holds no scans with poses but {counts}; give --one-frame, if they are parts of one cloud")
        raise InputError(
            f"{path}: is a folder without scans (ply, pcd, bin), a ROS bag or RGB-D images; give one of these, or a file"
        )
    kinds = Counter(scan.suffix.lower() for scan in scans)
    if len(kinds) > 1:
        counts = ", ".join(f"{count} {kind[1:]}" for kind, count in kinds.most_common())
        raise InputError(
            f"{path}: holds scans of several kinds ({counts}); give a folder with those of one sensor, or --one-frame, if "
            "they are parts of one cloud in one frame"
        )
    return scans


def _list_scans(folder: Path) -> list[Path]:
    scans = [p for p in folder.iterdir() if p.suffix.lower() in SCAN_SUFFIXES and not p.name.startswith(".") and p.is_file()]
    return sorted(scans, key=lambda p: ([int(n) for n in re.findall(r"\d+", p.stem)], p.name))


def find_trajectory(path: Path, beside: Path) -> Path | None:
    """Find the trajectory that belongs to the scans: in the folder that was given, among the scans, or beside their folder."""
    for folder in dict.fromkeys((path, beside, path.resolve().parent)):
        names = [p for p in sorted(folder.iterdir()) if p.suffix in (".txt", ".tum") and p.is_file()]
        for pattern in TRAJECTORY_NAMES:
            fitting = [p for p in names if fnmatch(p.name, pattern)]
            if len(fitting) > 1:
                shown = ", ".join(p.name for p in fitting)[:200]
                raise InputError(f"{path}: has several trajectories ({shown}); give --poses with one of them")
            if fitting:
                return fitting[0]
    return None


def parse_name_time(stem: str) -> float | None:
    """Parse the time (s) or the number that stands in the name of a scan, the suffix left out; None: neither.

    ``1570513628_110666000``, ``1570513628.110666`` and ``1570513628110666000`` are times, ``000017`` and ``scan_17`` numbers.
    """
    match = NAME_TIME.search(stem)
    if match is None:
        return None
    if match[1]:
        return float(f"{match[1]}.{match[2]}")
    return int(match[3]) * EPOCH_UNITS.get(len(match[3]), 1.0) if match[3].isdigit() else float(match[3])


def match_poses(folder: Path, scans: list[Path], trajectory: Trajectory, source: Path) -> tuple[list[Array | None], list[str]]:
    """Return the pose (4, 4) of each scan, None where there is none, and what the user should know.

    Raises:
        InputError: no pose belongs to a scan, or it can't be said which.
    """
    names = [parse_name_time(scan.stem) for scan in scans]
    times = None if None in names else np.array(names, float)
    numbered = all(map(_is_numbered, scans))
    if trajectory.times is not None and times is not None and not numbered:
        return _match_poses_by_time(folder, times, trajectory, source)
    if len(scans) == len(trajectory):
        return list(trajectory.poses), []
    if numbered and times is not None:
        whole = trajectory.times is None or bool((trajectory.times == np.rint(trajectory.times)).all())
        order = np.arange(len(trajectory)) if trajectory.times is None else trajectory.times
        rows = {int(number): row for row, number in enumerate(order.tolist())} if whole else {}
        poses = [trajectory.poses[rows[int(t)]] if int(t) in rows else None for t in times.tolist()]
        if len(scans) < len(trajectory) and all(p is not None for p in poses):
            return poses, []
    few = "fewer" if len(trajectory) < len(scans) else "more"
    raise InputError(
        f"{source}: has {len(trajectory):,} poses, {few} than the {len(scans):,} scans in {folder}, whose names have no times "
        f"({scans[0].name}); give the trajectory of these scans, or one with times and scans named by theirs"
    )


def _is_numbered(scan: Path) -> bool:
    """Return whether the name ends with a number that is no time."""
    match = NAME_TIME.search(scan.stem)
    return match is not None and match[1] is None and match[3].isdigit() and len(match[3]) <= INDEX_DIGITS


def _match_poses_by_time(
    folder: Path, times: Array, trajectory: Trajectory, source: Path
) -> tuple[list[Array | None], list[str]]:
    assert trajectory.times is not None
    near = trajectory.measure_gap(times) <= LONGEST_GAP
    if not near.any():
        first, last = trajectory.times[[0, -1]]
        raise InputError(
            f"{source}: its times ({first:.3f} to {last:.3f} s) are not those in the names of the scans in {folder} "
            f"({times.min():.3f} to {times.max():.3f} s); give the trajectory of these scans"
        )
    poses = [pose if ok else None for pose, ok in zip(trajectory.interpolate(times), near.tolist(), strict=True)]
    lost = int((~near).sum())
    text = f"{lost:,} of {len(times):,} scans are more than {LONGEST_GAP:g} s from any pose of {source.name} and are left out"
    return poses, [text] if lost else []


def _iter_posed_scans(scans: list[Path], poses: list[Array | None], options: ReadOptions) -> Iterator[PosedScan]:
    for number, (scan, pose) in enumerate(zip(scans, poses, strict=True), 1):
        for piece in _read_scan(scan, options) if pose is not None else ():
            yield PosedScan(piece.points, pose, piece.colors, done=number / len(scans))


def _iter_viewpoint_scans(path: Path, scans: list[Path], options: ReadOptions) -> Iterator[PosedScan]:
    """Yield scans in one frame, each with the place of the sensor in its own header."""
    for number, scan in enumerate(scans, 1):
        pose = None
        for piece in _read_scan(scan, options):
            pose = pose if piece.poses is None else piece.poses[0]
            if pose is None:
                raise InputError(
                    f"{path}: has no trajectory (such as poses.txt or traj_lidar.txt); give one with --poses, in the format of "
                    f"KITTI or TUM; or --one-frame, if the files are parts of one cloud in one frame; or name the files, if each "
                    f"is a map of its own"
                )
            yield PosedScan(piece.points, pose, piece.colors, True, number / len(scans))


def _read_scan(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Yield the blocks of one scan, whose file an error names."""
    readers = {".ply": ply.read, ".pcd": pcd.read, ".bin": _read_bin}
    try:
        yield from readers[path.suffix.lower()](path, replace(options, poses=None))
    except (InputError, MemoryError):
        raise
    except Exception as error:
        raise build_damage_error(path, "a scan", error) from error


def _read_bin(path: Path, options: ReadOptions) -> Iterator[Piece]:
    del options
    size = path.stat().st_size
    if size % BIN_ROW:
        raise InputError(
            f"{path}: has {size:,} bytes, no multiple of {BIN_ROW} (float32 x y z intensity); it is cut short, copy it again"
        )
    for start in range(0, size // BIN_ROW, BLOCK_POINTS):
        rows = np.fromfile(path, "<f4", 4 * BLOCK_POINTS, offset=start * BIN_ROW).reshape(-1, 4)
        yield Piece(rows[:, :3])
