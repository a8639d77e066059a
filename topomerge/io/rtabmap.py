"""RTAB-Map databases: the laser scans or depth images of all nodes, each where the graph, when it was last optimised, puts it.

Read are laser scans with x y z, else depth images, else laser slices. Without optimised poses those of the odometry are taken,
if they are of one session. The file is opened for reading only, as one that nobody changes, and nothing in it is run.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

import numpy as np

from topomerge.errors import InputError
from topomerge.io import rtabmap_blobs as blobs
from topomerge.io.depth_images import Frame, posed_scans, read_color
from topomerge.io.options import ReadOptions
from topomerge.io.piece import Piece, damaged, read_head
from topomerge.io.posed import PosedScan, pieces
from topomerge.io.trajectory import no_rotations
from topomerge.types import Array

RTABMAP_KIND = "an RTAB-Map database"
OLDEST, NEWEST = (0, 11, 10), (0, 23)  # versions of the database that are read; of the newest, all corrections
OPTIMISED_SINCE = (0, 17)
BASE_TABLES = ("Node", "Data", "Admin")
Poses = dict[int, Array | None]  # (4, 4) of the robot, by node


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Points in the frame of the map, node by node."""
    del options
    read_head(path, RTABMAP_KIND, b"SQLite format 3\0", 100)
    for ending in ("-journal", "-wal"):
        beside = path.with_name(path.name + ending)
        if beside.is_file() and beside.stat().st_size:
            raise InputError(
                f"{path}: is being written, or was cut off ({beside.name} lies beside it); close RTAB-Map, or open it there once"
            )
    try:
        with closing(sqlite3.connect(f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1", uri=True)) as base:
            base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, blobs.LARGEST_BLOB)
            base.execute("PRAGMA trusted_schema = OFF")
            yield from _pieces(path, base)
    except sqlite3.Error as error:
        raise damaged(path, RTABMAP_KIND, error) from error


def _pieces(path: Path, base: sqlite3.Connection) -> Iterator[Piece]:
    version = _version(path, base)
    said: list[str] = []
    poses = _poses(path, base, version, said)
    kind = _kind(path, base, version)
    if kind == "depth":
        yield from pieces(posed_scans(path, _frames(path, base, version, poses), said), said)
    else:
        yield from pieces(_scans(path, base, version, poses, kind == "flat", said), said)


def _version(path: Path, base: sqlite3.Connection) -> tuple[int, ...]:
    """The version of RTAB-Map that laid the database out.

    Raises:
        InputError: it is none of RTAB-Map's, or one that is not read.
    """
    tables = dict(base.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
    if any(not re.match(r"(?i)\s*CREATE\s+TABLE\s", str(tables.get(name, ""))) for name in BASE_TABLES):
        raise InputError(f"{path}: is no RTAB-Map database (it has no tables {', '.join(BASE_TABLES)}); check the file's name")
    if any(re.search(r"(?i)\bAS\b", str(tables[name])) for name in BASE_TABLES):  # a few bytes would be gigabytes
        raise InputError(f"{path}: has a table that computes its columns, which RTAB-Map never has; copy the database again")
    text = str((base.execute("SELECT version FROM Admin").fetchone() or ("none",))[0])
    version = tuple(int(n) for n in re.findall(r"\d{1,9}", text)[:3])
    if version < OLDEST or version[:2] > NEWEST:
        able = f"{'.'.join(map(str, OLDEST))} to {'.'.join(map(str, NEWEST))}"
        raise InputError(
            f"{path}: is of version {text[:20]} of RTAB-Map, only {able} are read; bring it there with rtabmap-reprocess"
        )
    return version


def _poses(path: Path, base: sqlite3.Connection, version: tuple[int, ...], said: list[str]) -> Poses:
    """The pose of the robot at each node: optimised ones, else those of the odometry.

    Raises:
        InputError: no poses, or those of several sessions without optimised ones.
    """
    row = base.execute("SELECT opt_ids, opt_poses FROM Admin").fetchone() if version >= OPTIMISED_SINCE else None
    if row is not None and row[0] and row[1]:
        blobs.check_bytes(f"{path}: the optimised poses", *row)
        ids = blobs.matrix(row[0], f"{path}: opt_ids").ravel()
        numbers = blobs.matrix(row[1], f"{path}: opt_poses").ravel()
        if len(numbers) != blobs.POSE_NUMBERS * len(ids) or ids.dtype != np.int32 or numbers.dtype != np.float32:
            raise damaged(path, RTABMAP_KIND, f"{len(numbers):,} numbers of optimised poses for {len(ids):,} nodes")
        rows = numbers.reshape(-1, blobs.POSE_NUMBERS)
        poses: Poses = {int(i): blobs.pose_matrix(r) for i, r in zip(ids, rows, strict=True) if i > 0}  # below 0 are landmarks
    else:
        sessions = base.execute("SELECT COUNT(DISTINCT map_id) FROM Node").fetchone()[0]
        if sessions > 1:
            raise InputError(
                f"{path}: holds {sessions:,} sessions and no optimised poses that join them; open it in RTAB-Map and save it"
            )
        nodes = base.execute("SELECT id, pose FROM Node").fetchall()
        blobs.check_bytes(f"{path}: the poses", *(blob for _, blob in nodes))
        poses = {int(i): blobs.pose_of(blob) for i, blob in nodes}
        said.append("it has no optimised poses: those of the odometry are taken, which drift")
    for node, pose in poses.items():
        if pose is not None and len(no_rotations(pose[None])):
            raise InputError(
                f"{path}: node {node} has a pose that is not a rotation and a place; optimise the graph in RTAB-Map again"
            )
    return poses


def _kind(path: Path, base: sqlite3.Connection, version: tuple[int, ...]) -> str:
    """What to read: "spatial" or "flat" scans, or "depth", by the first node that has any.

    Raises:
        InputError: there is none of these.
    """
    flat = False
    for node, info, blob in base.execute("SELECT id, scan_info, scan FROM Data WHERE LENGTH(scan) > 4 ORDER BY id LIMIT 1"):
        blobs.check_bytes(f"{path}: node {node}", info, blob)
        form, _ = blobs.scan_format(info, version)
        channels = blobs.matrix(blob, f"{path}: the scan of node {node}").shape[2]
        flat = form in blobs.FLAT_SCANS or (form == 0 and channels in blobs.FLAT_CHANNELS)
        if not flat:
            return "spatial"
    if base.execute("SELECT 1 FROM Data WHERE LENGTH(depth) > 4 LIMIT 1").fetchone():
        return "depth"
    if flat:
        return "flat"
    raise InputError(f"{path}: holds neither laser scans nor depth images; record it with Mem/BinDataKept on")


def _scans(
    path: Path, base: sqlite3.Connection, version: tuple[int, ...], poses: Poses, flat: bool, said: list[str]
) -> Iterator[PosedScan]:
    """The laser scans of all nodes that have a pose."""
    count, lost = base.execute("SELECT COUNT(*) FROM Data WHERE LENGTH(scan) > 4").fetchone()[0], 0
    rows = base.execute("SELECT id, scan_info, scan FROM Data WHERE LENGTH(scan) > 4 ORDER BY id")
    for number, (node, info, blob) in enumerate(rows, 1):
        blobs.check_bytes(f"{path}: node {node}", info, blob)
        pose = poses.get(node)
        if pose is None:
            lost += 1
            continue
        form, mount = blobs.scan_format(info, version)
        points, colors = blobs.scan_points(blob, form, f"{path}: the scan of node {node}")
        yield PosedScan(points, pose @ mount, colors, done=number / count)
    if lost == count:
        raise InputError(f"{path}: none of its {count:,} scans has a pose; optimise the graph in RTAB-Map, and save it")
    if lost:
        said.append(f"{lost:,} of {count:,} scans have no pose and are left out")
    if flat:
        said.append("its scans are slices: it has no depth images, nor scans in space")


def _frames(path: Path, base: sqlite3.Connection, version: tuple[int, ...], poses: Poses) -> Iterator[Frame | None]:
    """The depth images of all nodes; those of several cameras lie side by side in one image."""
    count = base.execute("SELECT COUNT(*) FROM Data WHERE LENGTH(depth) > 4").fetchone()[0]
    rows = base.execute("SELECT id, calibration, depth, image FROM Data WHERE LENGTH(depth) > 4 ORDER BY id")
    for number, (node, calibration, blob, image) in enumerate(rows, 1):
        blobs.check_bytes(f"{path}: node {node}", calibration, blob, image)
        pose = poses.get(node)
        if pose is None:
            yield None
            continue
        what = f"{path}: the depth of node {node}"
        cameras = blobs.cameras(calibration or b"", version, f"{path}: node {node}")
        if not cameras:
            raise InputError(f"{path}: node {node} has a depth image and no camera; calibrate it, or mend the database")
        depth, metre = blobs.depth_values(blob, what)
        colors = read_color(image, f"{path}: the image of node {node}") if image and len(image) > 4 else None
        if depth.shape[1] % len(cameras):
            raise InputError(f"{what} is {depth.shape[1]} pixels wide, which {len(cameras)} cameras can't share; it is damaged")
        shown = _parts(colors, len(cameras))
        for camera, part, color in zip(cameras, _parts(depth, len(cameras)), shown, strict=True):
            assert part is not None
            yield Frame(what, part, camera.for_depth(part.shape, metre), pose @ camera.mount, color, done=number / count)


def _parts(image: Array | None, count: int) -> list[Array | None]:
    """An image of several cameras cut into that of each; None where there is none, or it can't be cut."""
    if image is None or image.shape[1] % count:
        return [None] * count
    return list(np.split(image, count, axis=1))
