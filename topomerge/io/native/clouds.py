"""Clouds written moved with all that they hold: LAS and LAZ, binary PLY and PCD, a block at a time."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

import numpy as np
from scipy.spatial.transform import Rotation

from topomerge.errors import InputError
from topomerge.io import pcd, ply
from topomerge.io.native import Doubt, Motion, Source, Tally
from topomerge.io.piece import BLOCK_POINTS, build_truncation_error
from topomerge.io.trajectory import build_pose_matrices
from topomerge.io.transformed_points import save_transformed_points
from topomerge.types import Array

NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
STEP = 0.05  # m, over which a bent map turns normals
FLOAT32_WITHIN = 1e4  # m, beyond which a float keeps no half a millimetre
SAMPLE = 1 << 16  # points that tell where most of a cloud comes to lie


def join(sources: Sequence[Source], target: Path, doubt: Doubt) -> Tally:
    """Write one cloud moved.

    Raises:
        InputError: it can't be read, or can't hold the moved coordinates.
    """
    del doubt
    (source,) = sources
    write = {".ply": _save_ply, ".pcd": _save_pcd}.get(source.path.suffix.lower())
    if write is not None:
        count = write(source, target)
        return Tally({"points": (count, count)})
    from topomerge.io.points import read_chunks

    first = next(read_chunks(source.path, chunk=SAMPLE))
    near = source.motion.move_points(first.points.astype(np.float64) + first.shift).mean(axis=0)
    done = save_transformed_points(source.path, target, source.motion.move_points, near, same_frame=source.motion.still)
    messages = (f"{source.path}: {done.beyond:,} points are too far from all others for LAS and are left out",)
    return Tally({"points": (done.written + done.beyond, done.written)}, messages if done.beyond else ())


def _save_ply(source: Source, target: Path) -> int:
    """Write the vertices with all their properties; faces and other elements stay to the byte."""
    path = source.path
    header = ply.read_header(path)
    vertex = header.find("vertex")
    if vertex is None or not header.order or not vertex.fixed or not {"x", "y", "z"} <= {n for n, _ in vertex.properties}:
        raise InputError(f"{path}: only binary PLY with x y z is written moved; save it as binary, or take `merge --points`")
    before = header.elements[: header.elements.index(vertex)]
    if not all(element.fixed for element in before):
        raise InputError(f"{path}: has lists before its vertices; save it with the vertices first")
    row = vertex.build_dtype(header.order)
    start = header.start + sum(e.count * e.build_dtype(header.order).itemsize for e in before)
    _check_length(path, start, row, vertex.count)
    with path.open("rb") as stream, target.open("wb") as out:
        out.write(stream.read(start))
        for rows in _iter_blocks(stream, row, vertex.count):
            out.write(_move_rows(path, rows, source.motion).tobytes())
        shutil.copyfileobj(stream, out)
    return vertex.count


def _save_pcd(source: Source, target: Path) -> int:
    """Write the points with all their fields, and the sensor's viewpoint."""
    path = source.path
    header = pcd.read_header(path)
    if header.kind != "binary" or not {"x", "y", "z"} <= set(header.dtype.names or ()):
        raise InputError(f"{path}: only PCD of DATA binary is written moved, this is {header.kind}; save it as binary")
    _check_length(path, header.start, header.dtype, header.points)
    with path.open("rb") as stream, target.open("wb") as out:
        head = stream.read(header.start)
        if header.viewpoint != (0, 0, 0, 1, 0, 0, 0):
            head = re.sub(rb"(?m)^VIEWPOINT[^\r\n]*", _format_viewpoint(header.viewpoint, source.motion), head)
        out.write(head)
        for rows in _iter_blocks(stream, header.dtype, header.points):
            out.write(_move_rows(path, rows, source.motion).tobytes())
    return header.points


def _check_length(path: Path, start: int, row: np.dtype, count: int) -> None:
    have = max(path.stat().st_size - start, 0) // max(row.itemsize, 1)
    if have < count:
        raise build_truncation_error(path, have, count)


def _iter_blocks(stream: IO[bytes], row: np.dtype, count: int) -> Iterator[Array]:
    for first in range(0, count, BLOCK_POINTS):
        data = stream.read(min(BLOCK_POINTS, count - first) * row.itemsize)
        yield np.frombuffer(data, row).copy()


def _move_rows(path: Path, rows: Array, motion: Motion) -> Array:
    """Return the rows with their places and normals moved; what is not finite stays so."""
    with np.errstate(all="ignore"):
        points = _stack(rows, ("x", "y", "z"))
        moved = motion.move_points(points)
        largest = np.abs(moved[np.isfinite(moved).all(axis=1)]).max(initial=0.0)
        if rows.dtype["x"].kind != "f" or (rows.dtype["x"].itemsize == 4 and largest > FLOAT32_WITHIN):
            far = f"can't hold places {largest:,.0f} m away to a millimetre"
            raise InputError(f"{path}: its coordinates {far}; save them as double")
        for names in NORMALS:
            if set(names) <= set(rows.dtype.names or ()):
                normals = _stack(rows, names)
                ahead = motion.move_points(points + STEP * normals) - moved
                length, scale = (np.linalg.norm(v, axis=1, keepdims=True) for v in (ahead, normals))
                turned = np.divide(ahead * scale, length, out=np.zeros_like(ahead), where=length > 0)
                for k, name in enumerate(names):
                    rows[name] = turned[:, k]
        for k, axis in enumerate("xyz"):
            rows[axis] = moved[:, k]
    return rows


def _stack(rows: Array, names: tuple[str, ...]) -> Array:
    return np.stack([rows[name].astype(np.float64) for name in names], axis=1)


def _format_viewpoint(viewpoint: tuple[float, ...], motion: Motion) -> bytes:
    x, y, z, qw, qx, qy, qz = viewpoint
    quaternion = np.array([[qx, qy, qz, qw]])
    if not np.isfinite(viewpoint).all() or not quaternion.any():
        quaternion = np.array([[0.0, 0.0, 0.0, 1.0]])
    pose = motion.move_poses(build_pose_matrices(np.nan_to_num([[x, y, z]]), quaternion))[0]
    bx, by, bz, bw = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return ("VIEWPOINT " + " ".join(repr(float(v)) for v in (*pose[:3, 3], bw, bx, by, bz))).encode()
