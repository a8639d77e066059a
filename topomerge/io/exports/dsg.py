"""A 3D scene graph as JSON of Spark-DSG, which Hydra and its tools read: buildings, rooms and places.

The layers of that library are 2 objects, 3 places, 4 rooms, 5 buildings. Objects, signs and tags are objects (`kind` in their
metadata) of the place that is nearest in their room. There is one building; the storey of a room stands in its metadata.
Places are the areas of rooms (`p0`, …) and the doors, stairs and so on between them; they are joined as one can walk. Written as
spark-dsg 1.1.3 writes: https://github.com/MIT-SPARK/Spark-DSG.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from topomerge.archive import replace_on_success
from topomerge.io.rooms_ply import assign_room_colours
from topomerge.structure.floors import build_floor_polygons, find_inside_point
from topomerge.types import LANDMARK_KINDS, ROOM_ODDS, Array, TopometricMap, find_room_names

VERSION = {"major": 1, "minor": 1, "patch": 3}
OBJECT_LAYER, PLACE_LAYER, ROOM_LAYER, BUILDING_LAYER = 2, 3, 4, 5
LAYERS = {
    "AGENTS": OBJECT_LAYER,
    "OBJECTS": OBJECT_LAYER,
    "PLACES": PLACE_LAYER,
    "ROOMS": ROOM_LAYER,
    "BUILDINGS": BUILDING_LAYER,
}
NO_LABEL = 2**32 - 1
NO_ROTATION = {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
GREY = (128, 128, 128)
ROOM_METADATA = ("storey", "area", "height", "volume", "completeness", "glimpsed", *ROOM_ODDS)  # columns of ROOM_DTYPE
Json = dict[str, Any]


def save(map: TopometricMap, path: Path) -> None:
    """Write a scene graph that `spark_dsg.DynamicSceneGraph.load` reads; the name of the file should end in .json.

    Raises:
        InputError: the path can't be written.
    """
    nodes, edges = [*_iter_building_nodes(map), *_iter_room_nodes(map)], list(_iter_room_edges(map))
    for node, its_edges in _iter_places(map):
        nodes.append(node)
        edges += its_edges
    for node, its_edges in _iter_objects(map):
        nodes.append(node)
        edges += its_edges
    graph = {
        "SPARK_DSG_header": {"project_name": "main", "version": VERSION},
        "directed": False,
        "multigraph": False,
        "layer_keys": [{"layer": k, "partition": 0} for k in (2, PLACE_LAYER, ROOM_LAYER, BUILDING_LAYER)],
        "layer_names": {name: {"layer": k, "partition": 0} for name, k in LAYERS.items()},
        "metadata": {"source": map.source, "voxel_size": float(map.grid.edge), "unit": "m", "written_by": "topomerge"},
        "nodes": nodes,
        "edges": edges,
    }
    with replace_on_success(path) as temporary:
        temporary.write_text(json.dumps(graph, allow_nan=False, indent=1), encoding="utf-8")


def encode_symbol(letter: str, number: int) -> int:
    """Encode the id of a node: its letter in the highest of eight bytes."""
    return (ord(letter) << 56) | number


def _build_node(layer: int, id: int, kind: str, name: str, at: Array, colour: Any = GREY, **more: Any) -> Json:
    attributes = {
        "type": kind,
        "position": np.asarray(at, np.float64).tolist(),
        "last_update_time_ns": 0,
        "is_active": False,
        "is_predicted": False,
        "metadata": {},
        "name": name,
        "color": dict(zip("rgba", (*(int(c) for c in colour), 255), strict=True)),
        "semantic_label": NO_LABEL,
        "semantic_feature": {"rows": 0, "cols": 0, "data": None},
        "bounding_box": _build_box(),
        **more,
    }
    return {"id": id, "layer": layer, "partition": 0, "attributes": attributes}


def _build_box(low: Any = None, high: Any = None) -> Json:
    none = low is None
    middle, size = (np.zeros(3), np.zeros(3)) if none else ((low + high) / 2, high - low)
    place = {"world_P_center": middle.tolist(), "world_R_center": NO_ROTATION}
    return {"type": "INVALID" if none else "AABB", "dimensions": size.tolist(), **place}


def _build_edge(a: int, b: int, metadata: Json | None = None, weight: float | None = None) -> Json:
    weighting = {"weighted": weight is not None, "weight": 1.0 if weight is None else float(weight)}
    return {"source": a, "target": b, "info": {"type": "EdgeAttributes", "metadata": metadata or {}, **weighting}}


def _iter_building_nodes(map: TopometricMap) -> Iterator[Json]:
    if len(map.rooms):
        low, high = map.rooms["lo"].min(axis=0), map.rooms["hi"].max(axis=0)
        box = _build_box(low, high)
        yield _build_node(
            BUILDING_LAYER, encode_symbol("B", 0), "SemanticNodeAttributes", "building", (low + high) / 2, bounding_box=box
        )


def _iter_room_nodes(map: TopometricMap) -> Iterator[Json]:
    names = find_room_names(map.landmarks, len(map.rooms))
    for r, (room, colour) in enumerate(zip(map.rooms, assign_room_colours(map), strict=True)):
        properties = {name: room[name].tolist() for name in ROOM_METADATA}
        more = {"metadata": properties, "bounding_box": _build_box(room["lo"], room["hi"]), "semantic_class_probabilities": {}}
        name = names[r] or f"room {r}"
        yield _build_node(ROOM_LAYER, encode_symbol("R", r), "RoomNodeAttributes", name, room["centroid"], colour, **more)


def _iter_room_edges(map: TopometricMap) -> Iterator[Json]:
    """Yield the edges from rooms to their building, and to each other."""
    for r in range(len(map.rooms)):
        yield _build_edge(encode_symbol("B", 0), encode_symbol("R", r))
    for (a, b), connections in _group_edges_by_pair(map.edges).items():
        yield _build_edge(encode_symbol("R", a), encode_symbol("R", b), _describe_edges(connections))


def _group_edges_by_pair(table: Array) -> dict[tuple[int, int], list[Any]]:
    """Group the rows of an edge table by the pair that they join, in order: the library refuses a second edge of a pair."""
    connections: dict[tuple[int, int], list[Any]] = {}
    for way in table:
        a, b = sorted(way["rooms"].tolist())
        if a != b:
            connections.setdefault((a, b), []).append(way)
    return dict(sorted(connections.items()))


def _describe_edges(edges: list[Any], kind: str = "") -> Json:
    """Describe the kind and width (m) of the widest way, then each way with its centre (m); a given kind stands for that of
    all."""
    listed = [{"kind": kind or str(w["kind"]), "width": float(w["width"]), "centre": w["centre"].tolist()} for w in edges]
    widest = max(listed, key=lambda way: way["width"])
    return {"kind": widest["kind"], "width": widest["width"], "ways": listed}


def _iter_places(map: TopometricMap) -> Iterator[tuple[Json, list[Json]]]:
    """Yield each place with the edges that lead to it: areas first, then the ways between rooms."""
    colours, floors = assign_room_colours(map), build_floor_polygons(map)
    owner, centres = _compute_area_centres(map, floors)
    narrows: dict[int, list[Json]] = {}
    for (a, b), connections in _group_edges_by_pair(map.narrows).items():
        far = float(np.linalg.norm(centres[a] - centres[b]))
        narrows.setdefault(b, []).append(
            _build_edge(encode_symbol("p", a), encode_symbol("p", b), _describe_edges(connections, "narrow"), far)
        )
    for i, (r, at) in enumerate(zip(owner.tolist(), centres, strict=True)):
        clear = 0.0 if floors[r].is_empty else floors[r].boundary.distance(shapely.Point(at[:2]))
        place = _build_place(i, f"area {i}", at, clear, colours[r], {"room": r, "storey": int(map.rooms["storey"][r])})
        yield place, [_build_edge(encode_symbol("R", r), encode_symbol("p", i)), *narrows.get(i, [])]
    for number, way in enumerate(map.edges, start=len(owner)):
        ends, kind = way["rooms"].tolist(), str(way["kind"])
        metadata = {"kind": kind, "open": bool(way["open"]), "half": bool(way["half"]), "confidence": float(way["confidence"])}
        place = _build_place(number, kind, way["centre"], way["width"] / 2, GREY, {**metadata, "rooms": ends})
        edges = [_build_edge(encode_symbol("R", ends[0]), encode_symbol("p", number))]  # a node has one parent
        for r in dict.fromkeys(ends):
            areas_of_room = np.flatnonzero(owner == r)
            apart = np.linalg.norm(centres[areas_of_room] - way["centre"], axis=1)
            near = int(areas_of_room[apart.argmin()])
            edges.append(_build_edge(encode_symbol("p", near), encode_symbol("p", number), metadata, float(apart.min())))
        yield place, edges


def _iter_objects(map: TopometricMap) -> Iterator[tuple[Json, list[Json]]]:
    """Yield each object, sign and tag whose place is known, with the edge to its parent."""
    table = map.landmarks.table
    known = np.isfinite(table["position"]).all(axis=1) & map.landmarks.is_kind("object", "text", "tag")
    owner, centres = _compute_area_centres(map, build_floor_polygons(map)) if known.any() else (np.zeros(0), np.zeros((0, 3)))
    for number, row in enumerate(table[known]):
        about = {"kind": LANDMARK_KINDS[row["kind"]], "confidence": float(row["confidence"])}
        shape = {"mesh_connections": [], "registered": False, "world_R_object": NO_ROTATION, "metadata": about}
        name, id = map.landmarks.values[row["value"]], encode_symbol("O", number)
        own = np.flatnonzero(owner == row["room"])
        edges = []
        if len(own):
            near = int(own[np.linalg.norm(centres[own] - row["position"], axis=1).argmin()])
            edges.append(_build_edge(encode_symbol("p", near), id))
        yield _build_node(OBJECT_LAYER, id, "ObjectNodeAttributes", name, row["position"], **shape), edges


def _compute_area_centres(map: TopometricMap, floors: list[Any]) -> tuple[Array, Array]:
    """Return (A,) room and (A, 3) a point well inside of each area; a room without areas counts as one."""
    bare = np.setdiff1d(np.arange(len(map.rooms)), map.areas["room"])
    owner = np.concatenate([map.areas["room"], bare]).astype(np.int64)
    centres = np.concatenate([map.areas["centroid"], map.rooms["centroid"][bare]])
    for i, r in enumerate(owner):
        centres[i, :2] = find_inside_point(floors[r], centres[i])
    return owner, centres


def _build_place(number: int, name: str, at: Any, clear: float, colour: Any, metadata: Json) -> Json:
    more = {
        "distance": float(clear),
        "num_basis_points": 0,
        "real_place": True,
        "need_cleanup": False,
        "active_frontier": False,
        "anti_frontier": False,
        "num_frontier_voxels": 0,
        "frontier_scale": [0.0, 0.0, 0.0],
        "orientation": NO_ROTATION,
        "pcl_mesh_connections": [],
        "voxblox_mesh_connections": [],
        "deformation_connections": [],
        "mesh_vertex_labels": [],
        "metadata": metadata,
    }
    return _build_node(PLACE_LAYER, encode_symbol("p", number), "PlaceNodeAttributes", name, at, colour, **more)
