"""The schema of features: widths follow from it, in a copy of the program that has one feature more."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.forked import run_words
from topomerge.embedding import graph

ROOT = Path(__file__).parent.parent.parent


def test_columns_are_looked_up_by_name():
    assert [graph.TABLES["x"][k] for k in graph.find_columns_of_power("x", 1)] == [
        "height", "length", "width", "floor_spread", "door_width", "reach",
    ]  # fmt: skip
    assert (
        graph.find_columns_of_power("x", 2) == [graph.find_column("x", "area")]
        and graph.find_column("edge_attr", "turn_cos") == 10
    )
    for name, powers in graph.LENGTH_POWERS.items():
        assert set(powers) <= set(graph.TABLES[name])
    for columns in graph.TABLES.values():
        assert len(set(columns)) == len(columns)


def test_a_feature_more_makes_everything_wider(tmp_path):
    """One more feature of rooms and of edges, in front of all others: layers, examples and packed columns follow."""
    pytest.importorskip("torch_geometric")
    for folder, place in (("topomerge", "topomerge"), ("models", "topomerge/models")):  # with what has been compiled
        shutil.copytree(ROOT / folder, tmp_path / place, dirs_exist_ok=True)
    path = tmp_path / "topomerge" / "embedding" / "graph.py"
    text = path.read_text()
    for name in ("ROOM_FEATURES = (", "EDGE_FEATURES = ("):
        text = text.replace(f"\n{name}", f"\n{name}\n    'brightness',")
    path.write_text(text)
    code = """
import sys
for name in [name for name in sys.modules if name.partition(".")[0] == "topomerge"]:
    del sys.modules[name]  # that of the tests: this is a fork of them
import json, torch, topomerge
from topomerge.embedding.learned import load_embedder
from topomerge.embedding.network import Geometry, Network, Node
from topomerge.embedding.graph import CLIMB, KIND_COLUMNS
from topomerge.errors import InputError
from topomerge.models.embedder import Embedder
from topomerge.models.export import build_embedder_sample
network = Embedder(Network(Geometry(width=8), Node("gat", width=4), size=8))
tensors = build_embedder_sample(network)
try:
    refused = load_embedder().network.size
except InputError as error:
    refused = str(error)
print(json.dumps({"file": topomerge.__file__, "x": tensors["x"].shape[1], "edge_attr": tensors["edge_attr"].shape[1],
    "rooms": network.geometry.parts["scalars"].each[0].in_features, "edges": network.node.edge[0].in_features,
    "embedding": list(network(tensors)[0].shape), "columns": [CLIMB, *KIND_COLUMNS], "refused": refused}))
"""
    (tmp_path / "wider.py").write_text(code)
    done = run_words(["wider.py"], tmp_path)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert Path(said["file"]).is_relative_to(tmp_path)
    rooms, edges = len(graph.ROOM_FEATURES) + 1, len(graph.EDGE_FEATURES) + 1
    assert (said["x"], said["rooms"], said["edge_attr"], said["edges"]) == (rooms, rooms, edges, edges)
    assert said["embedding"] == [6, 8] and said["columns"] == [7, 3, 4, 5]
    assert (
        "embedder.card.json: was trained on 16 columns of x, this version has 17 (other: brightness); train it again"
        in said["refused"]
    )
