"""NumPy files: npy with an (N, 3 or more) array, npz with named arrays.

An npz holds ``points`` (or ``xyz``, or a single array), and may hold ``shift``, ``colors`` (or ``rgb``), ``labels``, ``poses``
and ``pose_of`` as in `PointCloud`. Pickled objects are never loaded.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np

from topomerge.errors import InputError
from topomerge.io.piece import BLOCK_POINTS, Piece, ReadOptions, build_damage_error, build_truncation_error, convert_to_uint8
from topomerge.types import Array

LARGEST_ARRAY = 64 << 30  # bytes a packed array may become
RATIO, MODEST = 200, 1 << 28  # packed arrays above the second size that shrank more than the first are refused
POINT_NAMES, COLOR_NAMES, LABEL_NAMES = ("points", "xyz", "pts", "positions"), ("colors", "rgb", "colours"), ("labels",)


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read blocks of an npy file, which is mapped, or the contents of an npz file."""
    del options
    with path.open("rb") as stream:
        magic = stream.read(6)
    if magic[:4] == b"PK\x03\x04":
        yield _read_npz(path)
    elif magic == b"\x93NUMPY":
        yield from _read_npy(path)
    else:
        raise InputError(f"{path}: is not a NumPy file; save it with numpy.savez or numpy.save")


def _read_npy(path: Path) -> Iterator[Piece]:
    with path.open("rb") as stream:
        shape, dtype = _read_header(path, stream, path.stat().st_size)
        del dtype
    points = np.load(path, mmap_mode="r", allow_pickle=False)
    _check_points(path, "the array", shape)
    for start in range(0, shape[0], BLOCK_POINTS):
        block = np.asarray(points[start : start + BLOCK_POINTS])
        colors = convert_to_uint8(block[:, 3:6]) if shape[1] == 6 and block.dtype.kind in "iu" else None
        yield Piece(block[:, :3], colors, done=(start + len(block)) / shape[0])


def _read_header(path: Path, stream: IO[bytes], size: int) -> tuple[tuple[int, ...], np.dtype]:
    """Read the shape and type of an npy stream of `size` bytes, checked before anything is allocated."""
    try:
        version = np.lib.format.read_magic(stream)
        reader = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = reader(stream)
    except ValueError as error:
        raise build_damage_error(path, "a NumPy file", error) from error
    if dtype.hasobject:
        raise InputError(f"{path}: holds pickled Python objects, which are never loaded; save plain arrays of numbers")
    if dtype.kind not in "fiub":
        raise InputError(f"{path}: holds {dtype} instead of plain numbers; save an (N, 3) array of floats")
    have = size - stream.tell()
    if math.prod(shape) * dtype.itemsize > have:
        raise build_truncation_error(path, max(have, 0) // dtype.itemsize, math.prod(shape), "numbers")
    return shape, dtype


def _check_points(path: Path, name: str, shape: tuple[int, ...]) -> None:
    if len(shape) != 2 or shape[1] < 3:
        raise InputError(f"{path}: {name} has the shape {shape}; points are an (N, 3) array")


def _read_npz(path: Path) -> Piece:
    try:
        with zipfile.ZipFile(path) as archive:
            members = {i.filename.removesuffix(".npy"): i for i in archive.infolist() if i.filename.endswith(".npy")}
            requested = {"shift", "poses", "pose_of", *POINT_NAMES, *COLOR_NAMES, *LABEL_NAMES} & members.keys()
            if not requested & set(POINT_NAMES) and len(members) == 1:
                requested = set(members)
            total = sum(members[name].file_size for name in requested)
            if total > max(MODEST, RATIO * path.stat().st_size):
                raise InputError(f"{path}: its arrays would unpack to {total:,} bytes together; refused, save them unpacked")
            arrays = {name: _read_member(path, archive, members[name]) for name in sorted(requested)}
    except (zipfile.BadZipFile, EOFError, NotImplementedError) as error:
        raise build_damage_error(path, "an npz archive", error) from error
    name = next((n for n in (*POINT_NAMES, *arrays) if n in arrays), None)
    if name is None or (name not in POINT_NAMES and len(arrays) > 1):
        held = ", ".join(name[:40] for name in list(members)[:8]) or "none"
        raise InputError(f"{path}: has no array named points (it has {held}); save them under that name")
    return _build_piece(path, name, arrays)


def _read_member(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Array:
    """Read one array of an archive. The size that the archive states bounds what is unpacked."""
    swollen = info.file_size > MODEST and info.file_size > RATIO * max(info.compress_size, 1)
    if info.file_size > LARGEST_ARRAY or swollen:
        raise InputError(f"{path}: {info.filename} would unpack to {info.file_size:,} bytes; refused, save it unpacked")
    with archive.open(info) as stream:
        _read_header(path, stream, info.file_size)
    with archive.open(info) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


def _build_piece(path: Path, name: str, arrays: dict[str, Array]) -> Piece:
    """Return the arrays of an archive as a piece, their shapes checked."""
    points = arrays[name]
    _check_points(path, name, points.shape)
    columns = {c: next((arrays[n] for n in names if n in arrays), None) for c, names in (("c", COLOR_NAMES), ("l", LABEL_NAMES))}
    shift, poses, pose_of = arrays.get("shift"), arrays.get("poses"), arrays.get("pose_of")
    requested = (
        ("colors", columns["c"], (len(points), 3)),
        ("labels", columns["l"], (len(points),)),
        ("pose_of", pose_of, (len(points),)),
        ("shift", shift, (3,)),
        ("poses", poses, (len(poses) if poses is not None and poses.ndim else 0, 4, 4)),
    )
    for what, values, shape in requested:
        if values is not None and values.shape != shape:
            raise InputError(f"{path}: {what} has the shape {values.shape} instead of {shape}; save it again")
    if pose_of is not None and len(pose_of) and (poses is None or pose_of.max() >= len(poses)):
        raise InputError(f"{path}: pose_of names a pose that is not in poses; save it again")
    xyz = points[:, :3] if shift is None else points[:, :3].astype(np.float64) + shift
    return Piece(
        xyz,
        None if columns["c"] is None else convert_to_uint8(columns["c"]),
        None if columns["l"] is None else columns["l"].astype(np.int32),
        poses,
        None if pose_of is None else pose_of.astype(np.int32),
        done=1.0,
    )
