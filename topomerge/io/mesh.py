"""Meshes: obj, stl, glb and gltf, sampled evenly by area. Vertices are kept too, so nothing small is lost."""

from __future__ import annotations

import io
import itertools
import json
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.piece import BLOCK_POINTS, MOST_POINTS, Piece, ReadOptions, build_count_error, build_damage_error
from topomerge.kernels.meshes import compute_areas, sample_triangles
from topomerge.types import Array

SURFACE_SPACING = 0.05  # m between points sampled on surfaces
LONGEST_EDGE = 10_000.0  # m, edge of a triangle beyond any building
MOST_SHARED = 4  # times that the bytes of a scene may be shown by its views


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read vertices of every part of a scene, then points sampled on its faces. Materials and textures are not loaded."""
    count = 0
    for vertices, faces in _load_parts(path):
        yield Piece(vertices, done=0.3)
        count += len(vertices)
        for piece in sample(path, vertices, faces, options):
            yield piece
            count += len(piece.points)
            if count > MOST_POINTS:  # one part can stand in a scene a thousand times
                raise build_count_error(path, count, options.spacing or SURFACE_SPACING)
    if not count:
        raise InputError(f"{path}: holds no vertices; export it again")


def sample(
    path: Path, vertices: Array, faces: Array, options: ReadOptions, colors: Array | None = None, first: int = 0
) -> Iterator[Piece]:
    """Sample pieces of points on the faces (m, 3) of a mesh, one an area of spacing².

    Raises:
        InputError: a face names a vertex that does not exist, or the area is too large for the spacing.
    """
    if not len(faces):
        return
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise build_damage_error(path, "a mesh", "a face names a vertex that does not exist")
    spacing = (options.spacing or SURFACE_SPACING) / options.factor
    triangles = np.asarray(vertices, np.float64)[faces]
    numbers = np.flatnonzero(np.isfinite(triangles).all(axis=(1, 2)))
    _check_size(path, triangles[numbers], spacing, options.factor)
    triangles, numbers = _split_triangles(triangles[numbers], numbers, BLOCK_POINTS * spacing**2)
    ends = np.cumsum(compute_areas(triangles)) / spacing**2
    cuts = np.searchsorted(ends, np.arange(BLOCK_POINTS, ends[-1] if len(ends) else 0, BLOCK_POINTS))
    bounds = np.unique(np.concatenate([[0], cuts, [len(triangles)]]))
    for low, high in itertools.pairwise(bounds.tolist()):
        points, owner = sample_triangles(triangles[low:high], spacing, first + low)
        shades = None if colors is None else colors[faces[numbers[low:high][owner]]].mean(axis=1).astype(np.uint8)
        yield Piece(points, shades, done=0.5 + 0.5 * high / len(triangles))


def _check_size(path: Path, triangles: Array, spacing: float, factor: float) -> None:
    """Refuse what no building is: it would take all memory, and steps of one spacing would be lost in rounding."""
    if not len(triangles):
        return
    longest = float(np.ptp(triangles, axis=1).max()) * factor
    if not longest <= LONGEST_EDGE or np.abs(triangles).max() > 1e12 * spacing:
        raise InputError(f"{path}: has a triangle of {longest:.3g} m; check --unit, or export it again")
    total = float(compute_areas(triangles).sum()) / spacing**2
    if not total <= MOST_POINTS:
        raise build_count_error(path, total, spacing * factor)


def _split_triangles(triangles: Array, numbers: Array, largest: float) -> tuple[Array, Array]:
    """Return the triangles (m, 3, 3) and their numbers (m,), those above the largest area cut across their longest edges."""
    while (large := compute_areas(triangles) > largest).any():
        cut = triangles[large]
        edge = np.linalg.norm(np.roll(cut, -1, axis=1) - cut, axis=2).argmax(axis=1)
        each = np.arange(len(cut))
        a, b, c = (cut[each, (edge + i) % 3] for i in range(3))
        middle = (a + b) / 2
        halves = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        triangles = np.concatenate([triangles[~large], halves])
        numbers = np.concatenate([numbers[~large], numbers[large], numbers[large]])
    return triangles, numbers


def _load_parts(path: Path) -> list[tuple[Array, Array]]:
    """Return (vertices, faces) of each part, placed in the scene."""
    import trimesh

    logging.getLogger("trimesh").setLevel(logging.ERROR)
    kind = path.suffix.lower()[1:]
    _check_start(path, kind)
    requested: dict[str, Any] = {"process": False, "maintain_order": True}
    if kind == "obj":
        requested |= {"skip_materials": True, "split_object": False, "group_material": False}
    if kind in ("glb", "gltf"):
        requested |= {"skip_materials": True, "merge_primitives": False}
    data = io.BytesIO(path.read_bytes())
    resolver = trimesh.resolvers.FilePathResolver(str(path)) if kind == "gltf" else None
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            scene = trimesh.load_scene(data, file_type=kind, resolver=resolver, **requested)
    except OSError as error:
        raise InputError(f"{path}: damaged, or a file that it names is missing ({error}); export it as one glb") from error
    parts = []
    for name in scene.graph.nodes_geometry:
        matrix, geometry = scene.graph[name]
        shape = scene.geometry[geometry]
        vertices = trimesh.transform_points(np.asarray(shape.vertices, np.float64).reshape(-1, 3), matrix)
        parts.append((vertices, np.asarray(getattr(shape, "faces", np.empty((0, 3))), np.int64).reshape(-1, 3)))
    return parts


def _check_start(path: Path, kind: str) -> None:
    """Check what the library would trust: magic, and counts against the file's size."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(1024)
    if kind == "stl" and head.lstrip()[:5].lower() != b"solid":
        count = int.from_bytes(head[80:84], "little")
        if 84 + 50 * count > size or size < 84:
            raise build_damage_error(path, "an STL file", f"{count:,} triangles promised in {size:,} bytes")
    if kind == "glb":
        if head[:4] != b"glTF":
            raise InputError(f"{path}: is not a binary glTF file; check the file's suffix")
        length, text = int.from_bytes(head[8:12], "little"), int.from_bytes(head[12:16], "little")
        if max(length, 20 + text) > size:
            raise build_damage_error(path, "a glTF file", f"{size:,} of {max(length, 20 + text):,} bytes")
        with path.open("rb") as stream:
            stream.seek(20)
            _check_gltf(path, stream.read(text), size)
    if kind == "gltf":
        _check_gltf(path, path.read_bytes(), size)


