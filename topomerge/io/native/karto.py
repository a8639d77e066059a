"""Pose graphs of slam_toolbox moved into the joined frame: poses of scans, their points and the ends of their links.

The files are copied, and only these numbers are written anew, where they stand. What is relative stays: odometry, ranges,
differences of links and their covariance. slam_toolbox's own tool for merging takes such files, and so does its localisation.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.io.karto import SCAN, BinaryArchive, Members, build_planar_pose, get_pose, read_karto_graph
from topomerge.io.native import NATIVE, Doubt, Motion, Source, Tally
from topomerge.types import Array


def join(sources: Sequence[Source], target: Path, doubt: Doubt) -> Tally:
    """Write a pose graph moved, and the data beside it.

    Raises:
        InputError: it is damaged, or its map is tilted.
    """
    (source,) = sources
    if not source.motion.level:
        raise InputError(f"{source.path}: is a pose graph in a plane, and its map is tilted; it can't be written truly")
    graph = read_karto_graph(source.path)
    for archive, path in zip(graph.archives, (target, target.with_suffix(NATIVE["karto"].companion)), strict=True):
        path.write_bytes(archive.data if source.motion.still else _move_archive(archive, source.motion))
    scans, links = len(graph.scans), len(graph.links)
    return Tally({"scans": (scans, scans), "links": (links, links)})


def _move_archive(archive: BinaryArchive, motion: Motion) -> bytes:
    data = bytearray(archive.data)
    for scan in archive.found[SCAN]:
        step = _move_pose(data, scan["pose"], motion)
        _write_numbers(data, scan["middle"]["place"]["@x"][0], _move_points(step, get_pose(scan["middle"])[:2])[0])
        for name in ("points", "all_points"):
            if len(scan[name]):
                moved = _move_points(step, scan[name])
                _write_numbers(data, scan[f"@{name}"][1] - moved.nbytes, moved.ravel())
        box = np.array([[scan["box"][end]["x"], scan["box"][end]["y"]] for end in ("low", "high")])
        if (box[0] <= box[1]).all():
            seen = scan["points"] if len(scan["points"]) else box
            ends = _move_points(step, np.concatenate([seen, [get_pose(scan["pose"])[:2]]]))
            for end, corner in (("low", ends.min(axis=0)), ("high", ends.max(axis=0))):
                _write_numbers(data, scan["box"][end]["@x"][0], corner)
    for link in archive.found["LinkInfo"]:
        for end in "ab":
            _move_pose(data, link[end], motion)
    return bytes(data)


def _move_pose(data: bytearray, pose: Members, motion: Motion) -> Array:
    """Move a Pose2 where it stands; the step (4, 4) that takes what was seen from there along."""
    before = build_planar_pose(*get_pose(pose))
    after = motion.move_poses(before[None])[0]
    turn = float(np.arctan2(after[1, 0], after[0, 0]))
    heading = pose["heading"] + (turn - pose["heading"] + np.pi) % (2 * np.pi) - np.pi
    _write_numbers(data, pose["place"]["@x"][0], after[:2, 3])
    _write_numbers(data, pose["@heading"][0], [heading])
    moved: Array = build_planar_pose(float(after[0, 3]), float(after[1, 3]), turn) @ np.linalg.inv(before)
    return moved


def _move_points(step: Array, points: Array | Sequence[float]) -> Array:
    """Move (n, 2) points of a plane; those that are not finite stay."""
    flat = np.atleast_2d(np.asarray(points, float))
    with np.errstate(invalid="ignore"):
        moved = flat @ step[:2, :2].T + step[:2, 3]
    return np.where(np.isfinite(flat).all(axis=1, keepdims=True), moved, flat)


def _write_numbers(data: bytearray, at: int, values: Array | Sequence[float]) -> None:
    struct.pack_into(f"<{len(values)}d", data, at, *values)
