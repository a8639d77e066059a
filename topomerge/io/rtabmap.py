"""Read databases of RTAB-Map."""

from __future__ import annotations

import re
import sqlite3
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from topomerge.errors import InputError
from topomerge.io.depth_images import Camera, Frame, PosedScan, iter_pieces, read_color, read_pixels
from topomerge.io.pictures import PictureReader, iter_frame_pieces
from topomerge.io.piece import Piece, ReadOptions, build_damage_error, read_head
from topomerge.io.sightings import MOST_SIGHTINGS, Sighting, clean_text, compute_heading, fuse_sightings
from topomerge.io.trajectory import find_invalid_rotations
from topomerge.types import Array, Landmarks, build_landmarks, join_landmarks

LARGEST_BLOB = 1 << 27  # bytes of a cell, packed or unpacked: an image of 32 megapixels of float depth
POSE_NUMBERS = 12  # of the upper three rows of a pose
MAT_TYPES = {0: "u1", 1: "i1", 2: "u2", 3: "i2", 4: "i4", 5: "f4", 6: "f8"}  # of an OpenCV matrix: the lowest three bits
MAT_TAIL = struct.Struct("<3i")  # rows, columns and type, behind the packed values
CAMERA_HEAD = struct.Struct("<11i")  # version (3), kind, width, height, numbers of K, D, R and P, and of the local transform
MONO, STEREO = 0, 1  # kinds of camera
SERIALIZED_SINCE = (0, 18)  # the version that writes cameras as its classes do, and scans with their angles
FORMAT_SINCE = (0, 16, 1)  # the version that says what the numbers of a scan are
RVL = b"DEPTHRVL"
FLAT_SCANS, SPATIAL_SCANS = range(1, 5), range(5, 12)  # formats with x y, and with x y z
FLAT_CHANNELS = (2, 5)  # of scans without a format: x y, or with a normal; others have x y z
COLORED_SCANS = (7, 10)  # formats whose fourth number holds colours
MILLIMETRES, METRES = 1000.0, 1.0  # values of depth in a metre: of 16 bits, and of floats


@dataclass(frozen=True, eq=False)
class MountedCamera:
    """A camera and its pose (4, 4) on the robot; `size` are the rows and columns that it is stated for, 0 where it is not."""

    focal: tuple[float, float]
    centre: tuple[float, float]
    size: tuple[int, int]
    mount: Array

    def scale_to_depth(self, shape: tuple[int, ...], metre: float) -> Camera:
        """Return the same for a depth image of a shape, which may be smaller than the colours that the camera is stated for."""
        share = [have / stated if stated else 1.0 for have, stated in zip(shape, self.size, strict=True)]
        (fx, fy), (cx, cy) = self.focal, self.centre
        return Camera((fx * share[1], fy * share[0]), (cx * share[1], cy * share[0]), metre)


def check_bytes(what: str, *cells: object) -> None:
    """Raise an InputError where a cell is neither empty nor bytes: text in an image's place would be taken for a file's name."""
    odd = next((cell for cell in cells if not isinstance(cell, bytes | None)), None)
    if odd is not None:
        raise InputError(f"{what} has text or a number where bytes belong ({type(odd).__name__}); it is damaged")


def decode_pose(blob: bytes | None) -> Array | None:
    """Decode (4, 4) float64 of twelve floats; None where it is empty or RTAB-Map's null: all zero, or not finite."""
    if blob is None or len(blob) != 4 * POSE_NUMBERS:
        return None
    return build_pose_matrix(np.frombuffer(blob, "<f4"))


def build_pose_matrix(numbers: Array) -> Array | None:
    """Build (4, 4) of twelve numbers; None where they are null."""
    if not np.isfinite(numbers).all() or not numbers.any():
        return None
    return np.vstack([numbers.reshape(3, 4).astype(np.float64), (0, 0, 0, 1)])


