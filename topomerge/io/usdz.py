"""USDZ of iPhones and iPads: RoomPlan's walls, doors, windows and objects as what they are, Polycam's meshes as surfaces.

RoomPlan's doors and openings lie as boxes in walls that are whole: what of a wall stands in them is left out, and doors are
open. Objects are landmarks at their middles. Nothing outside of the file is followed. The library (usd-core) is in a process of
its own. Sources: the USDZ specification of Pixar (a zip archive that is not packed), and the prims that RoomPlan writes: `Wall0`,
`Door1`, `Chair2` below `Arch_grp` and `Object_grp`, with their category in `customData`.
"""

from __future__ import annotations

import posixpath
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.frame import get_axis_rotation
from topomerge.io.mesh import sample
from topomerge.io.piece import MOST_POINTS, Piece, ReadOptions, build_damage_error, read_head, read_in_subprocess
from topomerge.io.sightings import clean_text
from topomerge.types import Array, build_landmarks, transform_points

KIND = "a USDZ file"
SECONDS, MEMORY = 20, 4 << 30  # of the processor for one part, and bytes
MOST_ENTRIES, MOST_PRIMS, MOST_PARTS = 10_000, 500_000, 200_000
MOST_CORNERS = 60_000_000  # of all faces together
NUMBERED = re.compile(r"([A-Za-z]+?)_?\d+(?:_\w+)?")  # names of RoomPlan's prims
OPEN, DOOR = ("door", "opening"), "door"  # gaps of walls
PLAIN = ("wall", "window", "floor", "ceiling", *OPEN)  # what is no object
LAYERS = (".usd", ".usda", ".usdc", ".usdz")
DEEP = 0.3  # m to either side of a door, in which its wall is left out
UNITS = (1e-4, 1e3)  # m, of a unit that a file may state
CUBE = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64) / 2
CUBE_FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


@dataclass(frozen=True, eq=False)
class Part:
    """A mesh: its category in small letters ("" where none is told), vertices (n, 3) in metres with z up, triangles (m, 3), and
    the directions (3, 3) of its own axes, rows."""

    category: str
    vertices: Array
    faces: Array
    axes: Array


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read vertices and points on the faces of all meshes, in metres with z up."""
    if find_spec("pxr") is None:
        raise ImportError("no usd-core", name="usd-core")
    check_package(path)
    yield from read_in_subprocess("usdz", KIND, path, options, SECONDS, MEMORY)


def check_package(path: Path) -> None:
    """Check the archive: nothing in it is packed, locked or named outside of it, and it begins with a layer.

    Raises:
        InputError: one of these.
    """
    read_head(path, KIND, b"PK\x03\x04", 30)
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except (zipfile.BadZipFile, NotImplementedError, ValueError, EOFError) as error:
        raise build_damage_error(path, KIND, error) from error
    if not entries or len(entries) > MOST_ENTRIES:
        raise build_damage_error(path, KIND, f"{len(entries):,} files in it")
    for entry in entries:
        name = entry.filename
        if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1 or entry.file_size != entry.compress_size:
            raise InputError(f"{path}: packs {name[:60]!r}, which USDZ never does; export it again")
        if name.startswith(("/", "\\")) or ".." in name.replace("\\", "/").split("/"):
            raise InputError(f"{path}: names {name[:60]!r}, which lies outside of it; export it again")
    if sum(entry.file_size for entry in entries) > path.stat().st_size:
        raise build_damage_error(path, KIND, "its files have more bytes than it")
    if not entries[0].filename.lower().endswith(LAYERS[:3]):
        raise InputError(f"{path}: does not begin with a layer of USD ({entries[0].filename[:60]!r}); export it again")


def read_in_process(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Yield the same in this process, which the library may end.

    Raises:
        InputError: a layer names others outside of the file, or there are no meshes, or too many.
    """
    stage = open_stage(path)
    parts = list(_iter_parts(path, stage))
    if not parts:
        raise InputError(f"{path}: holds no meshes; export it with its geometry")
    gaps = [build_gap(part) for part in parts if part.category in OPEN]
    objects = [part for part in parts if part.category and part.category not in PLAIN]
    places = np.array([(p.vertices.min(axis=0) + p.vertices.max(axis=0)) / 2 for p in objects]).reshape(-1, 3)
    known = build_landmarks("object", [part.category for part in objects], path.name, places)
    yield Piece(np.empty((0, 3)), landmarks=known, done=0.1)
    count, kept = 0, [p for p in parts if p.category != "opening" and (options.doors or p.category != DOOR)]
    for number, part in enumerate(kept, 1):
        walled = gaps if part.category == "wall" else []
        for piece in [Piece(part.vertices), *sample(path, part.vertices, part.faces, options)]:
            points = piece.points[~_find_in_gaps(piece.points, walled)]
            count += len(points)
            if count > MOST_POINTS:
                raise InputError(f"{path}: would become more than {MOST_POINTS:,} points; give a larger --spacing")
            yield Piece(points, done=0.1 + 0.9 * number / len(kept))


