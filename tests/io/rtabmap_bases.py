"""Writer of small true databases of RTAB-Map, in the layouts of its versions."""

from __future__ import annotations

import sqlite3
import struct
import zlib
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from tests.io.rgbd import CAMERA, SHAPE

OPTICAL = np.array([[0.0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 0.3], [0, 0, 0, 1]])  # a camera on a robot: z of it is ahead
LASER = np.array([[1.0, 0, 0, 0.05], [0, 1, 0, 0], [0, 0, 1, 0.2], [0, 0, 0, 1]])
TYPES = {"u1": 0, "i4": 4, "f4": 5, "f8": 6}  # of OpenCV
XY, XYZ, XYZI, XYZRGB = 1, 5, 6, 7  # formats of a scan


@dataclass(frozen=True, eq=False)
class Node:
    """What one node of the graph holds; pose of the robot."""

    pose: np.ndarray
    depth: bytes | None = None
    image: bytes | None = None
    calibration: bytes | None = None
    scan: bytes | None = None
    scan_info: bytes | None = None
    map: int = 0
    label: str | None = None
    sensors: Sequence[tuple[float, float, float]] = ()  # kind, value, time
    user_data: bytes | None = None
    tags: Sequence[tuple[int, np.ndarray]] = ()  # number and pose on the robot


def pose_bytes(pose: np.ndarray) -> bytes:
    return pose[:3].astype("<f4").tobytes()


def packed(values: np.ndarray) -> bytes:
    """A matrix (rows, columns[, channels]) as RTAB-Map packs it."""
    values = values[..., None] if values.ndim == 2 else values
    kind = TYPES[values.dtype.str[1:]] + ((values.shape[2] - 1) << 3)
    return zlib.compress(values.tobytes()) + struct.pack("<3i", *values.shape[:2], kind)


def png(values: np.ndarray) -> bytes:
    """16 bits as they are; floats as the four bytes of a pixel."""
    stream = BytesIO()
    if values.dtype == np.float32:
        values = np.ascontiguousarray(values).view(np.uint8).reshape(*values.shape, 4)[..., [2, 1, 0, 3]]
    Image.fromarray(values).save(stream, "PNG")
    return stream.getvalue()


def camera_bytes(
    version: str, mounts: Sequence[np.ndarray], camera: np.ndarray = CAMERA, shape: tuple[int, int] = SHAPE
) -> bytes:
    """The cameras of a node. From 0.18 on with K, D, R and P."""
    (fx, fy), (cx, cy) = (camera[0, 0], camera[1, 1]), (camera[0, 2], camera[1, 2])
    if numbers(version) < (0, 18):
        rows = [struct.pack("<6f", fx, fy, cx, cy, shape[1], shape[0]) + pose_bytes(mount) for mount in mounts]
        return b"".join(rows)
    head = struct.pack("<11i", *numbers(version), 0, shape[1], shape[0], 9, 5, 9, 12, 12)
    doubles = np.concatenate([(2 * camera[:3, :3]).ravel(), np.zeros(5), np.eye(3).ravel(), camera[:3].ravel()])
    return b"".join(head + doubles.astype("<f8").tobytes() + pose_bytes(mount) for mount in mounts)


def stereo_bytes(version: str) -> bytes:
    if numbers(version) < (0, 18):
        return struct.pack("<7f", 500, 500, 320, 240, 0.1, 640, 480) + pose_bytes(OPTICAL)
    one = camera_bytes(version, [OPTICAL])
    return struct.pack("<10i", *numbers(version), 1, 0, 0, 0, 0, len(one), len(one)) + one + one


def scan_info_bytes(version: str, form: int, mount: np.ndarray) -> bytes:
    if numbers(version) >= (0, 18):
        return struct.pack("<7f", form, 0.1, 30, 0, 0, 0, 1000) + pose_bytes(mount)
    if numbers(version) >= (0, 16, 1):
        return struct.pack("<3f", 1000, 30, form) + pose_bytes(mount)
    return struct.pack("<2f", 1000, 30) + pose_bytes(mount)


def numbers(version: str) -> tuple[int, ...]:
    return tuple(int(n) for n in version.split("."))


def write_rtabmap(
    path: Path,
    nodes: Sequence[Node],
    version: str = "0.23.0",
    optimised: Sequence[np.ndarray | None] = (),
    tag: tuple[int, np.ndarray] = (5, np.eye(4)),
    parameters: str = "",
) -> Path:
    """A database of nodes 1, 2, …

    Args:
        optimised: poses of the first nodes (None: not in the graph); with them comes one of a landmark.
        tag: number and pose of that.
        parameters: of RTAB-Map, as it stores them.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    later = numbers(version) >= (0, 17)
    confidence = "depth_confidence BLOB, " if numbers(version) >= (0, 22) else ""
    with closing(sqlite3.connect(path)) as base:
        columns = "map_id INTEGER NOT NULL, weight INTEGER, stamp FLOAT, pose BLOB, label TEXT, env_sensors BLOB"
        base.execute(f"CREATE TABLE Node (id INTEGER NOT NULL, {columns}, PRIMARY KEY (id))")
        columns = f"image BLOB, depth BLOB, {confidence}calibration BLOB, scan BLOB, scan_info BLOB, user_data BLOB"
        base.execute(f"CREATE TABLE Data (id INTEGER NOT NULL, {columns}, PRIMARY KEY (id))")
        base.execute(f"CREATE TABLE Admin (version TEXT{', opt_ids BLOB, opt_poses BLOB' if later else ''})")
        columns = "to_id INTEGER NOT NULL, type INTEGER NOT NULL, information_matrix BLOB NOT NULL, transform BLOB"
        base.execute(f"CREATE TABLE Link (from_id INTEGER NOT NULL, {columns})")
        base.execute("CREATE TABLE Info (parameters TEXT)")
        base.execute("INSERT INTO Info VALUES (?)", (parameters,))
        base.execute("CREATE UNIQUE INDEX IDX_Node_id on Node (id)")
        base.execute("INSERT INTO Admin(version) VALUES (?)", (version,))
        for number, node in enumerate(nodes, 1):
            sensors = np.array(node.sensors, "<f8").tobytes() or None
            values = (number, node.map, 0, 100.0 + number, pose_bytes(node.pose), node.label, sensors)
            base.execute("INSERT INTO Node VALUES (?, ?, ?, ?, ?, ?, ?)", values)
            cells = (number, node.image, node.depth, node.calibration, node.scan, node.scan_info, node.user_data)
            names = "id, image, depth, calibration, scan, scan_info, user_data"
            base.execute(f"INSERT INTO Data({names}) VALUES (?, ?, ?, ?, ?, ?, ?)", cells)
            for seen, pose in node.tags:
                base.execute("INSERT INTO Link VALUES (?, ?, 8, ?, ?)", (number, -seen, np.eye(6).tobytes(), pose_bytes(pose)))
        present = [(number, pose) for number, pose in enumerate(optimised, 1) if pose is not None]
        if present:
            ids = np.array([[-tag[0], *(n for n, _ in present)]], "<i4")
            poses = np.concatenate([tag[1][:3].ravel(), *(p[:3].ravel() for _, p in present)])[None].astype("<f4")
            base.execute("UPDATE Admin SET opt_ids = ?, opt_poses = ?", (packed(ids), packed(poses)))
        base.commit()
    return path