def decode_matrix(blob: bytes, what: str) -> Array:
    """Decode (rows, columns, channels) of a packed OpenCV matrix.

    Raises:
        InputError: it is cut short, damaged or too large.
    """
    if len(blob) < MAT_TAIL.size:
        raise InputError(f"{what} has {len(blob)} bytes, too few; it is damaged")
    rows, columns, kind = MAT_TAIL.unpack(blob[-MAT_TAIL.size :])
    name, channels = MAT_TYPES.get(kind & 7), (kind >> 3) + 1
    if name is None or min(rows, columns) < 0 or not 0 < channels <= 512:
        raise InputError(f"{what} is no matrix that can be read ({rows} x {columns}, type {kind}); it is damaged")
    size = rows * columns * channels * np.dtype(name).itemsize
    if size > LARGEST_BLOB:
        raise InputError(f"{what} would have {size:,} bytes, more than {LARGEST_BLOB:,}; it is damaged")
    try:
        data = zlib.decompressobj().decompress(blob[: -MAT_TAIL.size], max(size, 1))
    except zlib.error as error:
        raise InputError(f"{what} can't be unpacked ({error}); it is damaged") from error
    if len(data) != size:
        raise InputError(f"{what} has {len(data):,} of {size:,} bytes; it is cut short")
    return np.frombuffer(data, "<" + name).reshape(rows, columns, channels)


