"""The NumPy run of trained networks: it says what torch says, reads nothing but what it should, and torch stays away."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors import numpy

from tests.scenes_map import building
from topomerge.embedding.embedders import embedder
from topomerge.embedding.graph import graph_arrays
from topomerge.embedding.learned import load_embedder
from topomerge.embedding.network import Geometry, Network, Node
from topomerge.embedding.room_cells import joined
from topomerge.embedding.sheets import sheet_arrays
from topomerge.embedding.turns import TurnedRows
from topomerge.embedding.weights import SETTINGS_FILE, WEIGHTS_FILE, embedder_folder, read_weights, unpacked
from topomerge.errors import InputError

ROOT = Path(__file__).parent.parent.parent
CONFIGS = ROOT / "configs"
PRETRAINED = ROOT / "topomerge" / "embedding" / "pretrained"
GEOMETRIES = ("scalars", "engineered", "shapedna", "scalars_engineered", "scalars_shapedna")
GEOMETRIES += ("surroundings", "scalars_surroundings", "scalars_wide", "scalars_doors", "scalars_crops")
SAGE = Network(Geometry(["scalars"], width=8), Node("sage", 1, width=4), size=8)


def graphs() -> dict[str, dict[str, np.ndarray]]:
    """Arrays of varied maps: a house of one room, one without doors, several storeys, rooms that nothing leads to."""
    two = building(2, 3)
    maps = {"storeys": two, "small": building(1), "one": joined(two, np.arange(3))}
    graphs = {name: graph_arrays(map) | sheet_arrays(map) for name, map in maps.items()}
    alone = dict(graphs["small"])
    for name, array in alone.items():
        if name.startswith(("edge", "door")):
            alone[name] = array[:, :0] if name.endswith("index") else array[:0]
    big, keep = graphs["storeys"], graphs["storeys"]["edge_index"].min(axis=0) > 2
    remaining = {n: big[n][:, keep] if n == "edge_index" else big[n][keep] for n in ("edge_index", "edge_attr", "edge_pos")}
    none = {"door_index": np.zeros((2, 0), int), "door_attr": np.zeros((0, 3), np.float32)}
    return graphs | {"no edges": alone, "isolated": {**big, **remaining, **none}}


@pytest.fixture(scope="module")
def torch():
    return pytest.importorskip("torch")


def saved(torch, network: Network, folder: Path, seed: int = 0) -> Path:
    """A network with weights and statistics that are far from those of a fresh one."""
    from topomerge.models.embedder import Embedder
    from topomerge.models.weights import save_embedder

    torch.manual_seed(seed)
    made = Embedder(network)
    with torch.no_grad():
        for name, value in made.state_dict().items():
            if name != "log_temperature":
                value.add_(0.1 * torch.rand(value.shape))
    save_embedder(made, folder, {"data": "none"})
    return folder


def plain(rows):
    """Rows of all turns behind each other, or plain ones."""
    return rows.flat() if isinstance(rows, TurnedRows) else rows


def compare(folder: Path, several: dict[str, dict[str, np.ndarray]]) -> None:
    """Both ways give the same embeddings and dustbins."""
    from topomerge.models.learned import load_with_torch

    ours, theirs = load_embedder(folder), load_with_torch(folder)
    assert ours.temperature == pytest.approx(theirs.temperature, abs=1e-7) and ours.about == theirs.about
    for name, arrays in several.items():
        for rows, wanted in zip(*(map(plain, learned.graph(arrays)) for learned in (ours, theirs)), strict=True):
            assert rows.shape == wanted.shape and rows.dtype == np.float64
            assert np.abs(rows - wanted).max() < 1e-5, name


def test_the_embedder_that_ships_is_as_with_torch(torch):
    compare(PRETRAINED, graphs())
    ours, map = load_embedder(), building(2, 2)
    from topomerge.models.learned import load_with_torch

    theirs = load_with_torch(PRETRAINED)
    assert np.abs(ours.matchability(map) - theirs.matchability(map)).max() < 1e-5
    for one, other in zip(ours.probabilities(map, building(3)), theirs.probabilities(map, building(3)), strict=True):
        assert np.abs(one - other).max() < 1e-5 and np.allclose(one.sum(axis=1), 1)


@pytest.mark.longer
@pytest.mark.parametrize("file", sorted(path.stem for path in (CONFIGS / "node").glob("*.yaml")))
def test_every_node_encoder_is_as_with_torch(torch, file, tmp_path):
    yaml = pytest.importorskip("yaml")
    options = yaml.safe_load((CONFIGS / "node" / f"{file}.yaml").read_text())
    node = Node(**{k: v for k, v in options.items() if not k.startswith("_")})
    compare(saved(torch, Network(Geometry(["scalars"], width=16), node, size=24), tmp_path), graphs())


@pytest.mark.longer
@pytest.mark.parametrize("file", GEOMETRIES)
@pytest.mark.parametrize("jump", ["last", "cat", "max"])
def test_every_geometry_of_numbers_is_as_with_torch(torch, file, jump, tmp_path):
    yaml = pytest.importorskip("yaml")
    options = yaml.safe_load((CONFIGS / "geometry" / f"{file}.yaml").read_text())
    node = Node("sage", 2, skip=jump == "max", jump=jump, width=8)
    network = Network(Geometry(options["parts"], width=16), node, size=8)
    rows = {"small": graphs()["small"], "one": graphs()["one"]}
    compare(saved(torch, network, tmp_path), rows)


def test_networks_that_read_points_go_through_torch(torch, tmp_path, monkeypatch):
    saved(torch, Network(Geometry(["scalars", "pointnet"], width=8), Node("none"), size=8), tmp_path)
    assert load_embedder(tmp_path)(building(1)).shape == (3, 8)
    for name in [n for n in sys.modules if n.startswith("topomerge.models.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)  # as if it were not installed
    with pytest.raises(InputError, match=r"reads points, for which it needs torch: pip install topomerge\[learn\]"):
        load_embedder(tmp_path)
    assert embedder("learned")(building(1)).shape == (3, 4, 64)


@pytest.mark.longer
def test_torch_is_never_imported():
    code = (
        "import sys, topomerge as tm; from tests.scenes_map import building; from topomerge.cli.main import COMMANDS\n"
        "result = tm.merge([building(1), building(2)]); tm.load_embedder()(building(1)); assert result.descriptor == 'learned'\n"
        "print([m for m in ('torch', 'torch_geometric', 'hydra', 'lightning_fabric') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def header(data: bytes) -> tuple[dict, bytes]:
    size = int.from_bytes(data[:8], "little")
    return json.loads(data[8 : 8 + size]), data[8 + size :]


def packed(table: object, body: bytes) -> bytes:
    text = json.dumps(table).encode()
    return len(text).to_bytes(8, "little") + text + body


def write_weights(data: bytes, folder: Path) -> None:
    """Bytes as the weights of the embedder that ships, with the digest that fits."""
    settings = json.loads((PRETRAINED / SETTINGS_FILE).read_text())
    (folder / WEIGHTS_FILE).write_bytes(data)
    (folder / SETTINGS_FILE).write_text(json.dumps({**settings, "sha256": hashlib.sha256(data).hexdigest()}))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t["project.0.bias"].update(dtype="I64"), "no safetensors"),
        (lambda t: [row.update(dtype="I32") for row in t.values()], "is no float32"),
        (lambda t: t["project.0.bias"].update(dtype="BF17"), "no safetensors"),
        (lambda t: t["project.0.bias"].update(shape=[-128]), "no safetensors"),
        (lambda t: t["project.0.bias"].update(shape=[1 << 62]), "no safetensors"),
        (lambda t: t["project.0.bias"].update(data_offsets=[1 << 40, (1 << 40) + 512]), "no safetensors"),
        (lambda t: t["project.0.bias"].update(data_offsets=[0]), "no safetensors"),
        (lambda t: t.update({"project.0.bias": 3}), "no safetensors"),
        (lambda t: t.update({"more": t["project.0.bias"]}), "no safetensors"),
        (lambda t: t["project.0.bias"].update(shape=[1, 1, 1, 1, 1, 128]), "at most five axes"),
        (lambda t: t.update({"x" * (1 << 20): t.pop("project.0.bias")}), "its header is cut off"),
    ],
)
def test_headers_that_lie_are_refused(change, message, tmp_path):
    table, body = header((PRETRAINED / WEIGHTS_FILE).read_bytes())
    change(table)
    write_weights(packed(table, body), tmp_path)
    with pytest.raises(InputError, match=rf"^[^\n]*embedder\.safetensors: does not fit [^\n]*{message}[^\n]*$"):
        load_embedder(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda w: w.pop("project.0.bias"), "project.0.bias"),
        (lambda w: w.update({"more": w["project.0.bias"]}), "more is of no layer"),
        (lambda w: w.update({"project.0.bias": w["project.0.bias"][:64]}), r"is \(64,\), not \(128,\)"),
        (lambda w: w.update({"project.0.weight": w["project.0.weight"].T.copy()}), ""),
        (lambda w: w.update({"node.edges.spread": 0 * w["node.edges.spread"]}), "spread: is not above 0"),
    ],
)
def test_weights_that_do_not_fit_are_refused(change, message, tmp_path):
    weights = numpy.load((PRETRAINED / WEIGHTS_FILE).read_bytes())
    change(weights)
    write_weights(numpy.save(weights), tmp_path)
    with pytest.raises(InputError, match=rf"embedder\.safetensors: does not fit .*{message}"):
        load_embedder(tmp_path)


@pytest.mark.parametrize("data", [b"", b"\xff" * 8, b"\xff" * 100, b"\x05\0\0\0\0\0\0\0[1,2]", b"\x02\0\0\0\0\0\0\0{"])
def test_what_is_no_safetensors_file_is_refused(data):
    with pytest.raises(ValueError):
        unpacked(data)


def test_folders_of_an_embedder(tmp_path):
    assert embedder_folder(PRETRAINED / WEIGHTS_FILE) == PRETRAINED == embedder_folder(PRETRAINED)
    network, weights, about = read_weights(PRETRAINED)
    assert (
        network.geometry.parts == ["scalars", "surroundings", "wide_surroundings", "door_surroundings"]
        and len(weights) > 40
        and "data" in about
    )
    with pytest.raises(InputError, match="give a run's folder"):
        load_embedder(tmp_path)
