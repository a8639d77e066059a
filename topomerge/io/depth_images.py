"""Depth images with their cameras and poses as points."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.io.piece import BLOCK_POINTS, PIXELS, Piece, build_damage_error
from topomerge.io.trajectory import find_invalid_rotations
from topomerge.types import Array, Landmarks


@dataclass(frozen=True, eq=False)
class PosedScan:
    """The points that a sensor measured from one place.

    Args:
        points: (n, 3) in the sensor's frame, or in the fixed frame where they are `registered`.
        pose: (4, 4) of the sensor in the fixed frame; None: not known, and then the points are registered.
        colors: (n, 3) uint8.
        registered: the points stand in the fixed frame already; the pose only says where their rays start.
        done: share of all scans that are read.
    """

    points: Array
    pose: Array | None
    colors: Array | None = None
    registered: bool = False
    done: float = 0.0


def iter_pieces(
    scans: Iterable[PosedScan], warnings: Iterable[str] = (), landmarks: Callable[[], Landmarks] = Landmarks
) -> Iterator[Piece]:
    """Yield the scans as few large pieces, so that a long walk of small scans costs no more than one large one.

    Rays that met nothing (not finite, or at the sensor itself) are left out.

    Args:
        scans: in their order; read one at a time.
        warnings: what the user should know; asked for when all scans are read.
        landmarks: gives what else they showed; called when all scans are read.
    """
    batch: list[PosedScan] = []
    size, before = 0, 0
    for scan in map(_transform_scan, scans):
        batch.append(scan)
        size += len(scan.points)
        if size >= BLOCK_POINTS:
            yield _build_piece(batch, before)
            before += sum(s.pose is not None for s in batch)
            batch, size = [], 0
    if batch:
        yield _build_piece(batch, before)
    found = landmarks()
    yield Piece(np.empty((0, 3)), warnings=tuple(warnings), landmarks=found, done=1.0)


def _transform_scan(scan: PosedScan) -> PosedScan:
    """Return the scan with its points in the fixed frame."""
    points = np.asarray(scan.points, np.float64)
    far = np.einsum("ij,ij->i", points, points)
    met = np.isfinite(far) & ((far > 0) | scan.registered)
    points, colors = (points, scan.colors) if met.all() else (points[met], None if scan.colors is None else scan.colors[met])
    if scan.pose is not None and not scan.registered:
        points = points @ scan.pose[:3, :3].T + scan.pose[:3, 3]
    return PosedScan(points, scan.pose, colors, True, scan.done)


def _build_piece(batch: list[PosedScan], before: int) -> Piece:
    """Build one piece of placed scans; `before` poses were handed over already."""
    poses = [s.pose for s in batch if s.pose is not None]
    numbers, number = [], before
    for scan in batch:
        numbers.append(np.full(len(scan.points), -1 if scan.pose is None else number, np.int32))
        number += scan.pose is not None
    colors = None
    if any(s.colors is not None for s in batch):
        colors = np.concatenate([np.zeros((len(s.points), 3), np.uint8) if s.colors is None else s.colors for s in batch])
    return Piece(
        np.concatenate([s.points for s in batch]),
        colors,
        poses=np.stack(poses) if poses else None,
        pose_of=np.concatenate(numbers) if poses or before else None,
        done=batch[-1].done,
    )


FARTHEST = 5.0  # m: beyond, cameras of depth err by 5 cm and more
SPACING_AT_4_M = 0.03  # m between points on a wall that far away
MIDDLE = (0.25, 0.75)  # of an image: where the centre of any camera lies; elsewhere it is that of another image
FOCAL_SHARE = (0.2, 5.0)  # of an image's width: from 136 to 11 degrees wide
ASPECT_TOLERANCE = 0.02  # by which colours and depth that show the same may differ in shape


@dataclass(frozen=True)
class Camera:
    """Focal lengths and centre (pixels), values of depth per metre.

    Args:
        size: rows and columns of the images for which it holds; None: of any.
        mend: what to do about images of another size, for messages.
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    metre: float
    size: tuple[int, int] | None = None
    mend: str = "give the calibration of these images"

    def __post_init__(self) -> None:
        if not (np.isfinite([*self.focal, *self.centre, self.metre]).all() and min(*self.focal, self.metre) > 0):
            raise ValueError("focal lengths and the depth of 1 m are numbers above 0")