def decode_cameras(blob: bytes, version: tuple[int, ...], what: str) -> list[MountedCamera]:
    """Decode the cameras of a node, side by side in its images.

    Raises:
        InputError: they are a stereo pair, or can't be read.
    """
    if version < SERIALIZED_SINCE:
        numbers = np.frombuffer(blob, "<f4", len(blob) // 4).astype(np.float64)
        if len(numbers) == 7 + POSE_NUMBERS:
            raise _build_stereo_error(what)
        rows = numbers.reshape(-1, 6 + POSE_NUMBERS) if len(numbers) and len(numbers) % (6 + POSE_NUMBERS) == 0 else None
        if rows is None:
            raise InputError(f"{what} has a calibration of {len(blob)} bytes, which is no camera; it is damaged")
        return [_build_mounted_camera(r[:4], (int(r[5]), int(r[4])), r[6:], what) for r in rows]
    read = []
    while blob:
        if len(blob) < CAMERA_HEAD.size:
            raise InputError(f"{what} has a calibration that is cut short; it is damaged")
        _, _, _, kind, width, height, *counts = CAMERA_HEAD.unpack(blob[: CAMERA_HEAD.size])
        if kind == STEREO:
            raise _build_stereo_error(what)
        end = CAMERA_HEAD.size + 8 * sum(counts[:4]) + 4 * counts[4]
        fitting = all(count in able for count, able in zip(counts, ((9,), range(15), (0, 9), (0, 12), (0, 12)), strict=True))
        if kind != MONO or not fitting or len(blob) < end:
            raise InputError(f"{what} has a calibration that can't be read (kind {kind}, numbers {counts}); it is damaged")
        numbers = np.frombuffer(blob, "<f8", sum(counts[:4]), CAMERA_HEAD.size)
        plain = (
            numbers[-12:].reshape(3, 4) if counts[3] else numbers[:9].reshape(3, 3)
        )  # P, which is for images without distortion
        mount = np.frombuffer(blob, "<f4", counts[4], end - 4 * counts[4]) if counts[4] else np.eye(4)[:3].ravel()
        read.append(_build_mounted_camera((plain[0, 0], plain[1, 1], plain[0, 2], plain[1, 2]), (height, width), mount, what))
        blob = blob[end:]
    return read


def _build_mounted_camera(numbers: Array | tuple[float, ...], size: tuple[int, int], mount: Array, what: str) -> MountedCamera:
    fx, fy, cx, cy = (float(n) for n in numbers)
    pose = build_pose_matrix(np.asarray(mount))
    if not (np.isfinite((fx, fy, cx, cy)).all() and min(fx, fy) > 0 and min(size) >= 0) or pose is None:
        raise InputError(
            f"{what} has a camera that can't be used (focal lengths {fx:g} {fy:g}); calibrate it, or mend the database"
        )
    return MountedCamera((fx, fy), (cx, cy), size, pose)


def _build_stereo_error(what: str) -> InputError:
    return InputError(
        f"{what} has stereo images, whose depth is not computed; export its cloud from RTAB-Map, or use a camera of depth"
    )


def decode_scan_format(info: bytes | None, version: tuple[int, ...]) -> tuple[int, Array]:
    """Decode the format of a scan's numbers (0: not stated), and the pose (4, 4) of the laser on the robot."""
    numbers = np.frombuffer(info or b"", "<f4", len(info or b"") // 4)
    ahead = 7 if version >= SERIALIZED_SINCE else 3 if version >= FORMAT_SINCE and len(numbers) == 3 + POSE_NUMBERS else 2
    if len(numbers) != ahead + POSE_NUMBERS:
        return 0, np.eye(4)
    form = {7: numbers[0], 3: numbers[2]}.get(ahead, np.float32(0))
    mount = build_pose_matrix(numbers[ahead:])
    return int(form) if np.isfinite(form) else 0, np.eye(4) if mount is None else mount


def decode_scan_points(blob: bytes, form: int, what: str) -> tuple[Array, Array | None]:
    """Decode (n, 3) points of a laser scan in its own frame, and (n, 3) uint8 colours, or None.

    Raises:
        InputError: it can't be unpacked, or is in a format that is not known.
    """
    values = decode_matrix(blob, what)
    rows = values.reshape(-1, values.shape[2])
    channels = rows.shape[1]
    flat = form in FLAT_SCANS or (form == 0 and channels in FLAT_CHANNELS)
    if values.dtype != np.float32 or channels < (2 if flat else 3) or (form and form not in (*FLAT_SCANS, *SPATIAL_SCANS)):
        raise InputError(f"{what} is in a format that is not known ({form}, {channels} numbers a point); export it from RTAB-Map")
    points = np.zeros((len(rows), 3))
    with np.errstate(invalid="ignore"):  # a damaged number may be a nan that warns
        points[:, : 2 if flat else 3] = rows[:, : 2 if flat else 3]
    if form not in COLORED_SCANS or channels < 4:
        return points, None
    packed = np.ascontiguousarray(rows[:, 3]).view(np.uint32)
    return points, np.stack([(packed >> s) & 255 for s in (16, 8, 0)], axis=1).astype(np.uint8)


def decode_depth(blob: bytes, what: str) -> tuple[Array, float]:
    """Decode (h, w) of a depth image, and how many of its values are a metre.

    Raises:
        InputError: it is packed by RVL, or is no depth image.
    """
    if blob.startswith(RVL):
        raise InputError(
            f"{what} is packed by RVL, which is not read; store it as .png (Mem/DepthCompressionFormat) by rtabmap-reprocess"
        )
    image = read_pixels(blob, what)
    if image.ndim == 3 and image.shape[2] == 4 and image.dtype == np.uint8:  # floats in the bytes of blue, green, red, alpha
        return np.ascontiguousarray(image[..., [2, 1, 0, 3]]).view("<f4")[..., 0], METRES
    if image.ndim != 2 or image.dtype == np.uint8:
        raise InputError(f"{what} is no depth image of 16 or 32 bits; give a database of a camera of depth")
    return image, MILLIMETRES


RTABMAP_KIND = "an RTAB-Map database"
OLDEST, NEWEST = (0, 11, 10), (0, 23)  # versions of the database that are read; of the newest, all corrections
OPTIMISED_SINCE = (0, 17)
BASE_TABLES = ("Node", "Data", "Admin")
Poses = dict[int, Array | None]  # (4, 4) of the robot, by node


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Yield points in the frame of the map, node by node."""
    refuse_open_database(path)
    try:
        with closing(sqlite3.connect(build_read_address(path), uri=True)) as base:
            base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_BLOB)
            base.execute("PRAGMA trusted_schema = OFF")
            yield from _iter_pieces(path, base, options)
    except sqlite3.Error as error:
        raise build_damage_error(path, RTABMAP_KIND, error) from error


def refuse_open_database(path: Path) -> None:
    """Refuse a file that is no database, or one that is being written.

    Raises:
        InputError: it is one of these.
    """
    read_head(path, RTABMAP_KIND, b"SQLite format 3\0", 100)
    for ending in ("-journal", "-wal"):
        companion = path.with_name(path.name + ending)
        if companion.is_file() and companion.stat().st_size:
            raise InputError(
                f"{path}: is being written, or was cut off ({companion.name} lies beside it); close RTAB-Map, or open it "
                "there once"
            )


def build_read_address(path: Path) -> str:
    """Build the address by which SQLite opens a database that it must not change."""
    return f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"


def _iter_pieces(path: Path, base: sqlite3.Connection, options: ReadOptions) -> Iterator[Piece]:
    version = read_version(path, base)
    warnings: list[str] = []
    poses = read_poses(path, base, version, warnings)
    kind = _detect_kind(path, base, version)
    if kind == "depth":
        yield from iter_frame_pieces(path, _iter_frames(path, base, version, poses), warnings, options)
    else:
        yield from iter_pieces(_iter_scans(path, base, version, poses, kind == "flat", warnings), warnings)
        yield _read_pictures(path, base, version, poses, options)
    yield Piece(np.empty((0, 3)), landmarks=_read_landmarks(path, base, poses), done=1.0)


def _read_pictures(path: Path, base: sqlite3.Connection, version: tuple[int, ...], poses: Poses, options: ReadOptions) -> Piece:
    """Read the signs and tags on the pictures of a recording whose points are those of a laser."""
    reader = PictureReader(options.text, options.tag_size)
    if reader.reads_text:
        for frame in _iter_frames(path, base, version, poses, reader.is_due):
            if frame is not None and isinstance(frame.depth, np.ndarray) and not isinstance(frame.color, Path):
                reader.read_frame(frame, frame.depth, frame.color)
    landmarks = reader.collect()
    return Piece(np.empty((0, 3)), landmarks=landmarks, warnings=tuple(reader.warnings), done=1.0)


def read_version(path: Path, base: sqlite3.Connection) -> tuple[int, ...]:
    """Read the version of RTAB-Map that laid the database out.

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


def read_poses(path: Path, base: sqlite3.Connection, version: tuple[int, ...], warnings: list[str]) -> Poses:
    """Read the pose of the robot at each node: optimised ones, else those of the odometry.

    Raises:
        InputError: no poses, or those of several sessions without optimised ones.
    """
    row = base.execute("SELECT opt_ids, opt_poses FROM Admin").fetchone() if version >= OPTIMISED_SINCE else None
    if row is not None and row[0] and row[1]:
        check_bytes(f"{path}: the optimised poses", *row)
        ids = decode_matrix(row[0], f"{path}: opt_ids").ravel()
        numbers = decode_matrix(row[1], f"{path}: opt_poses").ravel()
        if len(numbers) != POSE_NUMBERS * len(ids) or ids.dtype != np.int32 or numbers.dtype != np.float32:
            raise build_damage_error(path, RTABMAP_KIND, f"{len(numbers):,} numbers of optimised poses for {len(ids):,} nodes")
        rows = numbers.reshape(-1, POSE_NUMBERS)
        poses: Poses = {int(i): build_pose_matrix(r) for i, r in zip(ids, rows, strict=True) if i}  # below 0 are landmarks
    else:
        sessions = base.execute("SELECT COUNT(DISTINCT map_id) FROM Node").fetchone()[0]
        if sessions > 1:
            raise InputError(
                f"{path}: holds {sessions:,} sessions and no optimised poses that join them; open it in RTAB-Map and save it"
            )
        nodes = base.execute("SELECT id, pose FROM Node").fetchall()
        check_bytes(f"{path}: the poses", *(blob for _, blob in nodes))
        poses = {int(i): decode_pose(blob) for i, blob in nodes}
        warnings.append("it has no optimised poses: those of the odometry are taken, which drift")
    for node, pose in poses.items():
        if pose is not None and node > 0 and len(find_invalid_rotations(pose[None])):
            raise InputError(
                f"{path}: node {node} has a pose that is not a rotation and a place; optimise the graph in RTAB-Map again"
            )
    return poses


def _detect_kind(path: Path, base: sqlite3.Connection, version: tuple[int, ...]) -> str:
    """Detect what to read: "spatial" or "flat" scans, or "depth", by the first node that has any.

    Raises:
        InputError: there is none of these.
    """
    flat = False
    for node, info, blob in base.execute("SELECT id, scan_info, scan FROM Data WHERE LENGTH(scan) > 4 ORDER BY id LIMIT 1"):
        check_bytes(f"{path}: node {node}", info, blob)
        form, _ = decode_scan_format(info, version)
        channels = decode_matrix(blob, f"{path}: the scan of node {node}").shape[2]
        flat = form in FLAT_SCANS or (form == 0 and channels in FLAT_CHANNELS)
        if not flat:
            return "spatial"
    if base.execute("SELECT 1 FROM Data WHERE LENGTH(depth) > 4 LIMIT 1").fetchone():
        return "depth"
    if flat:
        return "flat"
    raise InputError(f"{path}: holds neither laser scans nor depth images; record it with Mem/BinDataKept on")


def _iter_scans(
    path: Path, base: sqlite3.Connection, version: tuple[int, ...], poses: Poses, flat: bool, warnings: list[str]
) -> Iterator[PosedScan]:
    """Yield the laser scans of all nodes that have a pose."""
    count, lost = base.execute("SELECT COUNT(*) FROM Data WHERE LENGTH(scan) > 4").fetchone()[0], 0
    rows = base.execute("SELECT id, scan_info, scan FROM Data WHERE LENGTH(scan) > 4 ORDER BY id")
    for number, (node, info, blob) in enumerate(rows, 1):
        check_bytes(f"{path}: node {node}", info, blob)
        pose = poses.get(node)
        if pose is None:
            lost += 1
            continue
        form, mount = decode_scan_format(info, version)
        points, colors = decode_scan_points(blob, form, f"{path}: the scan of node {node}")
        yield PosedScan(points, pose @ mount, colors, done=number / count)
    if lost == count:
        raise InputError(f"{path}: none of its {count:,} scans has a pose; optimise the graph in RTAB-Map, and save it")
    if lost:
        warnings.append(f"{lost:,} of {count:,} scans have no pose and are left out")
    if flat:
        warnings.append("its scans are slices: it has no depth images, nor scans in space")


def _iter_frames(
    path: Path,
    base: sqlite3.Connection,
    version: tuple[int, ...],
    poses: Poses,
    is_due: Callable[[Array, float], bool] = lambda pose, done: True,
) -> Iterator[Frame | None]:
    """Yield the depth images of the nodes that are due; those of several cameras lie side by side in one image."""
    count = base.execute("SELECT COUNT(*) FROM Data WHERE LENGTH(depth) > 4").fetchone()[0]
    columns = "Data.id, Node.stamp, calibration, depth, image"
    rows = base.execute(f"SELECT {columns} FROM Data LEFT JOIN Node USING (id) WHERE LENGTH(depth) > 4 ORDER BY Data.id")
    for number, (node, stamp, calibration, blob, image) in enumerate(rows, 1):
        check_bytes(f"{path}: node {node}", calibration, blob, image)
        pose = poses.get(node)
        if pose is None:
            yield None
            continue
        what = f"{path}: the depth of node {node}"
        cameras = decode_cameras(calibration or b"", version, f"{path}: node {node}")
        if not cameras:
            raise InputError(f"{path}: node {node} has a depth image and no camera; calibrate it, or mend the database")
        if not any(is_due(pose @ camera.mount, number / count) for camera in cameras):
            continue
        depth, metre = decode_depth(blob, what)
        colors = read_color(image, f"{path}: the image of node {node}") if image and len(image) > 4 else None
        if depth.shape[1] % len(cameras):
            raise InputError(f"{what} is {depth.shape[1]} pixels wide, which {len(cameras)} cameras can't share; it is damaged")
        shown = _split_image(colors, len(cameras))
        for camera, part, color in zip(cameras, _split_image(depth, len(cameras)), shown, strict=True):
            assert part is not None
            lens, time = camera.scale_to_depth(part.shape, metre), _read_number(stamp)
            yield Frame(what, part, lens, pose @ camera.mount, color, done=number / count, time=time)


def _split_image(image: Array | None, count: int) -> list[Array | None]:
    """Cut an image of several cameras into that of each; None where there is none, or it can't be cut."""
    if image is None or image.shape[1] % count:
        return [None] * count
    return list(np.split(image, count, axis=1))


LANDMARK_LINK = 8  # type of a link: from a node to a tag, whose number is negative
NODE_SIGMA, TAG_SIGMA = 1.0, 0.1  # m: of what was named or measured at a node, and of a tag
WIFI_SENSOR, PRESSURE_SENSOR = 1, 3  # kinds of sensors of a node: dBm of the network it is in, hPa
WEAKEST, STRONGEST = -127.0, -1.0  # dBm
LOWEST_PRESSURE, HIGHEST_PRESSURE = 300.0, 1200.0  # hPa
OWN_NAME = re.compile(r"map-?\d+")  # the label that RTAB-Map itself gives the first node of a session
FAMILIES = {17: "tag16h5", 18: "tag25h9", 19: "tag36h10", 20: "tag36h11"}  # of OpenCV's dictionaries
DICTIONARY = re.compile(r"Marker/Dictionary[:=](\d{1,3})\b")


def _read_number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else np.nan


def _read_landmarks(path: Path, base: sqlite3.Connection, poses: Poses) -> Landmarks:
    """Read the tags, labels, readings of radio and of pressure, where the graph puts their nodes."""
    tables = dict(base.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
    plain = {name for name, sql in tables.items() if not re.search(r"(?i)\bAS\b", str(sql))}
    columns = {f"{table}.{row[1]}" for table in plain & {"Node", "Data"} for row in base.execute(f"PRAGMA table_info({table})")}
    parts = [_read_tags(path, base, poses, "Info" in plain)] if "Link" in plain else []
    if "Node.label" in columns:
        parts.append(_read_labels(base, poses))
    readings = _read_readings(path, base, columns)
    for kind in ("radio", "pressure"):
        rows = [(node, value, time) for k, node, value, time in readings if k == kind and poses.get(node) is not None]
        nodes, values, times = np.array(rows[:MOST_SIGHTINGS]).reshape(-1, 3).T
        known: dict[str, Any] = {"number": values, "time": times, "group": nodes, "sigma": NODE_SIGMA}
        parts.append(build_landmarks(kind, [""] * len(nodes), "RTAB-Map", _find_places(poses, nodes.tolist()), **known))
    return join_landmarks(parts)


def _read_readings(path: Path, base: sqlite3.Connection, columns: set[str]) -> list[tuple[str, int, float, float]]:
    """Return the kind, node, value and time of each reading of radio (dBm) and of pressure (hPa); senders of radio are not
    known."""
    readings = []
    if "Node.env_sensors" in columns:
        for node, blob in base.execute("SELECT id, env_sensors FROM Node WHERE LENGTH(env_sensors) >= 24 ORDER BY id"):
            check_bytes(f"{path}: node {node}", blob)
            for kind, value, time in np.frombuffer(blob, "<f8", len(blob) // 24 * 3).reshape(-1, 3).tolist():
                if kind == WIFI_SENSOR and WEAKEST <= value <= STRONGEST:
                    readings.append(("radio", node, value, time))
                elif kind == PRESSURE_SENSOR and LOWEST_PRESSURE <= value <= HIGHEST_PRESSURE:
                    readings.append(("pressure", node, value, time))
    if "Data.user_data" in columns:  # as the example of RTAB-Map stores WiFi: dBm and time
        for node, blob in base.execute("SELECT id, user_data FROM Data WHERE LENGTH(user_data) BETWEEN 13 AND 100 ORDER BY id"):
            check_bytes(f"{path}: node {node}", blob)
            values = decode_matrix(blob, f"{path}: the user data of node {node}")
            if values.shape == (1, 2, 1) and values.dtype == np.float64 and WEAKEST <= values[0, 0, 0] <= STRONGEST:
                readings.append(("radio", node, float(values[0, 0, 0]), float(values[0, 1, 0])))
    return readings


def _find_places(poses: Poses, nodes: list[int]) -> Array:
    """Return (n, 3) m of nodes that have a pose."""
    places = [pose[:3, 3] for node in nodes if (pose := poses.get(node)) is not None]
    return np.array(places).reshape(-1, 3)


def _read_labels(base: sqlite3.Connection, poses: Poses) -> Landmarks:
    """Read the labels that the user gave nodes, as names of their places."""
    rows = base.execute(f"SELECT id, label FROM Node WHERE LENGTH(label) > 0 ORDER BY id LIMIT {MOST_SIGHTINGS}")
    named = [(node, clean_text(label)) for node, label in rows if isinstance(label, str) and poses.get(node) is not None]
    named = [(node, label) for node, label in named if label and not OWN_NAME.fullmatch(label)]
    places = _find_places(poses, [node for node, _ in named])
    return build_landmarks("name", [label for _, label in named], "RTAB-Map", places, sigma=NODE_SIGMA)


def _read_tags(path: Path, base: sqlite3.Connection, poses: Poses, stated: bool) -> Landmarks:
    """Read the tags that nodes saw, where the graph puts them, else where the nodes saw them."""
    dictionary = None
    for (text,) in base.execute("SELECT parameters FROM Info LIMIT 1") if stated else ():
        dictionary = DICTIONARY.search(text if isinstance(text, str) else "")
    family = FAMILIES.get(int(dictionary[1]), "tag") if dictionary else "tag"
    links = (
        f"SELECT from_id, to_id, transform FROM Link WHERE type = {LANDMARK_LINK} ORDER BY from_id, to_id LIMIT {MOST_SIGHTINGS}"
    )
    sightings = []
    for node, tag, blob in base.execute(links):
        check_bytes(f"{path}: the link of node {node}", blob)
        place, seen = poses.get(node), decode_pose(blob)
        if place is None or seen is None or not isinstance(tag, int) or tag >= 0:
            continue
        optimised = poses.get(tag)
        pose = place @ seen if optimised is None else optimised
        towards = place[:3, 3] - pose[:3, 3]
        normal = pose[:3, 2] if pose[:3, 2] @ towards > 0 else -pose[:3, 2]
        sightings.append(Sighting("tag", f"{family}:{-tag}", pose[:3, 3], TAG_SIGMA, heading=compute_heading(normal)))
    return fuse_sightings(sightings, "RTAB-Map")
