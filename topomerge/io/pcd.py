"""PCD, the format of the Point Cloud Library: ascii, binary (mapped) and binary_compressed.

Source: https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.io import text
from topomerge.io.piece import BLOCK_POINTS, Piece, ReadOptions, build_damage_error, build_truncation_error, convert_to_float32
from topomerge.types import Array

LONGEST_HEADER = 1 << 16  # bytes
INTENSITY = "intensity"
BEST_PACKING = 100  # LZF can't shrink more than that
PCD_TYPES = {("F", 4), ("F", 8), ("U", 1), ("U", 2), ("U", 4), ("U", 8), ("I", 1), ("I", 2), ("I", 4), ("I", 8)}


@dataclass(frozen=True)
class Header:
    """The header of a PCD file, before the points."""

    dtype: np.dtype
    points: int
    viewpoint: tuple[float, ...]  # x, y, z and the quaternion w, x, y, z of the sensor
    kind: str
    start: int
    lines: int


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read blocks of points; the viewpoint, where it is not the default, is the pose of all."""
    del options
    header = read_header(path)
    names = header.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"{path}: has the fields {' '.join(names)} but not x y z; export it with coordinates")
    blocks = {"ascii": _iter_ascii, "binary": _iter_binary, "binary_compressed": _iter_compressed}[header.kind](path, header)
    pose = _build_pose(header.viewpoint)
    done = 0
    for rows in blocks:
        done += len(rows)
        xyz = np.stack([rows[n] for n in "xyz"], axis=1)
        pose_of = None if pose is None else np.zeros(len(rows), np.int32)
        first = pose if done == len(rows) else None
        bright = convert_to_float32(rows[INTENSITY]) if INTENSITY in names and not header.dtype[INTENSITY].shape else None
        yield Piece(xyz, _decode_colors(rows), poses=first, pose_of=pose_of, done=done / header.points, intensities=bright)
    if done < header.points:
        raise build_truncation_error(path, done, header.points)


def read_header(path: Path) -> Header:
    """Read what stands before the points.

    Raises:
        InputError: it is no PCD file, or its header is damaged.
    """
    with path.open("rb") as stream:
        head = stream.read(LONGEST_HEADER)
    end = re.search(rb"(?m)^DATA[ \t]+(\w+)[ \t]*\r?\n", head)
    if end is None or not re.search(rb"(?m)^(#.*PCD|VERSION|FIELDS)", head[: end.start()]):
        raise InputError(f"{path}: is not a PCD file, or its header is cut short; check the file's suffix or copy it again")
    lines = head[: end.end()].decode("latin-1").splitlines()
    fields = {w[0]: w[1:] for line in lines if (w := line.split()) and not line.startswith("#")}
    try:
        names = fields.get("FIELDS") or fields["COLUMNS"]
        sizes, kinds = [int(v) for v in fields["SIZE"]], fields["TYPE"]
        counts = [int(v) for v in fields.get("COUNT", ["1"] * len(names))]
        total = int(fields["POINTS"][0]) if "POINTS" in fields else int(fields["WIDTH"][0]) * int(fields["HEIGHT"][0])
        viewpoint = tuple(float(v) for v in fields.get("VIEWPOINT", ["0", "0", "0", "1", "0", "0", "0"]))
        dtype = _build_dtype(names, sizes, kinds, counts)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise build_damage_error(path, "a PCD file", f"header: {error}") from error
    kind = end[1].decode("latin-1").lower()
    if kind not in ("ascii", "binary", "binary_compressed") or total < 0 or len(viewpoint) != 7:
        raise build_damage_error(path, "a PCD file", f"DATA {kind}, {total} points")
    size = path.stat().st_size - end.end()
    if total > size and kind != "binary_compressed":  # a point is at least a byte long
        raise build_truncation_error(path, 0, total)
    return Header(dtype, total, viewpoint, kind, end.end(), len(lines))


def _build_dtype(names: list[str], sizes: list[int], kinds: list[str], counts: list[int]) -> np.dtype:
    """Build the type of a row. Padding fields are all named "_", so names that repeat get a number."""
    columns = []
    for i, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
        if (kind, size) not in PCD_TYPES or not 0 < count <= 1 << 16:
            raise ValueError(f"field {name} of type {kind}{size} x {count}")
        unique = name if name != "_" and name not in names[:i] else f"{name}{i}"
        code = f"<{kind.lower()}{size}"
        columns.append((unique, code) if count == 1 else (unique, code, (count,)))
    return np.dtype(columns)


