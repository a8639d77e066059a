"""Meshes: obj, stl, off, glb and gltf, sampled evenly by area. Vertices are kept too, so nothing small is lost."""

from __future__ import annotations

import io
import itertools
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.piece import BLOCK, LIMIT, Options, Piece, damaged, too_many
from topomerge.kernels.lattice import areas, points_on_triangles
from topomerge.types import Array

SPACING = 0.05  # m between points sampled on surfaces


def read(path: Path, options: Options) -> Iterator[Piece]:
    """Vertices of every part of a scene, then points sampled on its faces. Materials and textures are not loaded."""
    found = 0
    for vertices, faces in _parts(path):
        found += len(vertices)
        yield Piece(vertices, done=0.3)
        yield from sample(path, vertices, faces, options)
    if not found:
        raise InputError(f"{path}: holds no vertices; export it again")


def sample(
    path: Path, vertices: Array, faces: Array, options: Options, colors: Array | None = None, first: int = 0
) -> Iterator[Piece]:
    """Pieces of points on the faces (m, 3) of a mesh, one an area of spacing².

    Raises:
        InputError: a face names a vertex that does not exist, or the area is too large for the spacing.
    """
    if not len(faces):
        return
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise damaged(path, "a mesh", "a face names a vertex that does not exist")
    spacing = (options.spacing or SPACING) / options.factor
    triangles = np.asarray(vertices, np.float64)[faces]
    finite = np.isfinite(triangles).all(axis=(1, 2))
    triangles, faces = triangles[finite], faces[finite]
    counts = areas(triangles) / spacing**2
    total = float(counts.sum())
    # Beyond the second bound a step of one spacing is lost in rounding.
    if not total <= LIMIT or np.abs(triangles).max(initial=0.0) > 1e12 * spacing:
        raise too_many(path, total, spacing * options.factor)
    ends = np.cumsum(counts)
    cuts = np.searchsorted(ends, np.arange(BLOCK, max(total, 1), BLOCK))
    bounds = np.unique(np.concatenate([[0], cuts, [len(triangles)]]))
    for low, high in itertools.pairwise(bounds):
        points, owner = points_on_triangles(triangles[low:high], spacing, first + int(low))
        shades = None if colors is None else colors[faces[low:high][owner]].mean(axis=1).astype(np.uint8)
        yield Piece(points, shades, done=0.5 + 0.5 * float(high) / len(triangles))


def _parts(path: Path) -> list[tuple[Array, Array]]:
    """(vertices, faces) of each part, placed in the scene."""
    import trimesh

    logging.getLogger("trimesh").setLevel(logging.ERROR)
    kind = path.suffix.lower()[1:]
    _check_start(path, kind)
    wanted: dict[str, Any] = {"process": False, "maintain_order": True}
    if kind == "obj":
        wanted |= {"skip_materials": True, "split_object": False, "group_material": False}
    if kind in ("glb", "gltf"):
        wanted |= {"skip_materials": True, "merge_primitives": False}
    with path.open("rb") as stream:
        data = io.BytesIO(stream.read())
    resolver = trimesh.resolvers.FilePathResolver(str(path)) if kind == "gltf" else None
    scene = trimesh.load_scene(data, file_type=kind, resolver=resolver, **wanted)
    parts = []
    for name in scene.graph.nodes_geometry:
        matrix, geometry = scene.graph[name]
        shape = scene.geometry[geometry]
        vertices = trimesh.transform_points(np.asarray(shape.vertices, np.float64).reshape(-1, 3), matrix)
        parts.append((vertices, np.asarray(getattr(shape, "faces", np.empty((0, 3))), np.int64).reshape(-1, 3)))
    return parts


def _check_start(path: Path, kind: str) -> None:
    """What the library would trust: magic, and the counts of binary files against the file's size."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(1024)
    if kind == "glb":
        length = int.from_bytes(head[8:12], "little")
        if head[:4] != b"glTF":
            raise InputError(f"{path}: is not a binary glTF file; check the file's suffix")
        if length > size:
            raise damaged(path, "a glTF file", f"{size:,} of {length:,} bytes")
    if kind == "stl" and head.lstrip()[:5].lower() != b"solid":
        count = int.from_bytes(head[80:84], "little")
        if 84 + 50 * count > size or size < 84:
            raise damaged(path, "an STL file", f"{count:,} triangles promised in {size:,} bytes")
