"""3D scene graphs as Hydra saves them (JSON of Spark-DSG): the mesh in ``dsg_with_mesh.json`` becomes points.

The mesh lists `points` (x, y, z in m, z up), `faces` (three numbers of points each) and `colors` (r, g, b, a). Rooms, places and
objects of the graph are not taken over: rooms are cut anew, as those of any scan, so that two maps can be compared.
Source: what spark-dsg 1.1.3 writes (https://github.com/MIT-SPARK/Spark-DSG).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.mesh import sample
from topomerge.io.options import ReadOptions
from topomerge.io.piece import Piece, damaged
from topomerge.types import Array

BEYOND_NUMBERS = 2**53  # of a vertex: from here on not every whole number is a float64
GRAPH_KIND = "a scene graph"


def is_scene_graph(about: object) -> bool:
    """Is this what Spark-DSG saves? Old versions have no header."""
    return isinstance(about, dict) and isinstance(about.get("nodes"), list) and isinstance(about.get("edges"), list)


def pieces(path: Path, graph: Mapping[str, Any], options: ReadOptions) -> Iterator[Piece]:
    """The vertices of the mesh, then points sampled on its faces, in metres.

    Raises:
        InputError: the graph has no mesh, or a damaged one.
    """
    mesh = graph.get("mesh")
    if not isinstance(mesh, dict) or not mesh.get("points"):
        raise InputError(
            f"{path}: is a scene graph without a mesh, so that nothing tells where its walls are; give dsg_with_mesh.json, which "
            "Hydra saves beside it"
        )
    vertices = _table(path, mesh["points"], "points")
    faces = _table(path, mesh.get("faces") or np.zeros((0, 3)), "faces")
    if not (np.abs(faces) < BEYOND_NUMBERS).all() or (faces != np.round(faces)).any():  # so of nan, too
        raise damaged(path, GRAPH_KIND, "a face of its mesh names a vertex that does not exist")
    colors = _colors(path, mesh, len(vertices))
    yield Piece(vertices, colors, done=0.5)
    yield from sample(path, vertices, faces.astype(np.int64), options, colors)


def _table(path: Path, rows: Any, name: str) -> Array:
    """(n, 3) float64."""
    try:
        table = np.array(rows, np.float64)
    except (TypeError, ValueError) as error:
        raise damaged(path, GRAPH_KIND, f"{name} of its mesh are no rows of three numbers") from error
    if table.ndim != 2 or table.shape[1] != 3:
        raise damaged(path, GRAPH_KIND, f"{name} of its mesh are no rows of three numbers")
    return table


def _colors(path: Path, mesh: Mapping[str, Any], many: int) -> Array | None:
    """(many, 3) uint8; None where the mesh has none."""
    listed = mesh.get("colors")
    if not listed or not mesh.get("has_colors", True):
        return None
    try:
        table = np.array([[c["r"], c["g"], c["b"]] for c in listed], np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise damaged(path, GRAPH_KIND, "colors of its mesh are none") from error
    if table.shape != (many, 3):
        raise damaged(path, GRAPH_KIND, f"its mesh has {many:,} points and {len(table):,} colors")
    return np.nan_to_num(table).clip(0, 255).astype(np.uint8)
