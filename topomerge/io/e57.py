"""E57: several scans with the poses of their scanner, read in blocks by pye57.

The library trusts what it reads and can take the whole process down with it, or never come back: every page's checksum is
verified first, and the library is in a process of its own, within limits.
Source: ASTM E2807 (pages of 1024 bytes, the last four of which are their CRC-32C).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.pcd import build_pose_matrix, normalize_quaternion
from topomerge.io.piece import (
    BLOCK_POINTS,
    Piece,
    ReadOptions,
    build_damage_error,
    build_truncation_error,
    convert_to_uint8,
    read_head,
    read_in_subprocess,
)
from topomerge.types import Array

PAGES_A_TIME = 1 << 15  # checked at a time
BLOCK_SECONDS = 30  # of the processor for one block, which takes 0.2
LIBRARY_MEMORY = 2 << 30  # bytes for all blocks, which take 0.2 GB
CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
COLOR_FIELDS = ("colorRed", "colorGreen", "colorBlue")
INTENSITY_FIELD = "intensity"
INVALID_FIELDS = ("cartesianInvalidState", "sphericalInvalidState")


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read blocks of the points of all scans, in the file's common frame."""
    if find_spec("pye57") is None:
        raise ImportError("no pye57", name="pye57")
    check_pages(path)
    yield from read_in_subprocess("e57", "an E57 file", path, options, BLOCK_SECONDS, LIBRARY_MEMORY)


def read_in_process(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Yield the same in this process, which the library may end."""
    del options
    import pye57

    file = pye57.E57(str(path))
    try:
        headers = [file.get_header(i) for i in range(file.scan_count)]
        if not headers:
            raise InputError(f"{path}: holds no scans, only images or nothing; export it with its points")
        poses = np.stack([_read_pose(h) for h in headers])
        total = max(sum(h.point_count for h in headers), 1)
        if total > 8 * path.stat().st_size:  # points of one place take no bytes, and could be without end
            raise build_damage_error(path, "an E57 file", f"it promises {total:,} points, more than it has bits")
        yield Piece(np.empty((0, 3)), poses=poses)
        done = 0
        for number, header in enumerate(headers):
            for xyz, colors, bright, count in _iter_scan_blocks(path, file, header):
                done += count
                world = xyz @ poses[number, :3, :3].T + poses[number, :3, 3]
                pose_of = np.full(len(world), number, np.int32)
                yield Piece(world, colors, pose_of=pose_of, done=done / total, intensities=bright)
    finally:
        file.close()


def _read_pose(header: Any) -> Array:
    """Return (4, 4) pose of a scan; without one its points stand in the common frame already."""
    if not header.has_pose():
        return np.eye(4)
    quaternion = np.asarray(header.rotation, np.float64)
    turn = normalize_quaternion(quaternion) if quaternion.any() else np.array([1.0, 0, 0, 0])
    return build_pose_matrix(turn, np.asarray(header.translation, np.float64))


def _iter_scan_blocks(path: Path, file: Any, header: Any) -> Iterator[tuple[Array, Array | None, Array | None, int]]:
    """Yield blocks of one scan: points in the scanner's frame, colours, intensities, and how many rows were read."""
    fields = set(header.point_fields)
    axes = next((a for a in (CARTESIAN, SPHERICAL) if fields >= set(a)), None)
    if axes is None:
        raise InputError(f"{path}: a scan has neither x y z nor range and angles; export it with coordinates")
    shades = COLOR_FIELDS if fields >= set(COLOR_FIELDS) else ()
    flags = [f for f in INVALID_FIELDS if f in fields]
    lights = [INTENSITY_FIELD] if INTENSITY_FIELD in fields else []
    data, buffers = file.make_buffers([*axes, *shades, *lights, *flags], min(BLOCK_POINTS, max(header.point_count, 1)))
    reader = header.points.reader(buffers)
    left = header.point_count
    try:
        while left > 0 and (count := int(reader.read())):
            left -= count
            rows = {name: np.array(values[:count]) for name, values in data.items()}
            valid = np.ones(count, bool)
            for flag in flags:
                valid &= rows[flag] == 0
            xyz = np.stack([rows[a] for a in axes], axis=1)[valid]
            colors = convert_to_uint8(np.stack([rows[c] for c in shades], axis=1)[valid]) if shades else None
            bright = rows[INTENSITY_FIELD][valid].astype(np.float32) if lights else None
            yield (xyz if axes is CARTESIAN else _convert_to_cartesian(xyz)), colors, bright, count
    finally:
        reader.close()
    if left > 0:
        raise build_truncation_error(path, header.point_count - left, header.point_count)


def _convert_to_cartesian(spherical: Array) -> Array:
    """Return (n, 3) x, y, z from range, azimuth and elevation (rad)."""
    distance, azimuth, elevation = spherical.T
    flat = distance * np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1)


def check_pages(path: Path) -> None:
    """Refuse a file whose header or any page is damaged."""
    from topomerge.kernels.codecs import compute_crc32c  # here: the process that decodes needs no compiled loop

    head = read_head(path, "an E57 file", b"ASTM-E57", 48)
    length, xml, xml_length, page = struct.unpack("<QQQQ", head[16:48])
    size = path.stat().st_size
    if size < length:
        raise InputError(f"{path}: holds {size:,} of {length:,} bytes; the file is cut short, copy it again")
    if page != 1024 or length % page or length == 0 or xml + xml_length > length:
        raise build_damage_error(path, "an E57 file", "its header contradicts itself")
    with path.open("rb") as stream:
        for first in range(0, length // page, PAGES_A_TIME):
            data = stream.read(min(PAGES_A_TIME, length // page - first) * page)
            pages = np.frombuffer(data, np.uint8).reshape(-1, page)
            stored = np.ascontiguousarray(pages[:, -4:]).view(">u4")[:, 0]
            bad = np.flatnonzero(compute_crc32c(pages[:, :-4]) != stored)
            if len(bad):
                raise build_damage_error(path, "an E57 file", f"page {first + int(bad[0])} fails its checksum")
