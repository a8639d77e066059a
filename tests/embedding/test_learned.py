"""Trained embedders as they are run: they say what torch says, whatever they are made of, and torch stays away."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.scenes_map import building
from topomerge.embedding import learned
from topomerge.embedding.graph import build_graph_arrays
from topomerge.embedding.learned import EMBEDDER_FILE, find_embedder, load_embedder, read_embedder_card
from topomerge.embedding.network import Geometry, Network, Node
from topomerge.embedding.quarter_turns import TurnedRows, join_rooms
from topomerge.embedding.sheets import build_sheet_arrays
from topomerge.embedding.surroundings import CROP_SHAPES
from topomerge.errors import InputError
from topomerge.fusion.pipeline import merge
from topomerge.networks.network import card_of
from topomerge.registry import GEOMETRIES, NODES
from topomerge.types import build_landmarks

ROOT = Path(__file__).parent.parent.parent
EARLIER = Path(__file__).parent / "earlier"


def graphs() -> dict[str, dict[str, np.ndarray]]:
    """Arrays of varied maps: a house of one room, one without doors, several storeys, rooms that nothing leads to."""
    two = building(2, 3)
    maps = {"storeys": two, "small": building(1), "one": join_rooms(two, np.arange(3))}
    graphs = {name: build_graph_arrays(map) | build_sheet_arrays(map) for name, map in maps.items()}
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
    pytest.importorskip("onnxscript")
    return pytest.importorskip("torch")


def exported(torch, network: Network, folder: Path):
    """A network with weights and statistics that are far from those of a fresh one, and its files."""
    from topomerge.models.embedder import Embedder
    from topomerge.models.export import export_embedder

    torch.manual_seed(0)
    made = Embedder(network).eval()
    with torch.no_grad():
        for name, value in made.state_dict().items():
            if name != "log_temperature":
                value.add_(0.1 * torch.rand(value.shape))
    export_embedder(made, folder, {"data": "none"})
    return made


def plain(rows):
    """Rows of all turns behind each other, or plain ones."""
    return rows.flatten() if isinstance(rows, TurnedRows) else rows


def compare(ours, network, several: dict[str, dict[str, np.ndarray]]) -> None:
    """What is loaded gives the embeddings and dustbins of a network of torch."""
    from topomerge.models.weights import wrap_network

    theirs = wrap_network(network)
    assert ours.temperature == pytest.approx(theirs.temperature, abs=1e-7) and ours.embedder
    for name, arrays in several.items():
        for rows, expected in zip(*(map(plain, one.embed_graph(arrays)) for one in (ours, theirs)), strict=True):
            assert rows.shape == expected.shape and rows.dtype == np.float64
            assert np.abs(rows - expected).max() < 1e-5, name


def test_the_embedder_that_ships_is_as_with_torch(torch):
    from topomerge.models.weights import read_embedder, wrap_network

    network, about = read_embedder()
    ours, theirs, map = load_embedder(), wrap_network(network), building(2, 2)
    compare(ours, network, graphs())
    assert ours.about == about and np.abs(ours.compute_matchability(map) - theirs.compute_matchability(map)).max() < 1e-5
    for one, other in zip(
        ours.compute_probabilities(map, building(3)), theirs.compute_probabilities(map, building(3)), strict=True
    ):
        assert np.abs(one - other).max() < 1e-5 and np.allclose(one.sum(axis=1), 1)


NETWORKS = {
    "values": Network(Geometry(["scalars"], width=16), Node("gat", 2, doors=1, width=8), size=24),
    "paper": Network(Geometry(["scalars"], width=16), Node("gat", 1, edge_values=False, jump="max"), size=8),
    "bare": Network(Geometry(["scalars"], width=8), Node("gat", 1, edges=False, edge_values=False, skip=False), size=8),
    "means": Network(
        Geometry(["engineered", "shapedna"], width=8), Node("sage", 1, doors=2, near=True, width=8, jump="last"), size=8
    ),
    "bare means": Network(Geometry(["scalars"], width=8), Node("sage", 2, edges=False), size=8),
    "crops": Network(Geometry(["scalars", *CROP_SHAPES], width=8), Node("gat", 1, around=10.0, ways=True), size=8),
    "points": Network(Geometry(["pointnet", "voxelcnn"], width=8), Node("none"), size=8),
    "local": Network(Geometry(["pointnet_local"], width=8, yaws=2, canonical=True), Node("none"), size=8),
}


SELDOM = ("bare", "bare means", "points", "local")  # with the slow tests: slow to export, or less of what another one has


@pytest.mark.longer
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n in SELDOM)) for n in NETWORKS])
def test_every_encoder_is_as_with_torch(torch, name, tmp_path):
    from topomerge.models.weights import read_embedder

    made = exported(torch, NETWORKS[name], tmp_path)
    rng = np.random.default_rng(0)  # of points as far away as each other, others come first elsewhere
    several = {
        n: g | {"room_points": g["room_points"] + rng.normal(0, 0.01, g["room_points"].shape)} for n, g in graphs().items()
    }
    compare(load_embedder(tmp_path), made, several)
    read, about = read_embedder(tmp_path)
    assert about == {"data": "none"} and read.network == made.network
    left, right = read.state_dict(), made.state_dict()
    assert left.pop("log_temperature") == pytest.approx(float(right.pop("log_temperature")), abs=1e-6)
    assert all(torch.equal(left[key], right[key]) for key in right)


def build_layer_of_somebody_else(kind: str, settings: Node, channels: int):
    """A layer of attention along doors, or one that attends to all rooms of the map as well (GPS: Rampasek et al. 2022)."""
    from torch_geometric.nn import GPSConv, TransformerConv

    beta = kind == "transformer"
    along = TransformerConv(channels, channels // settings.heads, settings.heads, edge_dim=settings.width, beta=beta)
    if kind == "transformer":
        return along

    class Gps(GPSConv):
        reads_map = True

        def forward(self, x, edge_index, edge_attr, map=None):
            return super().forward(x, edge_index, map, edge_attr=edge_attr)

    return Gps(channels, along, heads=settings.heads, norm="layer_norm", dropout=0.0)


@pytest.mark.longer
def test_a_network_that_reads_landmarks_is_exported_and_says_the_same_of_maps_without_to_the_bit(torch, tmp_path):
    """Of a map without landmarks, rows are those of the network without the part; signs change the rows of a map that has any."""
    from topomerge.models.embedder import Embedder
    from topomerge.models.export import export_embedder

    geometry, node = Geometry(["scalars"], width=16), Node("gat", 1, width=8)
    reads = exported(
        torch, Network(dataclasses.replace(geometry, parts=["scalars", "landmarks"]), node, size=8), tmp_path / "reads"
    )
    plain_network = Embedder(Network(geometry, node, size=8)).eval()
    plain_network.load_state_dict({n: v for n, v in reads.state_dict().items() if "landmarks" not in n})
    export_embedder(plain_network, tmp_path / "plain", {"data": "none"})
    ours, before = load_embedder(tmp_path / "reads"), load_embedder(tmp_path / "plain")
    map = building(2, 2)
    signs = build_landmarks("text", ["2.113", "2.114"], "r", room=np.array([0, 3]))
    marked = dataclasses.replace(map, landmarks=signs)
    assert np.array_equal(ours(map), before(map)) and np.array_equal(before(marked), before(map))
    assert np.abs(ours(marked) - ours(map)).max() > 1e-3
    compare(ours, reads, {"marked": build_graph_arrays(marked)})


@pytest.mark.longer
@pytest.mark.parametrize("kind", [pytest.param("transformer", marks=pytest.mark.slow), "gps"])  # the second holds the first
def test_a_node_encoder_of_somebody_else_trains_is_exported_and_loads(torch, tmp_path, monkeypatch, kind):
    """Registered by one line. Those who load it need not know it."""
    from topomerge.models.weights import read_embedder

    from tests.graphs import write_set
    from topomerge.training.embedding import fit
    from topomerge.training.settings import Training

    write_set(tmp_path, "some", 6)
    with monkeypatch.context() as registered:
        registered.setitem(NODES._registered, kind, lambda *words: build_layer_of_somebody_else(kind, *words))
        network = Network(Geometry(["scalars"], width=16), Node(kind, 2, width=8), size=8)
        common = {"runs": str(tmp_path), "cache": str(tmp_path), "data": "some", "validation": "", "logger": []}
        settings = Training(**common, epochs=2, batch=2, network=network)
        assert np.isfinite(fit(settings, lambda text: None)["train/loss"])
        made, _ = read_embedder(tmp_path / "run")
    assert sorted(p.name for p in (tmp_path / "run" / "best").iterdir()) == ["embedder.card.json", "embedder.onnx"]
    ours = load_embedder(tmp_path / "run")
    compare(ours, made, graphs())
    assert ours.network.node.kind == kind and ours.about["loss"] == "infonce"
    with pytest.raises(InputError, match=f"node.kind: unknown '{kind}'"):
        read_embedder(tmp_path / "run")
    merged = merge([building(2, origin=(x, -3.0, 0.5)) for x in (2.0, 4.0)], embedder=ours)
    assert len(merged.maps) == 2


@pytest.mark.longer
def test_a_geometry_encoder_of_crops_of_somebody_else_trains_is_exported_loads_and_merges(torch, tmp_path, monkeypatch):
    from topomerge.models.weights import read_embedder

    from tests.graphs import write_set
    from topomerge.training.embedding import fit
    from topomerge.training.settings import Training

    class Patches(torch.nn.Module):
        def __init__(self, width: int) -> None:
            super().__init__()
            self.each = torch.nn.Conv2d(CROP_SHAPES["surroundings"][-1], width, 16, 16)

        def forward(self, crops):
            return self.each(crops.permute(0, 3, 1, 2).float() / 255).relu().flatten(2).mean(dim=2)

    write_set(tmp_path, "some", 6)
    with monkeypatch.context() as registered:
        registered.setitem(GEOMETRIES._registered, "patches", Patches)
        network = Network(Geometry(["scalars", "surroundings:patches"], width=16), Node("gat", 1, width=8, ways=True), size=8)
        common = {"runs": str(tmp_path), "cache": str(tmp_path), "data": "some", "validation": "", "logger": []}
        assert np.isfinite(fit(Training(**common, epochs=2, batch=2, network=network), lambda text: None)["train/loss"])
        made, _ = read_embedder(tmp_path / "run")
        made.eval()
    ours, map = load_embedder(tmp_path / "run"), building(2, 2)
    compare(ours, made, graphs())
    assert not ours.needs_points and isinstance(ours(map), TurnedRows) and len(ours(map)) == len(map.rooms)
    merged = merge([building(2, origin=(x, -3.0, 0.5)) for x in (2.0, 4.0)], embedder=ours)
    assert len(merged.maps) == 2
    with pytest.raises(InputError, match=r"^geometry.parts: unknown 'patches'; pointnet, "):
        read_embedder(tmp_path / "run")


def test_attention_between_rooms_stays_within_their_map(torch, monkeypatch):
    """Of a batch of pairs a layer that reads the map gives each map the rows that it has alone."""
    from topomerge.models.embedder import Embedder

    from tests.graphs import pair as make_pair
    from topomerge.training.batches import make_batch

    monkeypatch.setitem(NODES._registered, "gps", lambda *words: build_layer_of_somebody_else("gps", *words))
    torch.manual_seed(0)
    network = Embedder(Network(Geometry(["scalars"], width=16), Node("gps", 2, width=8), size=8)).eval()
    pairs = [make_pair(seed, rooms) for seed, rooms in enumerate((7, 5, 6))]
    names = network.tensors
    with torch.no_grad():
        together = make_batch(pairs, names)
        rows, _ = network(together.tensors)
        alone = [network({name: of[name] for name in names})[0] for pair in pairs for of in (pair.a, pair.b)]
    assert together["map"].tolist() == sorted(together["map"].tolist()) and int(together["map"].max()) == 5
    assert torch.allclose(rows, torch.cat(alone), atol=1e-5)


@pytest.mark.longer
@pytest.mark.parametrize("name", ["gat_around", "one_crop"])
def test_what_earlier_versions_wrote_is_exported_and_says_the_same(torch, name, tmp_path):
    """Weights of torch, of which the program of then said what is kept here."""
    from topomerge.cli.main import main as cli

    with pytest.raises(InputError, match=r"^[^\n]*holds weights of torch, [^\n]* run topomerge export-embedder [^\n]*$"):
        load_embedder(EARLIER / name)
    assert cli(["export-embedder", str(EARLIER / name), "-o", str(tmp_path / "new"), "--quiet"]) == 0
    ours = load_embedder(tmp_path / "new")
    if name == "one_crop":
        with np.load(EARLIER / "expected_rows.npz", allow_pickle=False) as file:
            assert np.abs(ours(building(2)).rows - file["one_crop"]).max() < 1e-5
        return
    with np.load(EARLIER / "expected.npz", allow_pickle=False) as file:
        embedding, dustbin = ours.embed_graph({n.removeprefix("graph."): file[n] for n in file.files if n.startswith("graph.")})
        assert np.abs(embedding - file["pretrained.embedding"]).max() < 1e-5
        assert np.abs(dustbin - file["pretrained.dustbin"]).max() < 1e-5


def test_an_embedder_is_sent_to_another_process():
    ours, map = load_embedder(), building(1)
    again = pickle.loads(pickle.dumps(ours))
    assert np.array_equal(again(map).rows, ours(map).rows) and again.embedder == ours.embedder


@pytest.mark.longer
def test_torch_is_never_imported():
    code = (
        "import sys, topomerge as tm; from tests.scenes_map import building; from topomerge.cli.main import COMMANDS\n"
        "result = tm.merge([building(1), building(2)]); tm.load_embedder()(building(1)); assert result.descriptor == 'learned'\n"
        "print([m for m in ('torch', 'torch_geometric', 'hydra', 'lightning_fabric', 'safetensors') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def shipped(folder: Path) -> Path:
    """The embedder that ships, elsewhere."""
    for path in (find_embedder(), card_of(find_embedder())):
        shutil.copy(path, folder)
    return folder / EMBEDDER_FILE


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.update(format=99), "has format 99"),
        (lambda t: t.update({"class": "os.system"}), r"is no embedder \('os.system', not"),
        (lambda t: t.pop("network"), "lacks network"),
        (lambda t: t.pop("sha256"), "lacks network, sha256"),
        (lambda t: t.update(about=3), "lacks network, sha256, about"),
        (lambda t: t.update(temperature=0), "temperature must be above 0"),
        (lambda t: t.update(temperature=float("nan")), "temperature must be above 0"),
        (lambda t: t["network"].update(kind="x"), "unknown key kind"),
        (lambda t: t["network"].update(size=10**9), "size must be 1 to 4096"),
        (lambda t: t["network"]["node"].update(around=1e9), "node.around must be 0 to 100"),
        (lambda t: t["network"]["geometry"].update(parts=[["scalars"]]), "geometry.parts must be names"),
        (lambda t: t["network"]["geometry"].update(parts=[]), "geometry.parts must be one or more"),
        (lambda t: t["features"]["x"].reverse(), r"16 columns of x, this version has 16 \(other: their order\); train it again"),
        (lambda t: t["features"]["edge_attr"].append("colour"), r"12 columns of edge_attr, .* 11 \(other: colour\)"),
        (lambda t: t["features"].pop("x"), "0 columns of x"),
        (lambda t: t["features"].update(x=3), "0 columns of x"),
    ],
)
def test_cards_that_do_not_fit_are_refused(change, message, tmp_path):
    card = card_of(shipped(tmp_path))
    values = json.loads(card.read_text())
    change(values)
    card.write_text(json.dumps(values))
    with pytest.raises(InputError, match=rf"^[^\n]*embedder\.card\.json: [^\n]*{message}[^\n]*$"):
        load_embedder(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t["network"].update(size=32), "is of other outputs: embedding is "),
        (lambda t: t["network"]["geometry"].update(parts=["scalars"]), "is of other inputs: door_surroundings is "),
        (lambda t: t.update(sha256="0" * 64), "cut off, damaged, or not the network"),
    ],
)
def test_networks_that_do_not_fit_their_card_are_refused(change, message, tmp_path):
    card = card_of(shipped(tmp_path))
    values = json.loads(card.read_text())
    change(values)
    card.write_text(json.dumps(values))
    with pytest.raises(InputError, match=rf"^[^\n]*embedder\.onnx: {message}[^\n]*$"):
        load_embedder(tmp_path)


def test_a_pickle_under_another_name_is_not_run(torch, tmp_path):
    """What torch.save wrote could run anything when unpickled: it is refused by its digest, or as no network."""
    path = shipped(tmp_path)
    torch.save({"x": torch.ones(1)}, path)
    with pytest.raises(InputError, match="cut off, damaged"):
        load_embedder(tmp_path)
    values = json.loads(card_of(path).read_text())
    card_of(path).write_text(json.dumps({**values, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}))
    with pytest.raises(InputError, match="is no network that can be run"):
        load_embedder(tmp_path)


def test_a_network_is_opened_once_and_another_in_its_place_is_read(tmp_path, monkeypatch):
    opened = []
    original = learned.open_network
    monkeypatch.setattr(learned, "open_network", lambda *words: opened.append(words[0]) or original(*words))
    path = shipped(tmp_path)
    first, second = load_embedder(tmp_path), load_embedder(path)
    assert opened == [path] and first.run is second.run and first is not second
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="cut off, damaged"):
        load_embedder(tmp_path)


def test_where_an_embedder_is_looked_for(tmp_path, monkeypatch):
    (tmp_path / "run" / "best").mkdir(parents=True)
    path = shipped(tmp_path / "run" / "best")
    assert path == find_embedder(tmp_path / "run") == find_embedder(tmp_path / "run" / "best") == find_embedder(path)
    assert find_embedder() == find_embedder("pretrained") != path
    card = read_embedder_card(path)
    assert card.network.geometry.parts == ["scalars", *CROP_SHAPES] and "data" in card.about
    monkeypatch.setenv("TOPOMERGE_WEIGHTS", str(path.parent))
    assert find_embedder() == path
    for wrong in (tmp_path, tmp_path / "no_such"):
        with pytest.raises(InputError, match=r"embedder\.onnx: No such file; give a run's folder"):
            load_embedder(wrong)
    card_of(path).unlink()
    with pytest.raises(InputError, match="copy a network together with its card"):
        load_embedder(path)
