"""The graph of storeys, rooms and areas as GraphML, for networkx, igraph, Gephi, yEd and Neo4j.

Nodes `s0`, `r0`, `a0` are storeys, rooms and areas; `kind` tells which. Edges between rooms are doors, openings, stairs and
ramps; between areas narrowings; and `contains` leads from a storey to its rooms and from a room to its areas.
Source: http://graphml.graphdrawing.org/specification.html (schema 1.1).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as xml

from topomerge.io.exports import replace_forbidden, write_xml
from topomerge.types import TopometricMap, find_room_names

SPACE = "http://graphml.graphdrawing.org/xmlns"
Item = tuple[tuple[str, ...], dict[str, Any]]  # the id of a node or the two of an edge, attributes
GRAPHML_TYPES = {bool: "boolean", int: "long", float: "double", str: "string"}


def save(map: TopometricMap, path: Path) -> None:
    """Write one undirected graph; two doors between the same rooms are two edges.

    Raises:
        InputError: the path can't be written.
    """
    root = xml.Element("graphml", xmlns=SPACE)
    nodes, edges = list(_iter_nodes(map)), list(_iter_edges(map))
    keys = {
        where: {
            name: _get_graphml_type([a[name] for _, a in items if name in a]) for name in sorted({n for _, a in items for n in a})
        }
        for where, items in (("node", nodes), ("edge", edges))
    }
    about = {"source": replace_forbidden(map.source), "voxel_size": float(map.grid.edge), "unit": "m"}
    keys["graph"] = {name: _get_graphml_type([value]) for name, value in about.items()}
    for where, names in keys.items():
        for name, kind in names.items():
            xml.SubElement(root, "key", {"id": f"{where}_{name}", "for": where, "attr.name": name, "attr.type": kind})
    graph = xml.SubElement(root, "graph", id="map", edgedefault="undirected")
    _add_data(graph, "graph", about)
    for (name,), values in nodes:
        _add_data(xml.SubElement(graph, "node", id=name), "node", values)
    for number, (ends, values) in enumerate(edges):
        _add_data(xml.SubElement(graph, "edge", id=f"e{number}", source=ends[0], target=ends[1]), "edge", values)
    write_xml(root, path)


def _get_graphml_type(values: list[Any]) -> str:
    return GRAPHML_TYPES[type(values[0])]


def _add_data(parent: Any, where: str, values: dict[str, Any]) -> None:
    for name, value in values.items():
        text = str(value).lower() if isinstance(value, bool) else repr(value) if isinstance(value, float) else str(value)
        xml.SubElement(parent, "data", key=f"{where}_{name}").text = text


def _read_row(row: Any, *left_out: str) -> dict[str, Any]:
    """Return the columns of a table's row; points as three numbers, what is not known (nan) left out."""
    values: dict[str, Any] = {}
    for name in row.dtype.names:
        value = row[name].tolist()
        if name in left_out:
            continue
        if isinstance(value, list):
            values |= {f"{name}_{axis}": number for axis, number in zip("xyz", value, strict=True)}
        elif not (isinstance(value, float) and math.isnan(value)):
            values[name] = value
    return values


def _rename_position(values: dict[str, Any], name: str) -> dict[str, Any]:
    """Name the point `name_x` … as x, y and z, which programs take as a position."""
    return {key.removeprefix(f"{name}_"): value for key, value in values.items()}


def _iter_nodes(map: TopometricMap) -> Iterator[Item]:
    for i, storey in enumerate(map.storeys):
        yield (f"s{i}",), {"kind": "storey", "label": f"storey {i}", **_read_row(storey)}
    names = find_room_names(map.landmarks, len(map.rooms))
    for i, room in enumerate(map.rooms):
        label = replace_forbidden(names[i]) or f"room {i}"
        yield (f"r{i}",), {"kind": "room", "label": label, **_rename_position(_read_row(room), "centroid")}
    for i, area in enumerate(map.areas):
        yield (f"a{i}",), {"kind": "area", "label": f"area {i}", **_rename_position(_read_row(area), "centroid")}


def _iter_edges(map: TopometricMap) -> Iterator[Item]:
    for table, letter, named in ((map.edges, "r", ""), (map.narrows, "a", "narrow")):
        for edge in table:
            a, b = edge["rooms"].tolist()
            values = _rename_position(_read_row(edge, "rooms", "kind"), "centre")
            yield (f"{letter}{a}", f"{letter}{b}"), {"kind": named or str(edge["kind"]), **values}
    for i, room in enumerate(map.rooms):
        yield (f"s{room['storey']}", f"r{i}"), {"kind": "contains"}
    for i, area in enumerate(map.areas):
        yield (f"r{area['room']}", f"a{i}"), {"kind": "contains"}
