"""Scene graphs of maps of real buildings hold to what Spark-DSG asks of one, and the library itself loads them."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from topomerge.datasets.real import carmen

from tests.io.test_export_plans import write
from tests.real_models import duplex_map
from topomerge.extraction.extract import extract
from topomerge.io import read_points
from topomerge.types import TopometricMap

pytestmark = pytest.mark.data
IPA = "grids_ipa_room_segmentation"
MAPS: dict[str, Callable[[Path], TopometricMap]] = {
    "robot grid of an office floor (GDC)": lambda data: extract(read_points(data / "utexas_gdc_floors/maps/real/1n/1n.yaml")),
    "robot grid (Freiburg 101)": lambda data: extract(read_points(data / IPA / "Freiburg101_scan.png", resolution=0.05)),
    "furnished grid (IPA)": lambda data: extract(read_points(data / IPA / "lab_ipa_furnitures.png", resolution=0.05)),
    "building model (duplex)": duplex_map,
    "laser log (CARMEN)": lambda data: extract(dict(carmen.iter_pairs(data / "carmen_logs"))["freiburg-101-first-last"]().a),
}


QUICK = "robot grid (Freiburg 101)"


@pytest.mark.parametrize("name", [QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in MAPS if name != QUICK)])
@pytest.mark.longer
def test_dsg_of_a_real_building(data_dir: Path, tmp_path: Path, name: str) -> None:
    map = MAPS[name](data_dir)
    assert len(map.rooms) > 2 and len(map.edges) > 1
    path = write(map, "dsg", tmp_path / "a.json")
    graph = json.loads(path.read_text())
    require_scene_graph(graph)
    pairs = {tuple(sorted(pair)) for pair in map.edges["rooms"].tolist() if pair[0] != pair[1]}
    layer = {node["id"]: node["layer"] for node in graph["nodes"]}
    of_rooms = [e for e in graph["edges"] if layer[e["source"]] == layer[e["target"]] == 4]
    assert len(of_rooms) == len(pairs)
    ways = sum(len(e["info"]["metadata"]["ways"]) for e in of_rooms)
    assert ways == sum(a != b for a, b in map.edges["rooms"].tolist()), "every door is in the edge of its pair"
    dsg = pytest.importorskip("spark_dsg")
    loaded = dsg.DynamicSceneGraph.load(str(path))
    assert loaded.num_nodes() == len(graph["nodes"]) and loaded.num_edges() == len(graph["edges"])


def require_scene_graph(graph: dict[str, Any]) -> None:
    """What the library demands: ids that are unique, edges between nodes that exist, one of a pair, one parent of a node."""
    layer = {node["id"]: node["layer"] for node in graph["nodes"]}
    assert len(layer) == len(graph["nodes"]), "an id twice"
    ends = [(edge["source"], edge["target"]) for edge in graph["edges"]]
    assert {node for pair in ends for node in pair} <= set(layer), "an edge that leads to no node"
    assert all(a != b for a, b in ends), "an edge from a node to itself"
    assert max(Counter(frozenset(pair) for pair in ends).values()) == 1, "two edges of one pair"
    parents = Counter(a if layer[a] < layer[b] else b for a, b in ends if layer[a] != layer[b])
    assert max(parents.values()) == 1 and all(abs(layer[a] - layer[b]) <= 1 for a, b in ends)
    assert all(parents[node] == 1 for node, level in layer.items() if level != 5), "rooms are in a building, places in rooms"


def test_what_the_library_refuses_is_refused_here() -> None:
    """Two edges of a pair, either way round, a second parent, and an end that is nowhere."""
    nodes = [{"id": i, "layer": level} for i, level in enumerate((5, 4, 4, 3, 3))]
    sound = [(0, 1), (0, 2), (1, 3), (2, 4), (3, 4), (1, 2)]
    edges = [{"source": a, "target": b} for a, b in sound]
    require_scene_graph({"nodes": nodes, "edges": edges})
    for a, b in ((4, 3), (2, 1), (2, 3), (3, 9), (0, 3), (2, 2)):
        with pytest.raises(AssertionError):
            require_scene_graph({"nodes": nodes, "edges": [*edges, {"source": a, "target": b}]})
