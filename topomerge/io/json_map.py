"""Maps in JSON: of vacuum robots (`valetudo.py`), scene graphs with their mesh or their places. What is in it tells which."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from topomerge.errors import InputError
from topomerge.io import grid, valetudo
from topomerge.io.landmarks import parse_landmarks
from topomerge.io.mesh import sample
from topomerge.io.piece import Piece, ReadOptions, build_damage_error
from topomerge.types import LANDMARK_KINDS, Array, Landmarks

BEYOND_NUMBERS = 2**53  # of a vertex: from here on not every whole number is a float64
GRAPH_KIND = "a scene graph"
OBJECT_LAYER, ROOM_LAYER = 2, 4
UNNAMED_NODE = re.compile(r"[A-Za-z]\(\d+\)|room \d+|")  # of an object or a room that nobody named


def is_scene_graph(about: object) -> bool:
    """Return whether a value is a scene graph saved by Spark-DSG. Old versions have no header."""
    return isinstance(about, dict) and isinstance(about.get("nodes"), list) and isinstance(about.get("edges"), list)


def iter_pieces(path: Path, graph: Mapping[str, Any], options: ReadOptions) -> Iterator[Piece]:
    """Yield the vertices of the mesh with the graph's objects and names, then points sampled on its faces, in metres. Without a
    mesh: the floor that its places have free, and its outline as walls.

    Raises:
        InputError: the graph has neither a mesh nor places, or a damaged one.
    """
    mesh = graph.get("mesh")
    if not isinstance(mesh, dict) or not mesh.get("points"):
        yield from _iter_place_pieces(path, graph, options)
        return
    vertices = _parse_table(path, mesh["points"], "points")
    faces = _parse_table(path, mesh.get("faces") or np.zeros((0, 3)), "faces")
    if not (np.abs(faces) < BEYOND_NUMBERS).all() or (faces != np.round(faces)).any():  # so of nan, too
        raise build_damage_error(path, GRAPH_KIND, "a face of its mesh names a vertex that does not exist")
    colors = _parse_colors(path, mesh, len(vertices))
    yield Piece(vertices, colors, done=0.5, landmarks=find_graph_landmarks(path, graph))
    yield from sample(path, vertices, faces.astype(np.int64), options, colors)


PLACE_LAYER, FEWEST_PLACES = 3, 3
PLACE_CELL, LEAST_CLEAR, WAY = 0.1, 0.2, 0.4  # m: of the plan, around a place at least, and to either side of a way at most
STOREY_GAP = 1.5  # m between the heights of places, from which on they are of two storeys


def _iter_place_pieces(path: Path, graph: Mapping[str, Any], options: ReadOptions) -> Iterator[Piece]:
    """Yield the walls and floor of each storey by its places, which say how far from them the nearest obstacle is."""
    places, edges = _parse_places(graph)
    if len(places) < FEWEST_PLACES or not (places[:, 3] > 0).any():
        raise InputError(
            f"{path}: is a scene graph without a mesh, and without places that tell where its walls are; give "
            "dsg_with_mesh.json, which Hydra saves beside it"
        )
    text = "has no mesh: its floor is what its places have free, and its walls are the outline of that"
    yield Piece(np.empty((0, 3)), warnings=(f"{path}: {text}",), landmarks=find_graph_landmarks(path, graph), done=0.1)
    order = np.argsort(places[:, 2], kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(places[order, 2]) > STOREY_GAP) + 1):
        own = edges[np.isin(edges, rows).all(axis=1)]
        free, low = _draw_places(path, places, rows, own)
        outline = ndimage.binary_dilation(free, np.ones((3, 3))) & ~free
        plan = grid.Plan(path, PLACE_CELL, (low[0], low[1], 0.0))
        for piece in grid.extrude(path, np.flipud(outline), np.flipud(free), plan, options):
            yield replace(piece, points=piece.points + (0.0, 0.0, places[rows, 2].min()))


def _parse_places(graph: Mapping[str, Any]) -> tuple[Array, Array]:
    """Return (n, 4) m places x y z and how far the nearest obstacle is; (m, 2) rows of those that a way joins."""
    rows: dict[Any, list[float]] = {}
    for node in graph["nodes"]:
        try:
            if node["layer"] == PLACE_LAYER and node.get("partition", 0) == 0:
                about = node["attributes"]
                values = [*(float(v) for v in about["position"]), float(about.get("distance") or 0.0)]
                if len(values) == 4 and np.isfinite(values).all() and max(map(abs, values[:3])) < 1e6:
                    rows[node["id"]] = values
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
            continue
    number = {k: n for n, k in enumerate(rows)}
    ends = [(e.get("source"), e.get("target")) for e in graph["edges"] if isinstance(e, dict)]
    joined = [
        (number[a], number[b]) for a, b in ends if isinstance(a, int) and isinstance(b, int) and a in number and b in number
    ]
    return np.array(list(rows.values())).reshape(-1, 4), np.array(joined, np.int64).reshape(-1, 2)


def _draw_places(path: Path, places: Array, rows: Array, links: Array) -> tuple[Array, list[float]]:
    """Return (h, w) bool of what is free around places and along ways, the lowest row first; and the lower left corner, m."""
    clear = places[:, 3].clip(LEAST_CLEAR, 10.0)
    discs = [(places[k, :2], clear[k]) for k in rows.tolist()]
    for a, b in links.tolist():
        start, end = places[a, :2], places[b, :2]
        wide = min(clear[a], clear[b], WAY)
        steps = min(int(np.ceil(np.linalg.norm(end - start) / wide)) + 1, 1000)
        discs += [(start + share * (end - start), wide) for share in np.linspace(0, 1, steps)[1:-1]]
    centres, radii = np.array([c for c, _ in discs]), np.array([r for _, r in discs])
    low = np.floor((centres - radii[:, None]).min(axis=0) / PLACE_CELL - 2) * PLACE_CELL
    width, height = (np.ceil(((centres + radii[:, None]).max(axis=0) - low) / PLACE_CELL) + 3).astype(int).tolist()
    if width * height > grid.PIXELS:
        raise InputError(f"{path}: its places span {width:,} by {height:,} cells, more than {grid.PIXELS:,}; it is damaged")
    free = np.zeros((height, width), bool)
    for centre, radius in zip(centres, radii, strict=True):
        first = np.floor((centre - radius - low) / PLACE_CELL).astype(int)
        last = np.ceil((centre + radius - low) / PLACE_CELL).astype(int) + 1
        x, y = (low[k] + (np.arange(first[k], last[k]) + 0.5) * PLACE_CELL - centre[k] for k in (0, 1))
        free[first[1] : last[1], first[0] : last[0]] |= y[:, None] ** 2 + x**2 <= radius**2
    return free, low.tolist()


def find_graph_landmarks(path: Path, graph: Mapping[str, Any]) -> Landmarks:
    """Find the objects and the names of rooms of a scene graph; its own list tells the classes that numbers stand for. Nodes
    that say nothing of the kind are passed over."""
    rows = [row for node in graph["nodes"] if (row := _read_node(node, graph)) is not None]
    return parse_landmarks(rows, path.name)


def _read_node(node: Any, graph: Mapping[str, Any]) -> dict[str, Any] | None:
    try:
        layer, about = node["layer"], node["attributes"]
        if layer not in (OBJECT_LAYER, ROOM_LAYER) or node.get("partition", 0) != 0:
            return None
        name, kind = str(about.get("name") or ""), "name"
        if UNNAMED_NODE.fullmatch(name):
            classes = graph["metadata"]["labelspaces"][f"_l{layer}p0"]
            name = next(str(label) for number, label in classes if number == about["semantic_label"])
        if layer == OBJECT_LAYER:
            node_kind = (about.get("metadata") or {}).get("kind")
            kind = node_kind if node_kind in LANDMARK_KINDS else "object"
        x, y, z = (float(v) for v in about["position"])
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, StopIteration):
        return None
    return {"kind": kind, "value": name, "position": (x, y, z)}


def _parse_table(path: Path, rows: Any, name: str) -> Array:
    """Return (n, 3) float64."""
    try:
        table = np.array(rows, np.float64)
    except (TypeError, ValueError) as error:
        raise build_damage_error(path, GRAPH_KIND, f"{name} of its mesh are no rows of three numbers") from error
    if table.ndim != 2 or table.shape[1] != 3:
        raise build_damage_error(path, GRAPH_KIND, f"{name} of its mesh are no rows of three numbers")
    return table


def _parse_colors(path: Path, mesh: Mapping[str, Any], many: int) -> Array | None:
    """Return (many, 3) uint8; None where the mesh has none."""
    listed = mesh.get("colors")
    if not listed or not mesh.get("has_colors", True):
        return None
    try:
        table = np.array([[c["r"], c["g"], c["b"]] for c in listed], np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise build_damage_error(path, GRAPH_KIND, "colors of its mesh are none") from error
    if table.shape != (many, 3):
        raise build_damage_error(path, GRAPH_KIND, f"its mesh has {many:,} points and {len(table):,} colors")
    return np.nan_to_num(table).clip(0, 255).astype(np.uint8)


LARGEST_MAP_JSON = 1 << 28  # bytes: the mesh of a floor of 3,000 m2 in faces of 10 cm


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read a map in JSON by the reader of its kind, in metres.

    Raises:
        InputError: it is no JSON, or of neither kind.
    """
    about = load_json_map(path)
    if valetudo.is_robot_map(about):
        yield from valetudo.iter_pieces(path, about, options)
    elif is_scene_graph(about):
        yield from iter_pieces(path, about, options)
    else:
        kinds = "a map of Valetudo nor a scene graph of Spark-DSG"
        raise InputError(f"{path}: is neither {kinds}, the JSON that can be read; give the scan or the map that it tells of")


def load_json_map(path: Path) -> Any:
    """Load the value of a file of JSON.

    Raises:
        InputError: it is none, or too large.
    """
    if path.stat().st_size > LARGEST_MAP_JSON:
        most = f"more than {LARGEST_MAP_JSON >> 20} MB, too many for a map in JSON"
        raise InputError(f"{path}: has {most}; give the scan that it was made of")
    try:
        return json.loads(path.read_bytes())
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise build_damage_error(path, "a map in JSON", error) from error
