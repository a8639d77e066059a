"""Posed RGB-D images in the folders of data sets: Replica as NICE-SLAM has it, ScanNet's export, 3RScan and ARKitScenes.

Each layout is a function that gives its frames one after the other. Depth is 16-bit, in millimetres (Replica: ``scale`` of its
`cam_params.json`); poses are the camera's in a frame with z up, but for ARKitScenes, which says where the world is in the camera.
Sources: https://github.com/cvg/nice-slam, https://github.com/ScanNet/ScanNet/tree/master/SensReader,
https://github.com/WaldJohannaU/3RScan, https://github.com/apple/ARKitScenes/blob/main/DATA.md
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from topomerge.errors import InputError
from topomerge.io.depth_images import Camera, Frame, read_depth, read_pixels
from topomerge.io.pictures import iter_frame_pieces
from topomerge.io.piece import Piece, ReadOptions
from topomerge.io.trajectory import LONGEST_GAP, Trajectory, iter_number_rows
from topomerge.types import Array

MILLIMETRES = 1000.0  # values of depth in a metre
LARGEST_TEXT = 1 << 20  # bytes of a calibration or a single pose
CALIBRATION_GAP = 0.05  # s between a depth image of ARKitScenes and its calibration
NO_NUMBER = re.compile(r"[-+]?1\.#\w+")  # how programs on Windows write nan and infinity


@dataclass(frozen=True)
class Layout:
    """How a data set lays its images out: what a folder of it holds, and its frames."""

    name: str
    marks: tuple[str, ...]
    frames: Callable[[Path], Iterator[Frame]]


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read points of every depth image in the fixed frame, image by image."""
    place = find_layout(path)
    assert place is not None
    layout, folder = place
    yield from iter_frame_pieces(folder, layout.frames(folder), [], options)


def find_layout(path: Path) -> tuple[Layout, Path] | None:
    """Find the layout of a folder, or of the only folder below it that has one; None: there is none.

    Raises:
        InputError: several folders below have one.
    """
    here = _match_layout(path)
    if here is not None:
        return here, path
    below = [(layout, p) for p in sorted(path.iterdir()) if p.is_dir() and (layout := _match_layout(p)) is not None]
    if len(below) > 1:
        shown = ", ".join(p.name for _, p in below)[:200]
        raise InputError(f"{path}: holds several recordings of RGB-D images ({shown}); give one of them")
    return below[0] if below else None


def _match_layout(folder: Path) -> Layout | None:
    return next((layout for layout in LAYOUTS if all((folder / mark).exists() for mark in layout.marks)), None)


def _iter_replica(folder: Path) -> Iterator[Frame]:
    """Read `results/depth000000.png`, `results/frame000000.jpg`, and line 1 of `traj.txt`; `cam_params.json` here or one
    above."""
    camera = _read_replica_camera(folder)
    rows = [row for _, row in _read_rows(folder / "traj.txt", 16)]
    for file, done in _iter_images(folder / "results", "depth*.png"):
        number = _parse_number(file)
        if number >= len(rows):
            raise InputError(
                f"{folder / 'traj.txt'}: has {len(rows):,} poses, none for {file.name}; it is cut short, copy it again"
            )
        yield Frame(
            file,
            file,
            camera,
            np.reshape(rows[number], (4, 4)),
            _find_optional_file(folder / "results" / f"frame{file.stem[5:]}.jpg"),
            done=done,
        )


def _read_replica_camera(folder: Path) -> Camera:
    files = [place / "cam_params.json" for place in (folder, folder.resolve().parent)]
    file = next((f for f in files if f.is_file()), None)
    if file is None:
        raise InputError(f"{folder}: has no cam_params.json with its camera, nor has the folder above; copy it from the data set")
    text = _read_text(file)
    try:
        values: Any = json.loads(text)["camera"]
        fx, fy, cx, cy, metre, width, height = (float(values[k]) for k in ("fx", "fy", "cx", "cy", "scale", "w", "h"))
        return Camera((fx, fy), (cx, cy), metre, (int(height), int(width)), f"mend {file.name}")
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(f"{file}: does not say w h fx fy cx cy and scale of a camera ({error}); mend it") from error


