"""Writers of scene graphs: by hand as Spark-DSG saves them, so that no package is needed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

NO_POINTS = np.zeros((0, 3))


def box_mesh(low: Any = (0, 0, 0), high: Any = (4, 3, 2.5)) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (8, 3) and faces (12, 3) of a room seen from inside."""
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    return np.array(low) + corners * (np.array(high) - np.array(low)), np.array(faces)


def scene_graph(vertices: np.ndarray = NO_POINTS, faces: np.ndarray = NO_POINTS, **mesh: Any) -> dict[str, Any]:
    """A graph without nodes; with a mesh where there are vertices."""
    version = {"project_name": "main", "version": {"major": 1, "minor": 1, "patch": 3}}
    graph: dict[str, Any] = {"SPARK_DSG_header": version, "directed": False, "multigraph": False, "nodes": [], "edges": []}
    if len(vertices):
        graph["mesh"] = {"has_colors": False, "points": vertices.tolist(), "faces": faces.tolist()} | mesh
    return graph


def write_scene_graph(path: Path, graph: Any = None) -> Path:
    """The graph, or that of one room, in a file."""
    path.write_text(json.dumps(scene_graph(*box_mesh()) if graph is None else graph))
    return path
