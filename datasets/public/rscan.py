"""3RScan (Wald et al. 2019): rooms scanned with a tablet on several days, with the transforms between the days.

    3RScan.json                        scenes: `reference` scan, and `scans` of later days with their `transform`
    <scan>/mesh.refined.v2.obj         mesh, m, z up (first version: mesh.refined.obj)
    <scan>/mesh.refined.0.010000.segs.v2.json, semseg.v2.json    objects (see `scannet.read_objects`)

A transform maps a later scan into the reference: 16 numbers, column by column, as the owners' own reader has it. Their FAQ says
that translations are in mm, but their code applies them to metres as they are: metres they are here, unless one is beyond any
room. Transforms tilt by fractions of a degree: that part is applied to the later scan, so that the truth stays exact. Scenes of
the hidden test set have no transform and are refused.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.public.sources import POINT_SPACING, build_framed_pair, read_json

from topomerge.errors import InputError
from topomerge.io.points import read_points
from topomerge.types import Array, PointCloud, Sim3

MESHES = ("mesh.refined.v2.obj", "mesh.refined.obj", "labels.instances.annotated.v2.ply", "labels.instances.annotated.ply")
FARTHEST_LEAN = 50.0  # m between the frames of two scans of a room; numbers beyond are mm
TILT = 10.0  # degrees; a transform that leans more is wrong


def iter_pairs(folder: Path) -> Iterator[tuple[str, Callable[[], Pair]]]:
    """Yield the name and maker of a pair of each reference and each of its later scans that is there.

    Raises:
        InputError: `3RScan.json` is missing or damaged.
    """
    scenes = read_json(folder / "3RScan.json")
    if not isinstance(scenes, list) or not all(isinstance(s, dict) and "reference" in s for s in scenes):
        raise InputError(f"{folder / '3RScan.json'}: is no list of scenes with a reference; copy it again")
    for scene in scenes:
        for scan in scene.get("scans", []):
            a, b = str(scene["reference"]), str(scan.get("reference", ""))
            if (folder / a).is_dir() or (folder / b).is_dir():  # most people fetch some of the scans
                yield f"{a[:8]}-{b[:8]}", partial(_load_pair, folder, a, b, scan.get("transform"))


def _load_pair(folder: Path, a: str, b: str, transform: Any) -> Pair:
    if transform is None:
        raise InputError(f"{b}: no transform is published (hidden test set)")
    published, lean = split_yaw_and_tilt(read_transform(transform, b))
    first, second = _read(folder / a), _read(folder / b)
    points = (second.points.astype(np.float64) + second.shift) @ lean.T
    second = PointCloud(points.astype(np.float32), source=second.source)
    name = f"{a[:8]}-{b[:8]}"
    return build_framed_pair(first, second, published, name, "rscan", a, "depth", zlib.crc32(name.encode()))


def read_transform(numbers: Any, name: str) -> Array:
    """Read (4, 4) float64, m, of 16 numbers.

    Raises:
        InputError: not a rigid transform.
    """
    try:
        matrix = np.array(numbers, float).reshape(4, 4).T.copy()
    except (ValueError, TypeError) as error:
        raise InputError(f"{name}: its transform is no list of 16 numbers; copy 3RScan.json again") from error
    if np.abs(matrix[:3, 3]).max() > FARTHEST_LEAN:
        matrix[:3, 3] /= 1000
    turn = matrix[:3, :3]
    if not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-4) or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-2):
        raise InputError(f"{name}: its transform is not rigid; is 3RScan.json of another version?")
    return matrix


def split_yaw_and_tilt(matrix: Array) -> tuple[Sim3, Array]:
    """Return a rigid transform as one about the vertical after a lean: matrix = Sim3 · (3, 3) lean.

    Raises:
        InputError: it leans by more than `TILT`.
    """
    turn = matrix[:3, :3]
    yaw = float(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
    published = Sim3(yaw, tuple(matrix[:3, 3].tolist()))
    lean = Sim3(-yaw).matrix[:3, :3] @ turn
    degrees = np.degrees(np.arccos(np.clip(lean[2, 2], -1, 1)))
    if degrees > TILT:
        raise InputError(f"its transform leans by {degrees:.0f}°; maps of one gravity don't")
    return published, lean


def _read(folder: Path) -> PointCloud:
    mesh = next((folder / name for name in MESHES if (folder / name).is_file()), None)
    if mesh is None:
        raise InputError(f"{folder}: has none of {', '.join(MESHES[:2])}; copy the scan again")
    return read_points(mesh, spacing=POINT_SPACING)