def open_stage(path: Path) -> Any:
    """Open a file of which nothing lies outside.

    Raises:
        InputError: a layer names others outside of the file, or it can't be opened.
    """
    from pxr import Usd

    refuse_outside(path)
    stage = Usd.Stage.Open(str(path))
    if stage is None:
        raise build_damage_error(path, KIND, "it can't be opened")
    return stage


def build_stage_frame(path: Path, stage: Any) -> Array:
    """Build (4, 4), which takes places of a stage into metres with z up.

    Raises:
        InputError: its unit is none.
    """
    from pxr import UsdGeom

    unit = float(UsdGeom.GetStageMetersPerUnit(stage))
    if not UNITS[0] <= unit <= UNITS[1]:
        raise build_damage_error(path, KIND, f"a unit of {unit:g} m")
    turn = np.eye(4)
    turn[:3, :3] = unit * get_axis_rotation("y" if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else "z")
    return turn


def refuse_outside(path: Path) -> None:
    """Refuse a file whose layers name layers that are not in it.

    Raises:
        InputError: one does, or can't be opened.
    """
    from pxr import Sdf, Tf

    with zipfile.ZipFile(path) as archive:
        names = [entry.filename for entry in archive.infolist()]
    waiting, seen = [names[0]], {names[0]}
    while waiting:
        name = waiting.pop()
        try:
            layer = Sdf.Layer.FindOrOpen(f"{path}[{name}]")
        except Tf.ErrorException:
            layer = None
        if layer is None:
            raise build_damage_error(path, KIND, f"its layer {name[:60]!r} can't be opened")
        for asset in layer.GetCompositionAssetDependencies():
            inside = posixpath.normpath(posixpath.join(posixpath.dirname(name), asset))
            found = inside if inside in names else posixpath.normpath(asset)
            if found not in names or ":" in asset or asset.startswith("/"):
                raise InputError(f"{path}: refers to {asset[:80]!r}, which is not in it and is not followed; export it whole")
            if found not in seen:
                seen.add(found)
                waiting.append(found)


def _iter_parts(path: Path, stage: Any) -> Iterator[Part]:
    """Yield the meshes and boxes of a stage, placed in the world."""
    from pxr import Usd, UsdGeom

    turn = build_stage_frame(path, stage)
    cache, corners, count = UsdGeom.XformCache(), 0, 0
    for number, prim in enumerate(stage.Traverse(Usd.TraverseInstanceProxies())):
        if number > MOST_PRIMS or count > MOST_PARTS:
            raise build_damage_error(path, KIND, f"more than {MOST_PRIMS:,} prims or {MOST_PARTS:,} meshes")
        shape = _load_shape(path, prim)
        if shape is None or UsdGeom.Imageable(prim).ComputeVisibility() == UsdGeom.Tokens.invisible:
            continue
        vertices, faces = shape
        corners, count = corners + 3 * len(faces), count + 1
        if corners > MOST_CORNERS:
            raise build_damage_error(path, KIND, f"more than {MOST_CORNERS:,} corners of faces")
        matrix = turn @ np.array(cache.GetLocalToWorldTransform(prim), np.float64).T
        placed = transform_points(matrix, vertices)
        if not np.isfinite(placed).all():
            raise build_damage_error(path, KIND, f"{prim.GetName()[:40]} has places that are not finite")
        lengths = np.linalg.norm(matrix[:3, :3], axis=0)
        axes = (matrix[:3, :3] / np.where(lengths > 0, lengths, 1)).T
        if len(placed):
            yield Part(find_category(prim), placed, faces, axes)