@dataclass(frozen=True, eq=False)
class Frame:
    """One depth image.

    Args:
        name: of the file or the part of it, for messages.
        depth: a file of 16 bits, or (h, w) values, 0 or nan where nothing was measured.
        pose: (4, 4) camera in the fixed frame; None or not finite: not known.
        color: a file, or (h, w, 3) uint8.
        lens: the camera of the colours; None: they show what the depth image shows.
        done: share of all frames.
        time: s; nan: not known.
    """

    name: Path | str
    depth: Path | Array
    camera: Camera
    pose: Array | None
    color: Path | Array | None = None
    lens: Camera | None = None
    done: float = 0.0
    time: float = np.nan


Show = Callable[[Frame, Array, Array | None], None]  # frame, its depth (h, w), its colours (h, w, 3)


def iter_posed_scans(
    path: Path, frames: Iterable[Frame | None], warnings: list[str], show: Show | None = None
) -> Iterator[PosedScan]:
    """Yield the scan of each frame; those without a pose are left out, and counted in what is said.

    Args:
        path: of the recording, for messages.
        frames: read one at a time; None: an image without a pose.
        said: takes warnings.
        show: takes each frame with its images.

    Raises:
        InputError: no frame has a pose, or one can't be used.
    """
    count = lost = 0
    for frame in frames:
        count += 1
        if frame is None or frame.pose is None or not np.isfinite(frame.pose).all():
            lost += 1
        elif len(find_invalid_rotations(frame.pose[None])):
            raise InputError(f"{frame.name}: its pose is not a rotation and a place; mend it, or remove the image")
        else:
            yield _build_scan(frame, show)
    if lost == count:
        raise InputError(f"{path}: none of its {count:,} depth images has a pose that can be used; give another recording")
    if lost:
        warnings.append(f"{lost:,} of {count:,} depth images have no pose that can be used and are left out")


def _build_scan(frame: Frame, show: Show | None) -> PosedScan:
    """Return the points of one frame as its camera sees them."""
    depth = read_depth(frame.depth) if isinstance(frame.depth, Path) else frame.depth
    points, rows, columns = unproject_depth(frame.name, depth, frame.camera)
    shown = read_color(frame.color) if isinstance(frame.color, Path) else frame.color
    if show is not None:
        show(frame, depth, shown)
    return PosedScan(points, frame.pose, _sample_colors(frame, shown, points, rows, columns, depth.shape), done=frame.done)


def unproject_depth(name: Path | str, depth: Array, camera: Camera) -> tuple[Array, Array, Array]:
    """Return (n, 3) points in front of a camera, m, and the rows and columns (n,) of their pixels; not every pixel becomes one.

    Args:
        name: of the image, for messages.
        depth: (h, w) values along the camera's axis; 0 or not finite where nothing was measured.
        camera: that took it.

    Raises:
        InputError: the camera can't be that of an image of this size.
    """
    _check_camera(name, camera, depth.shape)
    step = max(1, round(min(camera.focal) * SPACING_AT_4_M / 4.0))
    rows, columns = np.nonzero(depth[::step, ::step] > 0)
    rows, columns = rows * step, columns * step
    with np.errstate(over="ignore"):  # too far to be counted
        z = depth[rows, columns] / camera.metre
    close = z <= FARTHEST
    rows, columns, z = rows[close], columns[close], z[close]
    x, y = ((v - c) / f * z for v, c, f in zip((columns, rows), camera.centre, camera.focal, strict=True))
    return np.stack([x, y, z], axis=1), rows, columns