def _iter_binary(path: Path, header: Header) -> Iterator[Array]:
    have = max(path.stat().st_size - header.start, 0) // header.dtype.itemsize
    if have < header.points:
        raise build_truncation_error(path, have, header.points)
    if header.points:
        rows = np.memmap(path, header.dtype, "r", header.start, (header.points,))
        for first in range(0, header.points, BLOCK_POINTS):
            yield np.asarray(rows[first : first + BLOCK_POINTS])


def _iter_compressed(path: Path, header: Header) -> Iterator[Array]:
    with path.open("rb") as stream:
        stream.seek(header.start)
        sizes, data = stream.read(8), np.frombuffer(stream.read(), np.uint8)
    packed, full = int.from_bytes(sizes[:4], "little"), int.from_bytes(sizes[4:], "little")
    if len(sizes) < 8 or packed > len(data):
        raise build_truncation_error(path, len(data), packed, "bytes")
    if full != header.points * header.dtype.itemsize or full > BEST_PACKING * max(packed, 1):
        raise build_damage_error(path, "a PCD file", f"{full:,} bytes for {header.points:,} points")
    from topomerge.kernels.codecs import unpack_lzf  # here: E57 takes its poses from this module, and needs no compiled loop

    unpacked = unpack_lzf(data[:packed], full)
    if unpacked is None:
        raise build_damage_error(path, "a PCD file", "its compressed data can't be unpacked")
    rows, at = np.empty(header.points, header.dtype), 0
    for name in header.dtype.names or ():  # the columns stand one after the other
        column = header.dtype[name]
        length = column.itemsize * header.points
        rows[name] = unpacked[at : at + length].view(column.base).reshape(header.points, *column.shape)
        at += length
    for first in range(0, len(rows), BLOCK_POINTS):
        yield rows[first : first + BLOCK_POINTS]


def _iter_ascii(path: Path, header: Header) -> Iterator[Array]:
    names = header.dtype.names or ()
    requested = [n for n in names if n in ("x", "y", "z", "rgb", "rgba", "r", "g", "b", INTENSITY) and not header.dtype[n].shape]
    widths = [int(np.prod(header.dtype[n].shape, dtype=int)) for n in names]
    columns = tuple(sum(widths[: names.index(n)]) for n in requested)
    kind = np.dtype([(n, header.dtype[n]) for n in requested])
    with path.open(encoding="latin-1") as stream:
        for values in text.iter_rows(path, stream, columns, skip=header.lines):
            rows = np.empty(len(values), kind)
            for i, name in enumerate(requested):
                integers = kind[name].kind in "iu"
                column = values[:, i]
                with np.errstate(over="ignore", invalid="ignore"):  # beyond float32 a number is as good as infinite
                    rows[name] = np.nan_to_num(column).clip(0, 2**32 - 1).astype(np.int64) if integers and i > 2 else column
            yield rows


def _decode_colors(rows: Array) -> Array | None:
    """Return (n, 3) uint8 from three fields, or from one of four bytes b, g, r, a."""
    names = rows.dtype.names or ()
    if {"r", "g", "b"} <= set(names):
        return np.stack([rows[n] for n in "rgb"], axis=1).astype(np.uint8)
    name = next((n for n in ("rgb", "rgba") if n in names and rows.dtype[n].itemsize == 4), None)
    if name is None or rows.dtype[name].shape:
        return None
    packed = np.ascontiguousarray(rows[name]).view(np.uint32)
    return np.stack([(packed >> s) & 255 for s in (16, 8, 0)], axis=1).astype(np.uint8)


def _build_pose(viewpoint: tuple[float, ...]) -> Array | None:
    """Return (1, 4, 4) pose of the sensor; None for the default, which says nothing."""
    if viewpoint == (0, 0, 0, 1, 0, 0, 0) or not np.isfinite(viewpoint).all() or not any(viewpoint[3:]):
        return None
    return build_pose_matrix(normalize_quaternion(np.array(viewpoint[3:])), np.array(viewpoint[:3]))[None]


def normalize_quaternion(quaternion: Array) -> Array:
    """Return the quaternion (4,), of any length but 0, as one of length 1."""
    scaled = quaternion / np.abs(quaternion).max()  # its length may be beyond any number
    return scaled / np.linalg.norm(scaled)


def build_pose_matrix(quaternion: Array, translation: Array) -> Array:
    """Build (4, 4) pose from a unit quaternion w, x, y, z and a translation."""
    w, x, y, z = quaternion
    matrix = np.eye(4)
    matrix[:3, :3] = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    matrix[:3, 3] = translation
    return matrix
