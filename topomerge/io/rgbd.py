"""Posed RGB-D images as the TUM benchmark lays them out: `depth.txt`, `rgb.txt` and `groundtruth.txt` in a folder.

A line of the first two is a time (s) and the name of an image; depth is 16-bit PNG, 5000 a metre, 0 where nothing was measured.
The camera is that of the benchmark (by the folder's name), or `camera.txt` beside them: ``fx fy cx cy [depth of 1 m]``.
Source: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.io.depth_images import Camera, Frame
from topomerge.io.pictures import iter_frame_pieces
from topomerge.io.piece import Piece, ReadOptions
from topomerge.io.trajectory import LONGEST_GAP, Trajectory, read_trajectory

COLOR_GAP = 0.05  # s between a depth image and its colours
DEPTH_OF_METRE = 5000.0
TUM_SIZE = (480, 640)  # rows and columns for which the cameras below hold
CAMERAS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
USUAL_CAMERA = (525.0, 525.0, 319.5, 239.5)


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read points of every depth image in the frame of the trajectory, image by image."""
    source = Path(options.poses) if options.poses else path / "groundtruth.txt"
    if not source.exists() and not options.poses:
        raise InputError(f"{path}: has depth images, but no groundtruth.txt; give --poses with a trajectory (TUM)")
    trajectory = read_trajectory(source)
    if trajectory.times is None:
        raise InputError(f"{source}: has no times; give a trajectory in the format of TUM, with those of the images")
    camera, warnings = _read_camera(path)
    depths = _read_image_list(path, "depth.txt")
    colors = _read_image_list(path, "rgb.txt") if (path / "rgb.txt").is_file() else []
    yield from iter_frame_pieces(path, _iter_frames(path, depths, colors, trajectory, camera), warnings, options)


def _read_camera(path: Path) -> tuple[Camera, list[str]]:
    """Return the camera of a folder, and what the user should know of it."""
    stated = path / "camera.txt"
    if stated.is_file():
        try:
            values = [float(v) for v in stated.read_text(encoding="utf-8").split()]
            fx, fy, cx, cy, metre = [*values, DEPTH_OF_METRE][:5]
        except ValueError as error:
            raise InputError(f"{stated}: is not fx fy cx cy, and perhaps the depth of 1 m; mend it") from error
        try:
            return Camera((fx, fy), (cx, cy), metre, mend="mend camera.txt"), []
        except ValueError as error:
            raise InputError(f"{stated}: {error}; mend it") from error
    name = next((n for n in CAMERAS if n in path.resolve().name), None)
    fx, fy, cx, cy = CAMERAS[name] if name else USUAL_CAMERA
    usual = "its camera is not known: the usual one of 640 x 480 is taken; camera.txt with fx fy cx cy states another"
    mend = "state its camera in camera.txt: fx fy cx cy"
    return Camera((fx, fy), (cx, cy), DEPTH_OF_METRE, TUM_SIZE, mend), [] if name else [usual]


def _read_image_list(path: Path, name: str) -> list[tuple[float, Path]]:
    """Return (time, file) of each image of a list, in ascending time.

    Raises:
        InputError: a line that is none, time that runs backwards, or a name outside of the folder.
    """
    images: list[tuple[float, Path]] = []
    for number, line in enumerate((path / name).read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        fields = line.split("#", 1)[0].split()
        if not fields:
            continue
        try:
            time, file = float(fields[0]), path / fields[1]
        except (ValueError, IndexError) as error:
            raise InputError(f"{path / name}: line {number} is not a time and the name of an image; mend it") from error
        if not np.isfinite(time) or (images and time < images[-1][0]):
            raise InputError(f"{path / name}: the clock runs backwards at line {number}; sort the file")
        if not file.resolve().is_relative_to(path.resolve()):
            raise InputError(f"{path / name}: line {number} names a file outside of the folder; put the images into it")
        images.append((time, file))
    if not images:
        raise InputError(f"{path / name}: names no images; copy it again")
    return images


def _iter_frames(
    path: Path, depths: list[tuple[float, Path]], colors: list[tuple[float, Path]], trajectory: Trajectory, camera: Camera
) -> Iterator[Frame]:
    """Yield one image after the other, without a pose where there is none near its time."""
    times = np.array([time for time, _ in depths])
    near = trajectory.measure_gap(times) <= LONGEST_GAP
    if not near.any():
        raise InputError(f"{path}: no depth image has a pose within {LONGEST_GAP:g} s; give --poses with those of these images")
    color_times = np.array([time for time, _ in colors])
    for number, pose in enumerate(trajectory.interpolate(times)):
        time, file = depths[number]
        shown = None
        if len(colors) and abs(color_times[nearest := int(np.abs(color_times - time).argmin())] - time) <= COLOR_GAP:
            shown = colors[nearest][1]
        done = (number + 1) / len(depths)
        yield Frame(file, file, camera, pose if near[number] else None, shown, done=done, time=time)