def _check_camera(name: Path | str, camera: Camera, shape: tuple[int, ...]) -> None:
    """Refuse a camera that can't be that of an image of this shape.

    Raises:
        InputError: it is one for another size.
    """
    height, width = shape
    if not height * width:
        raise InputError(f"{name}: has no pixels; record it again")
    if camera.size is not None and camera.size != shape:
        theirs = f"its camera {camera.size[1]} x {camera.size[0]}"
        raise InputError(f"{name}: has {width} x {height} pixels, {theirs}; {camera.mend}")
    shares = [c / n for c, n in zip(camera.centre, (width, height), strict=True)]
    wide = [f / width for f in camera.focal]
    if not (MIDDLE[0] <= min(shares) <= max(shares) <= MIDDLE[1] and FOCAL_SHARE[0] <= min(wide) <= max(wide) <= FOCAL_SHARE[1]):
        stated = f"focal lengths {camera.focal[0]:g} {camera.focal[1]:g}, centre {camera.centre[0]:g} {camera.centre[1]:g}"
        raise InputError(f"{name}: has {width} x {height} pixels, and a camera of {stated} can't be its own; {camera.mend}")


def _sample_colors(
    frame: Frame, shown: Array | None, points: Array, rows: Array, columns: Array, shape: tuple[int, ...]
) -> Array | None:
    """Return (n, 3) uint8 of the points; None where the colours show something else than the depth image."""
    if shown is None:
        return None
    height, width = shown.shape[:2]
    if frame.lens is None:
        if abs(height * shape[1] / (width * shape[0]) - 1) > ASPECT_TOLERANCE:
            return None
        return shown[rows * height // shape[0], columns * width // shape[1]]
    (fx, fy), (cx, cy) = frame.lens.focal, frame.lens.centre
    u = np.rint(points[:, 0] / points[:, 2] * fx + cx).clip(0, width - 1).astype(np.int64)
    v = np.rint(points[:, 1] / points[:, 2] * fy + cy).clip(0, height - 1).astype(np.int64)
    return shown[v, u]


def read_depth(path: Path) -> Array:
    """Read (h, w) int32 values of a 16-bit PNG or PGM.

    Raises:
        InputError: it is none, or is cut short.
    """
    image = read_pixels(path, path)
    if image.ndim != 2 or image.dtype == np.uint8:
        raise InputError(f"{path}: is no 16-bit depth image; other images than depth stand in its place")
    return image.astype(np.int32)


def read_color(source: Path | bytes, name: Path | str | None = None) -> Array | None:
    """Return (h, w, 3) uint8 of a PNG or JPEG, in a file or as bytes (then with a name for messages); None where it has other
    values."""
    image = read_pixels(source, name if name is not None else str(source))
    if image.dtype != np.uint8:
        return None
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image[..., :3]


def read_pixels(source: Path | bytes, name: Path | str) -> Array:
    """Read the values of a PNG, JPEG or PGM, in a file or as bytes.

    Raises:
        InputError: it is none, is cut short, or absurdly large.
    """
    from PIL import Image

    if not isinstance(source, bytes) and source.exists() and not source.is_file():  # nobody may write into a pipe
        raise InputError(f"{name}: is no regular file (a folder, a pipe or a device); copy the image there")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # our own limit is stricter than the library's warning
            stream = io.BytesIO(source) if isinstance(source, bytes) else source
            with Image.open(stream, formats=("PNG", "JPEG", "PPM")) as image:
                if image.size[0] * image.size[1] > PIXELS:
                    raise InputError(f"{name}: has {image.size[0]} x {image.size[1]} pixels, too many for a frame; give another")
                return np.asarray(image)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{name}: no such file, but its list names it; copy the folder again") from None
    except Exception as error:
        raise build_damage_error(Path(name), "a PNG, JPEG or PGM image", error) from error
