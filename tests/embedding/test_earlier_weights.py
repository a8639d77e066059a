"""Embedders of format 1, written when the layers were the program's own, say what they said."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.scenes_map import building
from topomerge.embedding.learned import load_embedder
from topomerge.embedding.weights import read_weights
from topomerge.errors import InputError
from topomerge.types import Array

# Networks with random weights, and what the program of then made of one graph with them and with the embedder that shipped then.
EARLIER = Path(__file__).parent / "earlier"
NETWORKS = ("gat", "gat_bare", "gat_doors", "gat_paper", "sage", "sage_bare")
SHIPPED_BEFORE = "gat_around"  # of format 2


@pytest.fixture(scope="module")
def stored() -> dict[str, Array]:
    with np.load(EARLIER / "expected.npz", allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def graph(stored: dict[str, Array]) -> dict[str, Array]:
    return {name.removeprefix("graph."): array for name, array in stored.items() if name.startswith("graph.")}


@pytest.mark.parametrize("name", [*NETWORKS, SHIPPED_BEFORE])
def test_embeddings_stay(name, stored):
    expected = "pretrained" if name == SHIPPED_BEFORE else name
    embedding, dustbin = load_embedder(EARLIER / name).graph(graph(stored))
    assert np.abs(embedding - stored[f"{expected}.embedding"]).max() < 1e-9
    assert np.abs(dustbin - stored[f"{expected}.dustbin"]).max() < 1e-9


@pytest.mark.parametrize("name", NETWORKS)
def test_torch_reads_them_and_writes_them_in_the_format_of_today(name, stored, tmp_path):
    pytest.importorskip("torch_geometric")
    from topomerge.models.learned import learned
    from topomerge.models.weights import read_embedder, save_embedder

    network, about = read_embedder(EARLIER / name)
    embedding, _ = learned(network).graph(graph(stored))
    assert np.abs(embedding - stored[f"{name}.embedding"]).max() < 1e-6
    save_embedder(network, tmp_path, about)
    settings = json.loads((tmp_path / "embedder.json").read_text())
    assert settings["format"] == 2 and "told" not in settings["network"]["node"]
    again, _ = load_embedder(tmp_path).graph(graph(stored))
    assert np.array_equal(again, load_embedder(EARLIER / name).graph(graph(stored))[0])


def test_edges_that_were_not_summed_add_nothing():
    network, weights, _ = read_weights(EARLIER / "gat_paper")
    assert network.node.edge_values and not weights["node.layers.0.lin_edge_value.weight"].any()
    assert not any(name.startswith("node.layers.0.edge") for name in weights)


def test_a_layer_that_is_missing_is_named(tmp_path):
    """Weights of another network of format 1 under these settings."""
    for name, source in (("embedder.json", "gat"), ("embedder.safetensors", "sage")):
        (tmp_path / name).write_bytes((EARLIER / source / name).read_bytes())
    settings = json.loads((tmp_path / "embedder.json").read_text())
    other = json.loads((EARLIER / "sage" / "embedder.json").read_text())
    (tmp_path / "embedder.json").write_text(json.dumps({**settings, "sha256": other["sha256"]}))
    with pytest.raises(InputError, match=r"embedder\.safetensors: does not fit .*node\.layers\.0\.lin_"):
        load_embedder(tmp_path)


def test_rows_for_quarter_turns_stay():
    """A network of one crop, as shipped before there were crops of two sizes and of doors."""
    rows = load_embedder(EARLIER / "one_crop")(building(2))
    with np.load(EARLIER / "expected_rows.npz", allow_pickle=False) as file:
        assert np.abs(rows.rows - file["one_crop"]).max() < 1e-9