def _check_gltf(path: Path, text: bytes, size: int) -> None:
    """Refuse a scene that is compressed, names files of other folders, or would take more memory than its bytes explain."""
    try:
        tree = json.loads(text)
        needed = set(tree.get("extensionsRequired", ()))
        uris = [str(b["uri"]) for b in tree.get("buffers", ()) if "uri" in b]
        have = size + sum(_measure_linked_file(path, uri) for uri in uris)
        accessors, views = tree.get("accessors", ()), tree.get("bufferViews", ())
        largest = max((int(a["count"]) for a in accessors), default=0)
        blank = sum(int(a["count"]) for a in accessors if "bufferView" not in a)  # zeros, made without any data
        shared = sum(int(v["byteLength"]) for v in views)  # views are copied, and many can show the same bytes
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise build_damage_error(path, "a glTF file", error) from error
    packed = [name for name in needed if "compression" in name]
    if packed:
        raise InputError(f"{path}: is compressed with {packed[0]}, which is not read; export it without")
    if max(largest, blank) > have or shared > MOST_SHARED * have:
        raise build_damage_error(path, "a glTF file", f"{max(largest, blank, shared):,} values promised in {have:,} bytes")


def _measure_linked_file(path: Path, uri: str) -> int:
    """Return the bytes of a file that a scene names; 0 of data within the scene itself, and of a file that does not exist."""
    if uri.startswith("data:"):
        return 0
    file = (path.parent / uri).resolve()
    if not file.is_relative_to(path.parent.resolve()):
        raise InputError(f"{path}: names {uri[:200]!r}, which is not in its folder; export it as one glb")
    if file.exists() and not file.is_file():
        raise InputError(f"{path}: names {uri[:200]!r}, which is no file; export it as one glb")
    return file.stat().st_size if file.exists() else 0
