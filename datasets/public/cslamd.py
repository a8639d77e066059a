"""Collaborative SLAM Dataset (CSD; Golodetz et al. 2018): four buildings, each in several sequences by phone.

    Flat/global_poses.txt     bathroom2study [(0.92,0.01),(0.0,4.67),(-0.39,0.06),(0.0,-1.09)]
    Flat/meshes/...           the mesh of each sequence, moved by its global pose already

A global pose is a dual quaternion (w, x, y, z, each with its dual part); a mesh without one can't have been moved and is refused.
All meshes of a building are thus in one frame, and random frames are put on them.

Assumed, as the owners don't state it: each mesh is a file whose name starts with the sequence's, and y points down as in the
frame of the first camera.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.public.sources import POINT_SPACING, build_framed_pair

from topomerge.errors import InputError
from topomerge.io.points import read_points
from topomerge.types import Array, Sim3

MAP_UP = "-y"
SUFFIXES = (".ply", ".obj", ".stl")
LARGEST_POSES = 1 << 20  # bytes of the list of poses
NUMBER = r"[-+]?[\d.]+(?:[eE][-+]?\d+)?"
POSE = re.compile(r"(\S+)\s+\[" + r"\s*,\s*".join([rf"\(({NUMBER})\s*,\s*({NUMBER})\)"] * 4) + r"\]\s*")


def iter_pairs(folder: Path) -> Iterator[tuple[str, Callable[[], Pair]]]:
    """Yield the name and maker of every two sequences of a building.

    Raises:
        InputError: no building with poses in the folder.
    """
    listed = sorted(folder.glob("*/global_poses.txt"))
    if not listed:
        raise InputError(f"{folder}: has no */global_poses.txt; give the folder of the data set")
    for path in listed:
        try:
            poses = read_poses(path)
        except InputError as error:  # this building's; the others go on
            yield path.parent.name, partial(_refuse, error)
            continue
        for a, b in combinations(sorted(poses), 2):
            yield f"{path.parent.name}/{a}-{b}", partial(_load_pair, path.parent, a, b)


def _refuse(error: InputError) -> Pair:
    raise error


def _load_pair(building: Path, a: str, b: str) -> Pair:
    one, other = (read_points(_find_mesh(building, name), up=MAP_UP, spacing=POINT_SPACING) for name in (a, b))
    name = f"{building.name}/{a}-{b}"
    return build_framed_pair(one, other, Sim3(), name, "cslamd", building.name, "phone", zlib.crc32(name.encode()))


def _find_mesh(building: Path, name: str) -> Path:
    meshes = sorted(p for p in building.glob(f"meshes/**/{name}*") if p.suffix.lower() in SUFFIXES)
    if not meshes:
        raise InputError(f"{building / 'meshes'}: has no mesh of {name}; fetch {building.name}-meshes.zip")
    return meshes[0]


def read_poses(path: Path) -> dict[str, Array]:
    """Read sequence -> (4, 4) float64 global pose, m.

    Raises:
        InputError: too large, a damaged line, or no rotation.
    """
    if path.stat().st_size > LARGEST_POSES:
        raise InputError(f"{path}: is too large for a list of poses")
    out = {}
    for number, line in enumerate(path.read_text(encoding="latin-1").splitlines(), 1):
        if not line.strip():
            continue
        pose = POSE.fullmatch(line)
        try:
            values = np.array([float(v) for v in pose.groups()[1:]]) if pose else np.zeros(8)
        except ValueError:
            values = np.zeros(8)
        if pose is None or abs(float(np.linalg.norm(values[::2])) - 1) > 0.01:
            raise InputError(f"{path}: line {number} is no name with a pose [(w,w'),(x,x'),(y,y'),(z,z')]; copy it again")
        out[pose[1]] = convert_dual_quaternion(values[::2], values[1::2])
    return out


def convert_dual_quaternion(real: Array, dual: Array) -> Array:
    """Return (4, 4) rigid transform of a unit dual quaternion, w first: the translation is 2 dual * conj(real)."""
    from scipy.spatial.transform import Rotation

    w, v = real[0], real[1:]
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([*v, w]).as_matrix()
    matrix[:3, 3] = 2 * (w * dual[1:] - dual[0] * v - np.cross(dual[1:], v))
    return matrix
