"""ScanNet (Dai et al. 2017): rooms scanned with a tablet."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from topomerge.datasets.plans.floorplans import Refusal
from topomerge.datasets.public.sources import compute_hull, read_json
from topomerge.datasets.real.sources import format_reason

from topomerge.errors import InputError
from topomerge.io.ply import read_header
from topomerge.io.points import read_points
from topomerge.types import Array, PointCloud, TrueRoom


def read_objects(segments: Path, groups: Path, vertices: int) -> tuple[tuple[str, ...], Array]:
    """Read labels of the objects, and (n,) int32 object of each vertex, -1: none.

    Args:
        segments: ``*.segs.json`` with `segIndices`, the segment of each vertex.
        groups: ``*aggregation.json`` or ``semseg*.json`` with `segGroups`, the label and the segments of each object.
        vertices: of the mesh.

    Raises:
        InputError: missing or damaged file, or one of another mesh.
    """
    held, listed = read_json(segments), read_json(groups)
    try:
        segment = np.array(held["segIndices"], np.int64)
        objects = [(str(g["label"]), np.array(g["segments"], np.int64)) for g in listed["segGroups"]]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{groups}: it or {segments.name} lacks what a segmentation holds ({error}); copy both again") from error
    if len(segment) != vertices:
        raise InputError(f"{segments}: segments {len(segment)} vertices and the mesh has {vertices}; are both of one version?")
    out = np.full(len(segment), -1, np.int32)
    for number, (_, members) in enumerate(objects):
        out[np.isin(segment, members)] = number
    return tuple(label for label, _ in objects), out


NAME = re.compile(r"scene\d{4}_\d\d")
LARGEST_VALUES = 1 << 20  # bytes of the table of values


@dataclass(frozen=True, eq=False)
class Scene:
    """A scan of one place.

    Args:
        cloud: the vertices, aligned with the axes where the alignment is published; one room.
        objects: labels.
        object_of: (n,) int32 object of each point, -1: none; empty where the scan is not annotated (test split).
        place: scans of one place have the same.
    """

    cloud: PointCloud
    objects: tuple[str, ...]
    object_of: Array
    place: str


def iter_scenes(folder: str | Path) -> Iterator[tuple[str, Scene | Refusal]]:
    """Yield every scan of a folder, in the order of their names; a bad one is a `Refusal` and the rest goes on.

    Raises:
        InputError: the folder has no scan.
    """
    for name in _list_names(Path(folder)):
        try:
            yield name, read_scene(Path(folder) / name)
        except Exception as error:  # one bad item never ends a run
            yield name, Refusal(name, format_reason(error))


def group_scans_by_place(folder: str | Path) -> dict[str, list[str]]:
    """Map each place to the names of its scans, for places that were scanned more than once."""
    out: dict[str, list[str]] = {}
    for name in _list_names(Path(folder)):
        out.setdefault(name.partition("_")[0], []).append(name)
    return {place: names for place, names in out.items() if len(names) > 1}


def _list_names(folder: Path) -> list[str]:
    names = sorted(p.name for p in folder.iterdir() if NAME.fullmatch(p.name)) if folder.is_dir() else []
    if not names:
        raise InputError(f"{folder}: has no folder scene0000_00 ...; give the folder of the scans")
    return names


def read_scene(folder: Path) -> Scene:
    """Read one scan.

    Raises:
        InputError: the mesh is missing or damaged, or the annotation is of another mesh.
    """
    name = folder.name
    mesh = folder / f"{name}_vh_clean_2.ply"
    if not mesh.is_file():
        raise InputError(f"{mesh}: no such file; copy the scan again")
    vertex = read_header(mesh).find("vertex")
    cloud = read_points(mesh, spacing=1.0)  # the vertices come first, then points on the faces
    count = vertex.count if vertex else 0
    values = _read_values(folder / f"{name}.txt")
    points = (cloud.points[:count].astype(np.float64) + cloud.shift) @ values[0][:3, :3].T + values[0][:3, 3]
    if not len(points):
        raise InputError(f"{mesh}: holds no vertices; copy it again")
    groups, object_of = folder / f"{name}.aggregation.json", np.empty(0, np.int32)
    objects: tuple[str, ...] = ()
    if groups.is_file():
        objects, object_of = read_objects(folder / f"{name}_vh_clean_2.0.010000.segs.json", groups, count)
    floor, ceiling = np.percentile(points[:, 2], [1, 99]).tolist()
    room = TrueRoom(name, compute_hull(points), floor, ceiling, 0, values[1])
    labels = np.zeros(len(points), np.int32)
    colors = None if cloud.colors is None else cloud.colors[:count]
    placed = PointCloud(points.astype(np.float32), colors=colors, labels=labels, rooms=(room,), source=name)
    return Scene(placed, objects, object_of, name.partition("_")[0])


def _read_values(path: Path) -> tuple[Array, str]:
    """Read the alignment (4, 4) and kind of a scan; the identity and nothing where they are not published."""
    if not path.is_file() or path.stat().st_size > LARGEST_VALUES:
        return np.eye(4), ""
    lines = [line.partition("=") for line in path.read_text(encoding="latin-1").splitlines()]
    values = {key.strip(): value.strip() for key, _, value in lines}
    try:
        matrix = np.array(values["axisAlignment"].split(), float).reshape(4, 4) if "axisAlignment" in values else np.eye(4)
    except ValueError as error:
        raise InputError(f"{path}: axisAlignment is no list of 16 numbers; copy it again") from error
    return matrix, values.get("sceneType", "")