def _load_shape(path: Path, prim: Any) -> tuple[Array, Array] | None:
    from pxr import UsdGeom

    if prim.IsA(UsdGeom.Cube):
        size = UsdGeom.Cube(prim).GetSizeAttr().Get()
        return CUBE * float(2.0 if size is None else size), _cut_faces(path, np.full(6, 4), np.array(CUBE_FACES).ravel())
    if not prim.IsA(UsdGeom.Mesh):
        return None
    mesh = UsdGeom.Mesh(prim)
    points, counts, indices = (
        a.Get() for a in (mesh.GetPointsAttr(), mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr())
    )
    if points is None:
        return None
    vertices = np.array(points, np.float64).reshape(-1, 3)
    listed = [np.zeros(0, np.int64) if values is None else np.array(values, np.int64) for values in (counts, indices)]
    faces = _cut_faces(path, *listed)
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise build_damage_error(path, KIND, f"a face of {prim.GetName()[:40]} names a vertex that does not exist")
    return vertices, faces


def _cut_faces(path: Path, counts: Array, indices: Array) -> Array:
    """Return (m, 3) triangles of polygons, each cut from its first corner."""
    if len(counts) and (counts.min() < 3 or counts.max() > 1 << 20):
        counts_kept = counts >= 3
        if counts.min() < 0 or counts.max() > 1 << 20:
            raise build_damage_error(path, KIND, "a face of so many corners")
    else:
        counts_kept = np.ones(len(counts), bool)
    if counts.sum() != len(indices):
        raise build_damage_error(path, KIND, f"faces of {counts.sum():,} corners, of which {len(indices):,} are listed")
    starts = np.cumsum(counts) - counts
    starts, counts = starts[counts_kept], counts[counts_kept]
    each = np.repeat(np.arange(len(counts)), counts - 2)
    step = np.arange(len(each)) - np.repeat(np.cumsum(counts - 2) - (counts - 2), counts - 2)
    return np.column_stack([indices[starts[each]], indices[starts[each] + step + 1], indices[starts[each] + step + 2]]).reshape(
        -1, 3
    )


def find_category(prim: Any) -> str:
    """Find what a prim is, by its own category or that of a group around it, else by RoomPlan's numbered names; "": not told."""
    at = prim
    while at and not at.IsPseudoRoot():
        category = at.GetCustomDataByKey("Category")
        if isinstance(category, str) and category.strip():
            return clean_text(category).lower()
        at = at.GetParent()
    names = prim.GetPath().pathString.split("/")
    if not any(name.endswith("_grp") for name in names):
        return ""
    found = next((m for name in reversed(names) if not name.endswith("_grp") and (m := NUMBERED.fullmatch(name))), None)
    return clean_text(re.sub(r"(?<=[a-z])(?=[A-Z])", " ", found[1])).lower() if found else ""


def build_gap(part: Part) -> tuple[Array, Array, Array]:
    """Build the box of a door: its middle, its axes (rows), and half its sides, with the depth of a wall across."""
    along = part.vertices @ part.axes.T
    low, high = along.min(axis=0), along.max(axis=0)
    half = (high - low) / 2
    half[half.argmin()] += DEEP
    return (low + high) / 2, part.axes, half


def _find_in_gaps(points: Array, gaps: list[tuple[Array, Array, Array]]) -> Array:
    inside = np.zeros(len(points), bool)
    for middle, axes, half in gaps:
        inside |= (np.abs(points @ axes.T - middle) <= half).all(axis=1)
    return inside
