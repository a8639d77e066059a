"""ScanNet's `.sens`: a recording of depth and colours with the pose of every frame in one file, read frame by frame.

Depth is compressed by zlib, or not at all. Frames whose pose is not finite (tracking was lost) are left out.
Source: https://github.com/ScanNet/ScanNet/tree/master/SensReader
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np

from topomerge.errors import InputError
from topomerge.io.depth_images import Camera, Frame, read_color
from topomerge.io.pictures import iter_frame_pieces
from topomerge.io.piece import PIXELS, Piece, ReadOptions, build_damage_error
from topomerge.types import Array

SENS_KIND = "a ScanNet recording"
SENS_VERSION = 4
LONGEST_NAME = 4096  # bytes of the sensor's name
MATRICES = struct.Struct("<64f")  # calibrations of colour and depth, each a camera and where it stands
REST_OF_HEADER = struct.Struct("<2i4IfQ")  # compressions, sizes, values of depth a metre, frames
FRAME_HEAD = struct.Struct("<16f4Q")  # pose, times of colour and depth (µs), bytes of both
RAW_DEPTH, ZLIB_DEPTH = 0, 1
PNG_COLOR, JPEG_COLOR = 1, 2


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read points of every frame in the frame of the poses."""
    yield from iter_frame_pieces(path, _iter_frames(path), [], options)


def _iter_frames(path: Path) -> Iterator[Frame]:
    size = path.stat().st_size
    with path.open("rb") as stream:
        (version,) = struct.unpack("<I", _read_exactly(path, stream, 4, "its header"))
        if version != SENS_VERSION:
            raise InputError(f"{path}: is of version {version} of .sens, only {SENS_VERSION} is read; get it from ScanNet itself")
        (length,) = struct.unpack("<Q", _read_exactly(path, stream, 8, "its header"))
        if length > LONGEST_NAME:
            raise build_damage_error(path, SENS_KIND, f"a name of {length:,} letters")
        _read_exactly(path, stream, length, "its header")
        matrices = np.reshape(MATRICES.unpack(_read_exactly(path, stream, MATRICES.size, "its header")), (4, 4, 4))
        rest = REST_OF_HEADER.unpack(_read_exactly(path, stream, REST_OF_HEADER.size, "its header"))
        color_kind, depth_kind, color_width, color_height, width, height, metre, count = rest
        if depth_kind not in (RAW_DEPTH, ZLIB_DEPTH):
            raise InputError(
                f"{path}: its depth is compressed in the way {depth_kind} (occi); only zlib and raw are read, convert it"
            )
        if not 0 < width * height <= PIXELS or count * FRAME_HEAD.size > size:
            raise build_damage_error(path, SENS_KIND, f"{count:,} frames of {width} x {height} pixels")
        camera = _build_camera(path, matrices[2], metre, (height, width))
        lens = (
            _build_camera(path, matrices[0], metre, (color_height, color_width))
            if color_kind in (PNG_COLOR, JPEG_COLOR)
            else None
        )
        for number in range(count):
            name = f"{path}: frame {number}"
            *pose, _, _, color_bytes, depth_bytes = FRAME_HEAD.unpack(
                _read_exactly(path, stream, FRAME_HEAD.size, f"frame {number}")
            )
            if color_bytes + depth_bytes > size - stream.tell():
                raise _build_truncation_error(path, f"frame {number} of {count:,}")
            color = stream.read(color_bytes)
            depth = _decode_depth(path, number, stream.read(depth_bytes), depth_kind, (height, width))
            shown = read_color(color, name) if lens is not None and color and np.isfinite(pose).all() else None
            yield Frame(name, depth, camera, np.reshape(pose, (4, 4)), shown, lens, (number + 1) / count)


def _build_camera(path: Path, matrix: Array, metre: float, size: tuple[int, int]) -> Camera:
    try:
        return Camera((matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]), metre, size)
    except ValueError as error:
        raise build_damage_error(path, SENS_KIND, f"its calibration: {error}") from error


def _decode_depth(path: Path, number: int, data: bytes, kind: int, shape: tuple[int, int]) -> Array:
    """Return (h, w) values of one frame; never more bytes are unpacked than it has pixels for."""
    promised = 2 * shape[0] * shape[1]
    if kind == ZLIB_DEPTH:
        try:
            data = zlib.decompressobj().decompress(data, promised)
        except zlib.error as error:
            raise build_damage_error(path, SENS_KIND, f"the depth of frame {number}: {error}") from error
    if len(data) < promised:
        raise build_damage_error(path, SENS_KIND, f"the depth of frame {number} has {len(data):,} of {promised:,} bytes")
    return np.frombuffer(data, "<u2", promised // 2).reshape(shape)


def _read_exactly(path: Path, stream: IO[bytes], count: int, what: str) -> bytes:
    data = stream.read(count)
    if len(data) < count:
        raise _build_truncation_error(path, what)
    return data


def _build_truncation_error(path: Path, what: str) -> InputError:
    return InputError(f"{path}: ends within {what}; it is cut short, copy it again")