def _iter_scannet(folder: Path) -> Iterator[Frame]:
    """Read `depth/0.png`, `pose/0.txt`, `color/0.jpg`, and `intrinsic/intrinsic_depth.txt`, as ScanNet's exporter writes them."""
    camera = _read_matrix_camera(folder / "intrinsic" / "intrinsic_depth.txt")
    stated = folder / "intrinsic" / "intrinsic_color.txt"
    lens = _read_matrix_camera(stated) if stated.is_file() else None
    for file, done in _iter_images(folder / "depth", "*.png"):
        color = next((c for c in ((folder / "color" / file.name).with_suffix(s) for s in (".jpg", ".png")) if c.is_file()), None)
        yield Frame(file, file, camera, _read_pose(folder / "pose" / f"{file.stem}.txt"), color, lens, done)


def _iter_3rscan(folder: Path) -> Iterator[Frame]:
    """Read `frame-000000.depth.pgm`, `.pose.txt`, `.color.jpg`, and `_info.txt`, in the folder or in `sequence/`."""
    folder = folder if (folder / "_info.txt").is_file() else folder / "sequence"
    info = folder / "_info.txt"
    values = {name.strip(): text.split() for name, _, text in (line.partition("=") for line in _read_text(info).splitlines())}
    camera, lens = (_parse_info_camera(info, values, what) for what in ("Depth", "Color"))
    for file, done in _iter_images(folder, "frame-*.depth.pgm"):
        stem = file.name.removesuffix(".depth.pgm")
        yield Frame(
            file,
            file,
            camera,
            _read_pose(folder / f"{stem}.pose.txt"),
            _find_optional_file(folder / f"{stem}.color.jpg"),
            lens,
            done,
        )


def _parse_info_camera(info: Path, values: dict[str, list[str]], what: str) -> Camera:
    """Return the camera of depth or of colours that `_info.txt` states."""
    try:
        matrix = np.array(values[f"m_calibration{what}Intrinsic"], float).reshape(4, 4)
        size = (int(values[f"m_{what.lower()}Height"][0]), int(values[f"m_{what.lower()}Width"][0]))
        metre = float(values["m_depthShift"][0])
        return Camera((matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]), metre, size, f"mend {info.name}")
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(f"{info}: does not state the camera of {what.lower()} ({error}); copy it again") from error


def _iter_arkit(folder: Path) -> Iterator[Frame]:
    """Read `lowres_depth/ID_TIME.png`, its calibration in `lowres_wide_intrinsics/ID_TIME.pincam`, and `lowres_wide.traj`.

    Depth that the device was least sure of (`confidence/` 0) is left out.
    """
    trajectory = _read_arkit_trajectory(folder / "lowres_wide.traj")
    images = list(_iter_images(folder / "lowres_depth", "*.png"))
    times = np.array([_parse_arkit_time(file) for file, _ in images])
    calibrations = [file for file, _ in _iter_images(folder / "lowres_wide_intrinsics", "*.pincam")]
    calibrated = np.array([_parse_arkit_time(file) for file in calibrations])
    near = trajectory.measure_gap(times) <= LONGEST_GAP
    for (file, done), time, close, pose in zip(images, times.tolist(), near.tolist(), trajectory.interpolate(times), strict=True):
        nearest = int(np.abs(calibrated - time).argmin())
        if abs(calibrated[nearest] - time) > CALIBRATION_GAP:
            raise InputError(f"{file}: has no calibration in lowres_wide_intrinsics at its time; copy the folder again")
        camera = _read_pincam(calibrations[nearest])
        depth: Path | Array = file
        sure = folder / "confidence" / file.name
        if close and sure.is_file():
            depth, trusted = read_depth(file), read_pixels(sure, sure)
            depth = np.where(trusted == 0, 0, depth) if trusted.shape == depth.shape else depth
        yield Frame(
            file, depth, camera, pose if close else None, _find_optional_file(folder / "lowres_wide" / file.name), done=done
        )


