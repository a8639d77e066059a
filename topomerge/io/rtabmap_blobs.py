"""What RTAB-Map packs into the cells of its database: matrices, cameras, laser scans and depth images.

Source: https://github.com/introlab/rtabmap, its database schema, and what its classes write (versions 0.11.10 to 0.23).
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np

from topomerge.errors import InputError
from topomerge.io.depth_images import Camera, read_pixels
from topomerge.types import Array

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

    def for_depth(self, shape: tuple[int, ...], metre: float) -> Camera:
        """The same for a depth image of a shape, which may be smaller than the colours that the camera is stated for."""
        share = [have / stated if stated else 1.0 for have, stated in zip(shape, self.size, strict=True)]
        (fx, fy), (cx, cy) = self.focal, self.centre
        return Camera((fx * share[1], fy * share[0]), (cx * share[1], cy * share[0]), metre)


def check_bytes(what: str, *cells: object) -> None:
    """Raise an InputError where a cell is neither empty nor bytes: text in an image's place would be taken for a file's name."""
    odd = next((cell for cell in cells if not isinstance(cell, bytes | None)), None)
    if odd is not None:
        raise InputError(f"{what} has text or a number where bytes belong ({type(odd).__name__}); it is damaged")


def pose_of(blob: bytes | None) -> Array | None:
    """(4, 4) float64 of twelve floats; None where it is empty or RTAB-Map's null: all zero, or not finite."""
    if blob is None or len(blob) != 4 * POSE_NUMBERS:
        return None
    return pose_matrix(np.frombuffer(blob, "<f4"))


def pose_matrix(numbers: Array) -> Array | None:
    """(4, 4) of twelve numbers; None where they are null."""
    if not np.isfinite(numbers).all() or not numbers.any():
        return None
    return np.vstack([numbers.reshape(3, 4).astype(np.float64), (0, 0, 0, 1)])


def matrix(blob: bytes, what: str) -> Array:
    """(rows, columns, channels) of a packed OpenCV matrix.

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


def cameras(blob: bytes, version: tuple[int, ...], what: str) -> list[MountedCamera]:
    """The cameras of a node, side by side in its images.

    Raises:
        InputError: they are a stereo pair, or can't be read.
    """
    if version < SERIALIZED_SINCE:
        numbers = np.frombuffer(blob, "<f4", len(blob) // 4).astype(np.float64)
        if len(numbers) == 7 + POSE_NUMBERS:
            raise _stereo(what)
        rows = numbers.reshape(-1, 6 + POSE_NUMBERS) if len(numbers) and len(numbers) % (6 + POSE_NUMBERS) == 0 else None
        if rows is None:
            raise InputError(f"{what} has a calibration of {len(blob)} bytes, which is no camera; it is damaged")
        return [_mounted(r[:4], (int(r[5]), int(r[4])), r[6:], what) for r in rows]
    read = []
    while blob:
        if len(blob) < CAMERA_HEAD.size:
            raise InputError(f"{what} has a calibration that is cut short; it is damaged")
        _, _, _, kind, width, height, *counts = CAMERA_HEAD.unpack(blob[: CAMERA_HEAD.size])
        if kind == STEREO:
            raise _stereo(what)
        end = CAMERA_HEAD.size + 8 * sum(counts[:4]) + 4 * counts[4]
        fitting = all(count in able for count, able in zip(counts, ((9,), range(15), (0, 9), (0, 12), (0, 12)), strict=True))
        if kind != MONO or not fitting or len(blob) < end:
            raise InputError(f"{what} has a calibration that can't be read (kind {kind}, numbers {counts}); it is damaged")
        numbers = np.frombuffer(blob, "<f8", sum(counts[:4]), CAMERA_HEAD.size)
        plain = (
            numbers[-12:].reshape(3, 4) if counts[3] else numbers[:9].reshape(3, 3)
        )  # P, which is for images without distortion
        mount = np.frombuffer(blob, "<f4", counts[4], end - 4 * counts[4]) if counts[4] else np.eye(4)[:3].ravel()
        read.append(_mounted((plain[0, 0], plain[1, 1], plain[0, 2], plain[1, 2]), (height, width), mount, what))
        blob = blob[end:]
    return read


def _mounted(numbers: Array | tuple[float, ...], size: tuple[int, int], mount: Array, what: str) -> MountedCamera:
    fx, fy, cx, cy = (float(n) for n in numbers)
    pose = pose_matrix(np.asarray(mount))
    if not (np.isfinite((fx, fy, cx, cy)).all() and min(fx, fy) > 0 and min(size) >= 0) or pose is None:
        raise InputError(
            f"{what} has a camera that can't be used (focal lengths {fx:g} {fy:g}); calibrate it, or mend the database"
        )
    return MountedCamera((fx, fy), (cx, cy), size, pose)


def _stereo(what: str) -> InputError:
    return InputError(
        f"{what} has stereo images, whose depth is not computed; export its cloud from RTAB-Map, or use a camera of depth"
    )


def scan_format(info: bytes | None, version: tuple[int, ...]) -> tuple[int, Array]:
    """What the numbers of a scan are (0: not said), and the pose (4, 4) of the laser on the robot."""
    numbers = np.frombuffer(info or b"", "<f4", len(info or b"") // 4)
    ahead = 7 if version >= SERIALIZED_SINCE else 3 if version >= FORMAT_SINCE and len(numbers) == 3 + POSE_NUMBERS else 2
    if len(numbers) != ahead + POSE_NUMBERS:
        return 0, np.eye(4)
    form = {7: numbers[0], 3: numbers[2]}.get(ahead, np.float32(0))
    mount = pose_matrix(numbers[ahead:])
    return int(form) if np.isfinite(form) else 0, np.eye(4) if mount is None else mount


def scan_points(blob: bytes, form: int, what: str) -> tuple[Array, Array | None]:
    """(n, 3) points of a laser scan in its own frame, and (n, 3) uint8 colours, or None.

    Raises:
        InputError: it can't be unpacked, or is in a format that is not known.
    """
    values = matrix(blob, what)
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


def depth_values(blob: bytes, what: str) -> tuple[Array, float]:
    """(h, w) of a depth image, and how many of its values are a metre.

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
