"""Is a document IndoorGML 1.0.3 core? The parts of indoorgmlcore.xsd and of GML 3.2.1 that it uses, as a table.

For each element its children in their order, with how often they may stand there. The files can't be fetched where tests run.
"""

from __future__ import annotations

import re
from itertools import pairwise
from typing import Any

import numpy as np

CORE, GML, LINK = (
    "{http://www.opengis.net/indoorgml/1.0/core}",
    "{http://www.opengis.net/gml/3.2}",
    "{http://www.w3.org/1999/xlink}",
)
FEATURE_HEAD = "gml:description? gml:name* gml:boundedBy? "  # AbstractFeatureType
ORDER = {
    "core:IndoorFeatures": FEATURE_HEAD + "core:primalSpaceFeatures? core:multiLayeredGraph?",
    "core:primalSpaceFeatures": "core:PrimalSpaceFeatures",
    "core:PrimalSpaceFeatures": FEATURE_HEAD + "core:cellSpaceMember* core:cellSpaceBoundaryMember*",
    "core:cellSpaceMember": "core:CellSpace",
    "core:CellSpace": FEATURE_HEAD + "core:cellSpaceGeometry? core:duality? core:externalReference* core:partialboundedBy*",
    "core:cellSpaceGeometry": "core:Geometry3D",
    "core:Geometry3D": "gml:Solid",
    "core:cellSpaceBoundaryMember": "core:CellSpaceBoundary",
    "core:CellSpaceBoundary": FEATURE_HEAD + "core:duality? core:cellSpaceBoundaryGeometry? core:externalReference*",
    "core:cellSpaceBoundaryGeometry": "core:geometry3D",
    "core:geometry3D": "gml:Polygon",
    "core:multiLayeredGraph": "core:MultiLayeredGraph",
    "core:MultiLayeredGraph": FEATURE_HEAD + "core:spaceLayers+ core:interEdges*",
    "core:spaceLayers": FEATURE_HEAD + "core:spaceLayerMember+",
    "core:spaceLayerMember": "core:SpaceLayer",
    "core:SpaceLayer": FEATURE_HEAD
    + "core:usage* core:terminationDate? core:function* core:creationDate? core:class? core:nodes+ core:edges*",
    "core:nodes": FEATURE_HEAD + "core:stateMember+",
    "core:stateMember": "core:State",
    "core:State": FEATURE_HEAD + "core:duality? core:connects* core:geometry?",
    "core:edges": FEATURE_HEAD + "core:transitionMember+",
    "core:transitionMember": "core:Transition",
    "core:Transition": FEATURE_HEAD + "core:weight? core:connects core:connects core:duality? core:geometry?",
    "core:geometry": "(gml:Point|gml:LineString)",
    "core:duality": "",
    "core:connects": "",
    "core:partialboundedBy": "",
    "core:weight": "",
    "gml:description": "",
    "gml:name": "",
    "gml:boundedBy": "gml:Envelope",
    "gml:Envelope": "gml:lowerCorner gml:upperCorner",
    "gml:lowerCorner": "",
    "gml:upperCorner": "",
    "gml:Solid": "gml:exterior gml:interior*",
    "gml:Shell": "gml:surfaceMember+",
    "gml:surfaceMember": "gml:Polygon",
    "gml:Polygon": "gml:exterior gml:interior*",
    "gml:exterior": "(gml:Shell|gml:LinearRing)",
    "gml:interior": "(gml:Shell|gml:LinearRing)",
    "gml:LinearRing": "gml:pos gml:pos gml:pos gml:pos+",
    "gml:Point": "gml:pos",
    "gml:LineString": "gml:pos gml:pos+",
    "gml:pos": "",
}
# gml:id is required
NAMED = {
    "IndoorFeatures",
    "PrimalSpaceFeatures",
    "CellSpace",
    "CellSpaceBoundary",
    "MultiLayeredGraph",
    "spaceLayers",
    "SpaceLayer",
}
NAMED |= {"nodes", "edges", "State", "Transition", "Solid", "Polygon", "Point", "LineString"}
LINKS = {  # what a link of an element may point to
    ("CellSpace", "duality"): "State",
    ("CellSpace", "partialboundedBy"): "CellSpaceBoundary",
    ("CellSpaceBoundary", "duality"): "Transition",
    ("State", "duality"): "CellSpace",
    ("State", "connects"): "Transition",
    ("Transition", "connects"): "State",
    ("Transition", "duality"): "CellSpaceBoundary",
}


def short(tag: str) -> str:
    """`core:State` for the full name of an element."""
    for prefix, space in (("core:", CORE), ("gml:", GML)):
        if tag.startswith(space):
            return prefix + tag.removeprefix(space)
    raise AssertionError(f"{tag}: a namespace that IndoorGML core does not use")


def check(root: Any) -> None:
    """Fail where the document breaks the schema: order and number of children, ids, links, geometry."""
    assert short(root.tag) == "core:IndoorFeatures"
    kind_of_id: dict[str, str] = {}
    for element in root.iter():
        name = short(element.tag)
        assert name in ORDER, f"{name} is no element of the core"
        pattern = "".join(f"(?:{part.rstrip('?*+')} ){part[-1] if part[-1] in '?*+' else ''}" for part in ORDER[name].split())
        children = "".join(short(child.tag) + " " for child in element)
        assert re.fullmatch(pattern, children), f"{name} holds {children}"
        id = element.get(GML + "id")
        assert (id is not None) == (name.split(":")[1] in NAMED), f"{name}: id {id}"
        if id is not None:
            assert re.fullmatch(r"[A-Za-z_][\w.-]*", id) and id not in kind_of_id, f"id {id}"
            kind_of_id[id] = name.split(":")[1]
    _check_links(root, kind_of_id)
    for ring in root.iter(GML + "LinearRing"):
        points = positions(ring)
        assert (points[0] == points[-1]).all() and points.shape[1] == 3, "a ring must close"


def _check_links(root: Any, kind_of_id: dict[str, str]) -> None:
    for element in root.iter():
        for child in element:
            link = child.get(LINK + "href")
            kind = LINKS.get((short(element.tag).split(":")[1], short(child.tag).split(":")[1]))
            assert (link is None) == (kind is None), f"{element.tag} {child.tag} {link}"
            if link is not None:
                assert link.startswith("#") and kind_of_id.get(link[1:]) == kind, f"{link} is no {kind}"


def positions(element: Any) -> np.ndarray:
    """(n, 3) the points of a ring or line."""
    return np.array([[float(v) for v in pos.text.split()] for pos in element.iter(GML + "pos")])


def volume(solid: Any) -> float:
    """m3 in a solid whose faces are seen counter-clockwise from outside (Gauss); negative where they are turned inwards."""
    total = 0.0
    for ring in solid.iter(GML + "LinearRing"):
        p = positions(ring)[:-1]
        total += sum(float(np.dot(p[0], np.cross(p[i], p[i + 1]))) for i in range(1, len(p) - 1)) / 6
    return total


def is_closed(solid: Any) -> bool:
    """Is each edge of a solid's faces met by another one in the other direction?"""
    edges: dict[tuple, int] = {}
    for ring in solid.iter(GML + "LinearRing"):
        p = [tuple(point) for point in positions(ring).tolist()]
        for a, b in pairwise(p):
            edges[(a, b)] = edges.get((a, b), 0) + 1
    return all(edges.get((b, a), 0) == n for (a, b), n in edges.items())