def _read_arkit_trajectory(path: Path) -> Trajectory:
    """Read the poses of the camera out of those of the world in it: time, turn (axis times angle), place."""
    numbered = _read_rows(path, 7)
    rows = np.array([row for _, row in numbered])
    back = np.flatnonzero(np.diff(rows[:, 0]) < 0)
    if len(back):
        raise InputError(f"{path}: the clock runs backwards at line {numbered[back[0] + 1][0]}; sort or cut the file")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rows[:, 1:4]).as_matrix()
    poses[:, :3, 3] = rows[:, 4:]
    return Trajectory(np.linalg.inv(poses), rows[:, 0])


def _parse_arkit_time(file: Path) -> float:
    try:
        time = float(file.stem.rpartition("_")[2])
    except ValueError:
        time = np.nan
    if not np.isfinite(time):
        raise InputError(f"{file}: has no time (s) at the end of its name; copy it again under its own")
    return time


def _read_pincam(path: Path) -> Camera:
    fields = _read_text(path).split()
    try:
        width, height, fx, fy, cx, cy = map(float, fields)
        return Camera((fx, fy), (cx, cy), MILLIMETRES, (int(height), int(width)), f"mend {path.name}")
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: is not width height fx fy cx cy of a camera; copy it again") from error


def _read_matrix_camera(path: Path) -> Camera:
    """Return the camera of a matrix of four rows of four numbers, for images of millimetres."""
    matrix = _read_matrix(path)
    try:
        return Camera((matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]), MILLIMETRES, mend=f"mend {path.name}")
    except ValueError as error:
        raise InputError(f"{path}: {error}; mend it") from error


def _read_pose(path: Path) -> Array | None:
    """Return (4, 4) pose of a frame, not finite where tracking was lost; None: it has no file."""
    return _read_matrix(path) if path.is_file() else None


def _read_matrix(path: Path) -> Array:
    fields = NO_NUMBER.sub("nan", _read_text(path)).split()
    try:
        return np.array(fields, float).reshape(4, 4)
    except ValueError as error:
        raise InputError(f"{path}: is not four rows of four numbers; copy it again") from error


def _read_rows(path: Path, width: int) -> list[tuple[int, list[float]]]:
    """Return (number, values) of each line of a trajectory."""
    _check_exists(path)
    rows = list(iter_number_rows(path, {width: path.name}))
    if not rows:
        raise InputError(f"{path}: holds no poses; copy it again")
    return rows


def _check_exists(path: Path) -> None:
    if not path.is_file():
        raise InputError(f"{path}: no such file, and it belongs to the images beside it; copy the folder again")


def _read_text(path: Path) -> str:
    _check_exists(path)
    if path.stat().st_size > LARGEST_TEXT:
        raise InputError(f"{path}: has {path.stat().st_size:,} bytes, too many for a calibration or a pose; copy it again")
    return path.read_text(encoding="utf-8", errors="replace")


def _iter_images(folder: Path, pattern: str) -> Iterator[tuple[Path, float]]:
    """Yield the files of a pattern in the order of their numbers, with the share that is read after each."""
    shown = (p for p in folder.glob(pattern) if not p.name.startswith("."))  # macOS leaves "._" files beside those that it copies
    files = sorted(shown, key=lambda p: ([int(n) for n in re.findall(r"\d+", p.stem)], p.name))
    if not files:
        raise InputError(f"{folder}: holds no {pattern}; copy it again")
    for number, file in enumerate(files, 1):
        yield file, number / len(files)


def _parse_number(file: Path) -> int:
    """Return the number at the end of a name."""
    match = re.search(r"(\d+)$", file.stem)
    if match is None:
        raise InputError(f"{file}: has no number at the end of its name; copy it again under its own")
    return int(match[1])


def _find_optional_file(file: Path) -> Path | None:
    return file if file.is_file() else None


LAYOUTS = (
    Layout("Replica", ("traj.txt", "results"), _iter_replica),
    Layout("ScanNet", ("depth", "pose"), _iter_scannet),
    Layout("3RScan", ("_info.txt",), _iter_3rscan),
    Layout("3RScan", ("sequence/_info.txt",), _iter_3rscan),
    Layout("ARKitScenes", ("lowres_depth",), _iter_arkit),
)
