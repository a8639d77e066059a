"""IndoorGML 1.0.3, core module: rooms and walls as cells, doors as boundaries, and the graph of how one walks between rooms.

Rooms end at the faces of their walls, and walls are cells without a State (the standard's thick walls); a door leaves a gap in
them, under its lintel.

Each room is a CellSpace, whose solid is its floor drawn up to its ceiling, and a State; each door or opening a CellSpaceBoundary
and a Transition; each flight of stairs or ramp a Transition. A window is a CellSpaceBoundary without one, as nobody walks
through; it leaves no gap in its wall. Landmarks are the States of a layer of their own, as the standard has it for sensors and
tags: `gml:name` is the value, the description says the kind and the room. Source: OGC 19-011r4 and its schema indoorgmlcore.xsd.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as xml

import numpy as np
import shapely

from topomerge.io.exports import replace_forbidden, write_xml
from topomerge.io.landmarks import serialise_landmarks
from topomerge.structure.floors import compute_jambs, find_inside_point, is_flight, measure_room_levels
from topomerge.structure.plan_structure import PlanStructure, build_plan_structure
from topomerge.structure.walls import build_wall_polygon
from topomerge.types import ROOM_ODDS, Array, TopometricMap, find_room_names

CORE, GML = "http://www.opengis.net/indoorgml/1.0/core", "http://www.opengis.net/gml/3.2"
LINK, SCHEMA = "http://www.w3.org/1999/xlink", "http://www.w3.org/2001/XMLSchema-instance"
XSD = "http://schemas.opengis.net/indoorgml/1.0/indoorgmlcore.xsd"
LEAST_BODY = 0.005  # m2 from above: smaller pieces of walls are left out
BODY_GRID = 1e-4  # m, of corners, as they are written
THROUGH = 0.05  # m by which a gap is deeper than its wall
UNSEEN_LINTEL = 2.0  # m: of a door over which nothing was seen


def save(map: TopometricMap, path: Path) -> None:
    """Write one document, in metres in the input's frame.

    A room in several pieces has the solid of the largest, because a solid is of one piece.

    Raises:
        InputError: the path can't be written.
    """
    for prefix, space in (("core", CORE), ("gml", GML), ("xlink", LINK), ("xsi", SCHEMA)):
        xml.register_namespace(prefix, space)
    structure, (levels, _) = build_plan_structure(map), measure_room_levels(map)
    floors = structure.rooms
    root = xml.Element(
        _qualify_core("IndoorFeatures"), {_qualify_gml("id"): "topomerge", f"{{{SCHEMA}}}schemaLocation": f"{CORE} {XSD}"}
    )
    _add_description(root, map.source or "map")
    _add_bounds(root, map)
    place = _add_element(_add_element(root, "primalSpaceFeatures"), "PrimalSpaceFeatures", "PS")
    names = _list_room_names(map)
    for r, floor in enumerate(floors):
        _add_cell(_add_element(place, "cellSpaceMember"), map, names[r], r, floor, levels[r])
    for k, bodies in enumerate(_build_wall_bodies(structure)):
        for n, body in enumerate(bodies):
            _add_wall(_add_element(place, "cellSpaceMember"), f"W{k}-{n}", structure.walls[k], *body)
    for i, edge in enumerate(map.edges):
        if not is_flight(edge):
            _add_boundary(_add_element(place, "cellSpaceBoundaryMember"), i, edge)
    for k, pane in enumerate(structure.windows):
        _add_window(_add_element(place, "cellSpaceBoundaryMember"), k, map.windows[k], pane)
    if len(map.rooms):  # a layer without states is none
        places = zip(floors, map.rooms["centroid"], levels[:, 0], strict=True)
        points = [np.append(find_inside_point(floor, middle), low) for floor, middle, low in places]
        _add_graph(root, map, points)
    write_xml(root, path)


def _qualify_core(name: str) -> str:
    return f"{{{CORE}}}{name}"


def _qualify_gml(name: str) -> str:
    return f"{{{GML}}}{name}"


def _add_element(parent: Any, name: str, id: str = "", space: str = CORE) -> Any:
    return xml.SubElement(parent, f"{{{space}}}{name}", {_qualify_gml("id"): id} if id else {})


def _add_link(parent: Any, name: str, id: str) -> None:
    xml.SubElement(parent, _qualify_core(name), {f"{{{LINK}}}href": f"#{id}"})


def _add_description(parent: Any, name: str, **fields: Any) -> None:
    """Add description and name. Viewers read the first as key="value" pairs."""
    if fields:
        _add_element(parent, "description", space=GML).text = ":".join(f'{key}="{value}"' for key, value in fields.items())
    _add_element(parent, "name", space=GML).text = replace_forbidden(name)


def _add_bounds(root: Any, map: TopometricMap) -> None:
    if len(map.rooms):
        envelope = _add_element(_add_element(root, "boundedBy", space=GML), "Envelope", space=GML)
        envelope.set("srsDimension", "3")
        for name, corner in (("lowerCorner", map.rooms["lo"].min(axis=0)), ("upperCorner", map.rooms["hi"].max(axis=0))):
            _add_element(envelope, name, space=GML).text = _format_point(corner)


def _format_point(point: Any) -> str:
    return " ".join(f"{value:.4f}" for value in np.asarray(point).tolist())


def _list_room_names(map: TopometricMap) -> list[str]:
    return [name or f"room {r}" for r, name in enumerate(find_room_names(map.landmarks, len(map.rooms)))]


def _add_cell(member: Any, map: TopometricMap, name: str, r: int, floor: shapely.MultiPolygon, level: Array) -> None:
    room = map.rooms[r]
    cell = _add_element(member, "CellSpace", f"C{r}")
    properties = {"storey": int(room["storey"]), "area": f"{room['area']:.2f}", "height": f"{room['height']:.2f}"}
    _add_description(cell, name, **properties, **{odds: f"{room[odds]:.2f}" for odds in ROOM_ODDS})
    if not floor.is_empty:
        _add_solid(cell, f"C{r}", max(floor.geoms, key=lambda part: part.area), *level.tolist())
    _add_link(cell, "duality", f"S{r}")
    for i in np.flatnonzero((map.edges["rooms"] == r).any(axis=1)):
        if not is_flight(map.edges[i]):
            _add_link(cell, "partialboundedBy", f"B{i}")
    for k in np.flatnonzero((map.windows["rooms"] == r).any(axis=1)):
        _add_link(cell, "partialboundedBy", f"P{k}")


def _add_solid(cell: Any, id: str, plan: shapely.Polygon, low: float, high: float) -> None:
    shape = _add_element(_add_element(cell, "cellSpaceGeometry"), "Geometry3D")
    shell = _add_element(
        _add_element(_add_element(shape, "Solid", f"{id}-solid", GML), "exterior", space=GML), "Shell", space=GML
    )
    for k, faces in enumerate(_iter_faces(plan, low, high)):
        _add_polygon(_add_element(shell, "surfaceMember", space=GML), f"{id}-face{k}", faces)


def _add_wall(member: Any, id: str, wall: Any, plan: shapely.Polygon, low: float, high: float) -> None:
    cell = _add_element(member, "CellSpace", id)
    rooms = " ".join(str(r) for r in wall["rooms"].tolist() if r >= 0)
    properties = {"kind": "wall", "storey": int(wall["storey"]), "rooms": rooms, "thickness": f"{wall['thickness']:.2f}"}
    _add_description(cell, f"wall {id[1:]}", **properties, measured=str(int(wall["faces"]) == 2).lower())
    _add_solid(cell, id, plan, low, high)


def _build_wall_bodies(structure: PlanStructure) -> list[list[tuple[shapely.Polygon, float, float]]]:
    """Build of each wall its prisms: plan, foot and top, m. No two of a storey cover each other, and none a room."""
    bodies = []
    tree, rooms = (
        shapely.STRtree(shapes := [build_wall_polygon(wall) for wall in structure.walls]),
        shapely.STRtree(structure.rooms),
    )
    for k, (wall, shape) in enumerate(zip(structure.walls, shapes, strict=True)):
        before = [j for j in tree.query(shape) if j < k and structure.walls["storey"][j] == wall["storey"]]
        levels = structure.storey_of_rooms[(near := rooms.query(shape))]
        covered = [*(shapes[j] for j in before), *(structure.rooms[r] for r in near[levels == wall["storey"]])]
        rest = shapely.difference(shape, shapely.union_all(covered))
        own = structure.openings[structure.openings["wall"] == k]
        gaps = [build_wall_polygon(wall, opening, THROUGH) for opening in own]
        parts = [(rest.difference(shapely.union_all(gaps)), float(wall["low"]))]
        lintels = [float(opening["centre"][2]) + (float(opening["height"]) or UNSEEN_LINTEL) for opening in own]
        parts += [(rest.intersection(gap), lintel) for gap, lintel in zip(gaps, lintels, strict=True)]
        high = float(wall["high"])
        bodies.append([(p, low, high) for part, low in parts if low < high for p in _split_polygons(part)])
    return bodies


def _split_polygons(shape: Any) -> list[shapely.Polygon]:
    parts = shapely.get_parts(shapely.set_precision(shape, BODY_GRID))
    return [shapely.geometry.polygon.orient(p) for p in parts if p.geom_type == "Polygon" and p.area > LEAST_BODY]


def _iter_faces(floor: shapely.Polygon, low: float, high: float) -> Iterator[list[Array]]:
    """Yield the faces of a prism, each a list of closed rings (k, 3), seen counter-clockwise from outside."""
    rings = [np.asarray(ring.coords)[:, :2] for ring in (floor.exterior, *floor.interiors)]  # the inner ones run clockwise
    yield [_lift_ring(ring[::-1], low) for ring in rings]
    yield [_lift_ring(ring, high) for ring in rings]
    for ring in rings:
        for a, b in pairwise(ring):
            yield [np.array([(*a, low), (*b, low), (*b, high), (*a, high), (*a, low)])]


def _lift_ring(ring: Array, z: float) -> Array:
    return np.column_stack([ring, np.full(len(ring), z)])


def _add_polygon(parent: Any, id: str, rings: list[Array]) -> None:
    polygon = _add_element(parent, "Polygon", id, GML)
    for k, ring in enumerate(rings):
        line = _add_element(_add_element(polygon, "interior" if k else "exterior", space=GML), "LinearRing", space=GML)
        for point in ring:
            _add_element(line, "pos", space=GML).text = _format_point(point)


def _add_boundary(member: Any, i: int, edge: Any) -> None:
    boundary = _add_element(member, "CellSpaceBoundary", f"B{i}")
    kind = str(edge["kind"])
    properties = {"kind": kind, "width": f"{edge['width']:.2f}", **{k: str(bool(edge[k])).lower() for k in ("open", "half")}}
    _add_description(boundary, f"{kind} {i}", **properties, confidence=f"{edge['confidence']:.2f}")
    _add_link(boundary, "duality", f"T{i}")
    a, b = compute_jambs(edge)
    up = np.array([0.0, 0.0, float(edge["height"]) or UNSEEN_LINTEL])
    shape = _add_element(_add_element(boundary, "cellSpaceBoundaryGeometry"), "geometry3D")
    _add_polygon(shape, f"B{i}-face", [np.array([a, b, b + up, a + up, a])])


def _add_window(member: Any, k: int, window: Any, pane: Any) -> None:
    boundary = _add_element(member, "CellSpaceBoundary", f"P{k}")
    properties = {name: f"{window[name]:.2f}" for name in ("width", "sill", "head", "confidence") if np.isfinite(window[name])}
    _add_description(boundary, f"window {k}", kind="window", **properties)
    a, b = compute_jambs(pane) + (0, 0, pane["sill"])
    up = np.array([0.0, 0.0, float(pane["head"] - pane["sill"])])
    shape = _add_element(_add_element(boundary, "cellSpaceBoundaryGeometry"), "geometry3D")
    _add_polygon(shape, f"P{k}-face", [np.array([a, b, b + up, a + up, a])])


def _add_graph(root: Any, map: TopometricMap, points: list[Array]) -> None:
    graph = _add_element(_add_element(root, "multiLayeredGraph"), "MultiLayeredGraph", "MG")
    layers = _add_element(graph, "spaceLayers", "SL")
    layer = _add_element(_add_element(layers, "spaceLayerMember"), "SpaceLayer", "L0")
    _add_description(layer, "rooms")
    nodes, names = _add_element(layer, "nodes", "N"), _list_room_names(map)
    for r, point in enumerate(points):
        state = _add_element(_add_element(nodes, "stateMember"), "State", f"S{r}")
        _add_description(state, names[r])
        _add_link(state, "duality", f"C{r}")
        for t in np.flatnonzero((map.edges["rooms"] == r).any(axis=1)):
            _add_link(state, "connects", f"T{t}")
        _add_element(
            _add_element(_add_element(state, "geometry"), "Point", f"S{r}-point", GML), "pos", space=GML
        ).text = _format_point(point)
    if len(map.edges):
        edges = _add_element(layer, "edges", "E")
        for i, edge in enumerate(map.edges):
            _add_transition(_add_element(edges, "transitionMember"), i, edge, points)
    _add_landmarks(layers, map)


def _add_landmarks(layers: Any, map: TopometricMap) -> None:
    """Add the layer of landmarks; a layer without states is none."""
    rows = serialise_landmarks(map.landmarks.select(~map.landmarks.is_kind("radio", "pressure")))
    if not rows:
        return
    layer = _add_element(_add_element(layers, "spaceLayerMember"), "SpaceLayer", "L1")
    _add_description(layer, "landmarks")
    nodes = _add_element(layer, "nodes", "N1")
    for k, row in enumerate(rows):
        state = _add_element(_add_element(nodes, "stateMember"), "State", f"M{k}")
        name, position = row.pop("value"), row.pop("position")
        row["source"] = str(row["source"]).replace('"', "'")
        _add_description(state, name, **{key: replace_forbidden(str(fact)) for key, fact in row.items() if fact is not None})
        if position is not None:
            point = _add_element(_add_element(state, "geometry"), "Point", f"M{k}-point", GML)
            _add_element(point, "pos", space=GML).text = _format_point(position)


def _add_transition(member: Any, i: int, edge: Any, points: list[Array]) -> None:
    """Add the way from room to room through the middle of a door or along a flight; its weight is its length, m."""
    a, b = edge["rooms"].tolist()
    flight = [edge["lower"], edge["upper"]] if points[a][2] <= points[b][2] else [edge["upper"], edge["lower"]]
    way = np.array([points[a], *(flight if is_flight(edge) else [edge["centre"]]), points[b]])
    transition = _add_element(member, "Transition", f"T{i}")
    _add_description(transition, f"{edge['kind']} {i}", confidence=f"{edge['confidence']:.2f}")
    _add_element(transition, "weight").text = f"{np.linalg.norm(np.diff(way, axis=0), axis=1).sum():.4f}"
    for r in (a, b):
        _add_link(transition, "connects", f"S{r}")
    if not is_flight(edge):
        _add_link(transition, "duality", f"B{i}")
    line = _add_element(_add_element(transition, "geometry"), "LineString", f"T{i}-line", GML)
    for point in way:
        _add_element(line, "pos", space=GML).text = _format_point(point)
