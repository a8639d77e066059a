"""Training: what is cached, batched and logged; that a run which was interrupted ends with the same bytes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from topomerge.datasets.pairs.plan_examples import PlanItem, build_example_arrays
from topomerge.models.embedder import Embedder
from topomerge.models.weights import read_embedder

from tests.cases import list_longer
from tests.forked import run_words
from tests.graphs import pair, write_set
from topomerge import archive
from topomerge.checkpoint import load_state
from topomerge.embedding.learned import load_embedder
from topomerge.embedding.network import Geometry, Network, Node
from topomerge.errors import InputError
from topomerge.training import embedding
from topomerge.training.__main__ import main
from topomerge.training.batches import augment_graph, make_batch
from topomerge.training.descent import group_parameters, warmup_cosine
from topomerge.training.embedding import EmbeddingJob, fit, start_fabric
from topomerge.training.loop import State
from topomerge.training.packed_pairs import hold_out, load_pairs, mark_watched, read_scan_building
from topomerge.training.settings import Augment, Training, convert_to_dict, load_settings, parse_settings
from topomerge.training.table import write_table
from topomerge.training.tasks import compose_settings as from_words
from topomerge.training.validate import embed, validate

ROOT = Path(__file__).parent.parent.parent
NAMES = ("x", "room_points", "edge_index", "edge_attr", "door_index", "door_attr", "near_index", "near_attr")
SMALL = Network(Geometry(["scalars"], width=16), Node("gat", 1, heads=2, doors=1, near=True, width=8), size=16)


def quiet(text: str) -> None:
    """Say nothing."""


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cache")
    write_set(folder, "some", 10)
    write_set(folder, "other", 3)
    return folder


@pytest.fixture
def settings(cache, tmp_path) -> Training:
    common = {"runs": str(tmp_path), "cache": str(cache), "data": "some", "validation": "other", "logger": []}
    return Training(**common, epochs=3, batch=4, rate=0.01, network=SMALL)


@pytest.mark.longer
def test_a_set_is_packed_once(cache):
    said: list[str] = []
    pairs = load_pairs(cache / "some.jsonl", ["engineered", "shapedna", "near"], said.append)
    again = load_pairs(cache / "some.jsonl", ["engineered"], said.append, limit=4)
    assert len(pairs) == 10 and len(again) == 4 and sum("packing" in text for text in said) <= 1
    for k, one in enumerate(pairs):
        made = pair(k)
        assert torch.equal(one.matches, made.matches) and one.about["building"] == f"b{k}"
        for name in NAMES:
            side = "a" if name.startswith("near") else "b"  # the order of pairs of doors is that of the edges
            assert torch.equal(getattr(one, side)[name], getattr(made, side)[name]), name
        assert torch.isfinite(one.a["shapedna"]).all() and one.a["engineered"].shape == (7, 12)
    around = load_pairs(cache / "some.jsonl", around=100.0)[0].a
    assert around["edge_index"].shape[1] == 7 * 6 + pair(0).a["edge_index"].shape[1] and "door_index" not in around
    file = min((cache / "packed").glob("some-*.npz"), key=lambda path: len(path.name))  # the others are chunks of descriptors
    assert len(load_pairs(file)) == 10
    with pytest.raises(InputError, match=r"datasets\.pairs\.build data=none"):
        load_pairs(cache / "none.jsonl")


def test_a_batch_is_its_maps_beside_each_other():
    torch.manual_seed(0)
    net = Embedder(Network(Geometry(["scalars", "pointnet"]), Node("gat", doors=1))).eval()
    pairs = [pair(k) for k in range(3)]
    with torch.no_grad():
        together = torch.cat([e for e, _ in embed(net, pairs)])
        alone = torch.cat([e for one in pairs for e, _ in embed(net, [one])])
    assert torch.allclose(together, alone, atol=1e-5)
    truth = make_batch(pairs, NAMES).truth
    assert truth.same.sum() == 2 * sum(len(p.matches) for p in pairs) and torch.equal(truth.same, truth.same.T)
    assert not truth.same[truth.pair[:, None] != truth.pair[None]].any()


def test_lost_rooms_take_their_doors_and_matches_along():
    one = pair(0, rooms=9)
    some = {name: one.a[name] for name in NAMES}
    generator = torch.Generator().manual_seed(1)
    out, rooms_left = augment_graph(some, 9, Augment(rooms=0.9, edges=0.5, jitter=0.0, points=16), generator)
    assert 2 <= len(rooms_left) < 9 and torch.equal(out["x"], some["x"][rooms_left])
    assert out["room_points"].shape == (len(rooms_left), 16, 3)
    assert out["edge_index"].max() < len(rooms_left) and len(out["edge_attr"]) == out["edge_index"].shape[1]
    assert torch.equal(out["edge_index"][0][out["door_index"][0]], out["edge_index"][0][out["door_index"][1]])
    near = out["near_index"]
    assert len(out["near_attr"]) == near.shape[1] and near.max() < len(out["edge_attr"])
    for k in range(out["edge_index"].shape[1]):  # each edge is one of the old ones, with its features
        old = (some["edge_attr"] == out["edge_attr"][k]).all(dim=1).nonzero()[0, 0]
        assert torch.equal(some["edge_index"][:, old], rooms_left[out["edge_index"][:, k]])
    batch = make_batch([one], NAMES, Augment(rooms=0.8), generator)
    i, j = batch.truth.same.nonzero(as_tuple=True)
    assert (
        sum(batch.rooms) == len(batch.tensors["x"]) == len(batch.truth.same)
        and (batch.truth.side[i] != batch.truth.side[j]).all()
    )


def test_validation_of_a_perfect_and_of_a_blind_network():
    pairs = [pair(k) for k in range(3)]
    net = Embedder(SMALL).eval()
    net.fit_scales([g for p in pairs for g in (p.a, p.b)])
    good = validate(net, pairs)
    assert good["recall@1"] > 0.9 and good["merged"] == 1  # the maps are nearly equal, and so are embeddings by any network
    blind = Embedder(SMALL)
    for weights in blind.parameters():
        torch.nn.init.zeros_(weights)
    scored = validate(blind, pairs)
    assert scored["recall@1"] == 0 and scored["rooms"] == 36 and scored["mergeable"] == 3 and 0 <= scored["f1"] <= 1


@pytest.mark.usefixtures("unexported")
def test_overfit_one_batch(settings):
    best = fit(replace(settings, overfit=True, epochs=60, batch=3, rate=0.02), quiet)
    assert best["val/f1"] == 1.0 and best["val/recall@1"] == 1.0


@pytest.mark.usefixtures("unexported")
@pytest.mark.parametrize("kind", ["triplet", *list_longer("ntxent")])
def test_other_losses_train(settings, kind):
    settings.loss.kind = kind
    assert np.isfinite(fit(replace(settings, epochs=1), quiet)["train/loss"])


@pytest.mark.usefixtures("unexported")
def test_more_threads_train_the_same_network(settings):
    runs = [replace(settings, epochs=1, name=f"of_{threads}", threads=threads) for threads in (1, 3)]
    losses = [fit(run, quiet)["train/loss"] for run in runs]
    weights = [(run.folder / "best" / "embedder.safetensors").read_bytes() for run in runs]
    assert losses[0] == losses[1] and weights[0] == weights[1]


@pytest.mark.usefixtures("unexported")
def test_half_precision_trains(settings):
    """Fabric once refused the truth of a batch, so that no run with `precision=bf16-mixed` took a step."""
    assert np.isfinite(fit(replace(settings, epochs=1, precision="bf16-mixed"), quiet)["train/loss"])


@pytest.mark.longer
def test_a_run_is_a_folder(settings, tmp_path):
    best = fit(replace(settings, name="a", logger=["tensorboard"]), quiet)
    rows = [json.loads(line) for line in (tmp_path / "a" / "metrics.jsonl").read_text().splitlines()]
    assert [row["epoch"] for row in rows] == [0, 1, 2] and best["val/recall@1"] == max(r["val/recall@1"] for r in rows)
    assert (
        load_settings(tmp_path / "a" / "config.json")
        == load_settings(tmp_path / "a" / "config.yaml")
        == replace(settings, name="a", logger=["tensorboard"])
    )
    assert any((tmp_path / "a" / "tb").rglob("events*")) and list((tmp_path / "a" / "tb").rglob("tensors.tsv"))
    assert load_embedder(tmp_path / "a").about["data"] == "some" and read_embedder(tmp_path / "a" / "last")
    with pytest.raises(InputError, match=r"a training that has not ended .*export-embedder"):
        load_embedder(tmp_path / "a" / "last")
    assert "| a | scalars | gat 1 | near doors | infonce |" in write_table(tmp_path).read_text()


def weights(folder: Path) -> bytes:
    return (folder / "embedder.safetensors").read_bytes()


@pytest.mark.longer
@pytest.mark.usefixtures("unexported")  # equal weights give equal files: tests/networks/test_network.py
def test_resumed_equals_uninterrupted(settings, tmp_path, monkeypatch):
    settings.network = replace(SMALL, geometry=Geometry(["scalars", "pointnet"], width=16))
    fit(replace(settings, name="whole"), quiet)
    step, done = EmbeddingJob.train_step, []

    def interrupted(self, batch, state):
        done.append(1)
        if len(done) == 4:  # in the middle of the second epoch
            os.kill(os.getpid(), signal.SIGINT)
        return step(self, batch, state)

    monkeypatch.setattr(EmbeddingJob, "train_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit(replace(settings, name="cut"), quiet)
    assert {path.name for path in (tmp_path / "cut" / "best").iterdir()} == {"embedder.json", "embedder.safetensors"}
    state = json.loads((tmp_path / "cut" / "last" / "state.json").read_text())["progress"]
    assert (state["epoch"], state["step"]) == (1, 2)
    monkeypatch.setattr(EmbeddingJob, "train_step", step)
    fit(replace(settings, name="cut", resume=True), quiet)
    for folder in ("best", "last"):
        assert weights(tmp_path / "cut" / folder) == weights(tmp_path / "whole" / folder), folder
    for cut, whole in zip(*((tmp_path / n / "metrics.jsonl").read_text().splitlines() for n in ("cut", "whole")), strict=True):
        a, b = json.loads(cut), json.loads(whole)
        assert {k: v for k, v in a.items() if k.startswith(("val", "train"))} == {
            k: v for k, v in b.items() if k.startswith(("val", "train"))
        }


@pytest.mark.usefixtures("unexported")
def test_another_seed_gives_other_weights(settings, tmp_path):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        fit(replace(settings, name=name, seed=seed, epochs=1), quiet)
    assert weights(tmp_path / "a" / "last") == weights(tmp_path / "b" / "last") != weights(tmp_path / "c" / "last")


@pytest.mark.usefixtures("unexported")
def test_it_stops_early(settings):
    said: list[str] = []
    fit(replace(settings, epochs=30, patience=2, rate=1e-9), said.append)
    assert len(said) < 10


@pytest.mark.longer
@pytest.mark.usefixtures("unexported")
def test_geometry_alone_then_frozen(settings, tmp_path):
    alone = replace(settings, name="alone", network=replace(SMALL, node=Node("none")))
    fit(alone, quiet)
    fit(replace(settings, name="frozen", geometry_from=str(tmp_path / "alone"), freeze="geometry"), quiet)
    first, second = (read_embedder(tmp_path / n)[0].geometry.state_dict() for n in ("alone", "frozen"))
    assert all(torch.equal(first[name], second[name]) for name in first)
    with pytest.raises(InputError, match="geometry_from"):
        fit(replace(settings, freeze="geometry"), quiet)


@pytest.mark.usefixtures("unexported")
def test_bad_states_are_refused(settings, tmp_path):
    with pytest.raises(InputError, match="nothing to resume"):
        fit(replace(settings, resume=True), quiet)
    last = tmp_path / "run" / "last"
    net = Embedder(SMALL)
    optimizer = torch.optim.AdamW(net.parameters())

    fit(replace(settings, epochs=1), quiet)
    shutil.copytree(last, tmp_path / "sound")

    def fresh():
        shutil.copytree(tmp_path / "sound", last, dirs_exist_ok=True)

    file = last / "optimizer.safetensors"
    file.write_bytes(file.read_bytes()[:-10])
    with pytest.raises(InputError, match="optimizer"):
        load_state(last, net, optimizer)
    for change, said in (({"format": 7}, "format 7"), ({"class": "builtins.eval"}, "no state")):
        fresh()
        state = json.loads((last / "state.json").read_text())
        (last / "state.json").write_text(json.dumps({**state, **change}))
        with pytest.raises(InputError, match=said):
            load_state(last, net, optimizer)
    fresh()
    other = Embedder(replace(SMALL, size=8))
    with pytest.raises(InputError, match="another network"):
        load_state(last, other, torch.optim.AdamW(other.parameters()))


def test_pace_and_holding_out():
    assert (
        warmup_cosine(0.0, 0.1) < 0.02
        and warmup_cosine(0.1, 0.1) == pytest.approx(1)
        and warmup_cosine(1.0, 0.1) == pytest.approx(0)
    )
    train, held = hold_out([pair(k, 3) for k in range(60)])
    assert len(train) + len(held) == 60 and 0 < len(held) < 20


def test_storeys_of_a_building_are_on_one_side():
    """Of twelve schools with four storeys each; by raw names they were on both sides."""
    storeys = [pair(k, 3) for k in range(48)]
    for k, one in enumerate(storeys):
        one.about.update({"source": "campus", "building": f"Schule{'abcdefghijkl'[k // 4]}{k % 4}"})
    train, held = hold_out(storeys)
    sides = [{one.buildings[0] for one in side} for side in (train, held)]
    assert len(sides[0]) + len(sides[1]) == 12 and len(held) % 4 == 0 and not sides[0] & sides[1]
    assert storeys[0].building_numbers == storeys[3].building_numbers != storeys[4].building_numbers
    building = make_batch([storeys[0], storeys[3], storeys[4]], ("x",)).truth.building.split([6, 6, 6])
    assert torch.equal(building[0], building[1]) and len({int(b[0]) for b in building}) == 2
    stranger = replace(storeys[0], about={**storeys[0].about, "hard": "other-building", "file": "x.npz"})
    assert stranger.buildings[0] == storeys[0].buildings[0] != stranger.buildings[1]


def test_scans_of_a_building_are_watched_together(tmp_path):
    assert mark_watched(["a", "b", "a", "c", "b", "d"], 2).tolist() == [True, False, True, True, False, False]
    archive.write(build_example_arrays(PlanItem(7, "r2v", 3, "house/first", ""), []), tmp_path / "real.npz")
    archive.write(build_example_arrays(PlanItem(7, "procedural", 0, "", ""), []), tmp_path / "made.npz")
    assert (
        read_scan_building(tmp_path / "real.npz") == "r2v/house" and read_scan_building(tmp_path / "made.npz") == "procedural/7"
    )


def test_biases_norms_and_the_temperature_do_not_decay():
    network = Embedder(Network(Geometry(["scalars", "pointnet", "surroundings"]), Node("gat", doors=1)))
    layers, others = group_parameters(network, 0.1)
    assert layers["weight_decay"] == 0.1 and others["weight_decay"] == 0
    still = {id(p) for p in others["params"]}
    undecayed = {name for name, p in network.named_parameters() if id(p) in still}
    assert "log_temperature" in undecayed and all(name in undecayed for name, _ in network.named_parameters() if "bias" in name)
    for name, module in network.named_modules():
        if "Norm" in type(module).__name__:
            assert all(id(p) in still for p in module.parameters()), name
        if isinstance(module, torch.nn.Linear):
            assert id(module.weight) not in still, name
    assert len(layers["params"]) + len(still) == len(list(network.parameters()))


def poisoned(monkeypatch, at: int, value: float) -> None:
    """Let the gradient of one step of a training be no finite number."""
    backward, done = torch.Tensor.backward, []

    def spoilt(self, *args, **kwargs):
        backward(self, *args, **kwargs)
        done.append(1)
        if len(done) == at:
            network = spoilt.network
            next(p for p in network.parameters() if p.grad is not None).grad.fill_(value)

    start = EmbeddingJob.__init__

    def noted(self, settings, fabric, network, *rest):
        spoilt.network = network
        start(self, settings, fabric, network, *rest)

    monkeypatch.setattr(EmbeddingJob, "__init__", noted)
    monkeypatch.setattr(torch.Tensor, "backward", spoilt)


@pytest.mark.parametrize("value", [float("nan"), *list_longer(float("inf"))])
def test_a_gradient_that_is_no_number_ends_the_run_in_one_line(settings, tmp_path, monkeypatch, value):
    poisoned(monkeypatch, 4, value)  # in the second epoch
    with pytest.raises(InputError, match="step 2 of epoch 2: a loss or gradient is no finite number") as refused:
        fit(settings, quiet)
    assert "\n" not in str(refused.value)
    assert read_embedder(tmp_path / "run" / "last")  # that of the first epoch, which can be read


@pytest.mark.parametrize("fused", [False, True])
def test_a_weight_is_not_touched_by_a_gradient_that_is_no_number(settings, fused):
    """On a device, where nobody waits for the norm, the optimizer itself leaves the step out."""
    torch.manual_seed(0)
    fabric, network = start_fabric(settings), Embedder(SMALL)
    optimizer = torch.optim.AdamW(group_parameters(network, 0.1), 0.1, fused=fused)
    pairs = [pair(k) for k in range(4)]
    job = EmbeddingJob(settings, fabric, network, optimizer, (pairs, pairs))
    batch = next(job.iter_batches(State()))
    before = [p.detach().clone() for p in network.parameters()]
    bad = batch.clone()
    bad["x"] = bad["x"] * float("nan")
    if fused:
        assert not job.train_step(bad, State())["norm"].isfinite()
    else:
        with pytest.raises(InputError, match="diverged"):
            job.train_step(bad, State())
    assert all(torch.equal(a, b) for a, b in zip(before, network.parameters(), strict=True))
    job.train_step(batch, State())
    assert all(p.isfinite().all() for p in network.parameters()) and not torch.equal(before[1], list(network.parameters())[1])


@pytest.mark.longer
@pytest.mark.usefixtures("unexported")
def test_an_overflow_of_half_precision_skips_a_step(settings, tmp_path, monkeypatch):
    """A scale of 2^127 makes the first gradients infinite; the scaler halves it until they are not."""
    from lightning_fabric import Fabric
    from lightning_fabric.plugins import MixedPrecision

    scaler = torch.amp.GradScaler("cpu", init_scale=2.0**127, backoff_factor=2.0**-64)
    plugin = MixedPrecision("bf16-mixed", "cpu")
    plugin.scaler = scaler
    monkeypatch.setattr(embedding, "start_fabric", lambda settings: Fabric(accelerator="cpu", devices=1, plugins=[plugin]))
    fit(settings, quiet)
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert rows[0]["train/skipped"] == 0.5 and rows[1]["train/skipped"] == 0  # one of two steps
    assert all(np.isfinite(row["train/norm"]) and np.isfinite(row["train/loss"]) for row in rows)
    assert scaler.get_scale() == 2.0**63


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"rate": float("nan")}, "rate must be a finite number"),
        ({"precision": "16-mixed"}, "precision=16-mixed needs accelerator=cuda"),
        ({"accelerator": "cuda"}, "accelerator=cuda: torch finds no such device here"),
        ({"watch": "recall"[:-1]}, "watch: unknown 'recal'"),
        *list_longer(
            ({"rate": -1.0}, "rate"),
            ({"rate": 0.0}, "rate"),
            ({"precision": "half"}, "precision: unknown 'half'"),
            ({"precision": "16-mixed", "accelerator": "auto"}, "accelerator=auto: torch finds no such device here"),
            ({"accelerator": "tpu"}, "accelerator: unknown 'tpu'"),
        ),
    ],
)
def test_what_cannot_train_is_refused_before_data_is_read(settings, tmp_path, monkeypatch, change, said):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr(embedding, "load_pairs", lambda *_, **__: pytest.fail("data was read"))
    with pytest.raises(InputError, match=said) as refused:
        fit(replace(settings, **change), quiet)
    assert "\n" not in str(refused.value) and not (tmp_path / "run").exists()
    with pytest.raises(InputError, match="rate"):
        from_words(["rate=fast"])


CONFIGS = ROOT / "configs"
GROUPS = [("geometry", p.stem) for p in sorted((CONFIGS / "geometry").glob("*.yaml"))]
GROUPS += [(group, p.stem) for group in ("node", "loss", "experiment") for p in sorted((CONFIGS / group).glob("*.yaml"))]


@pytest.mark.longer
@pytest.mark.parametrize(("group", "name"), GROUPS)
def test_every_config_composes_and_builds(group, name):
    config = from_words([f"{group}={name}"])
    assert sum(p.numel() for p in Embedder(config.network).parameters()) > 1000
    assert parse_settings(convert_to_dict(config)) == config
    if group == "experiment":
        assert config.name == name


@pytest.mark.longer
def test_typos_name_their_key(tmp_path):
    for word in ("epoch=3", "network.node.layer=3", "loss.kinds=triplet", "epochs=many", "data.pears=3", "geometry=pointnets"):
        with pytest.raises(InputError, match=word.split("=")[0].split(".")[-1]):
            from_words([word])
    assert from_words(["network.geometry.width=32", "network.node.layers=1", "loss.easy=0.5"]).network.geometry.width == 32
    assert from_words() == replace(Training(), network=from_words().network)  # the defaults have one home
    assert from_words(["data=procedural", "data.pairs=3"]).data == "procedural"
    path = tmp_path / "run.json"
    for text, said in (
        ('{"epoch": 3}', "epoch"),
        ('{"epochs": "3"}', "epochs"),
        ('{"loss": {"sort": 1}}', "loss.sort"),
        ("{", "damaged"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=said):
            load_settings(path)


def run(words: list[str]) -> subprocess.CompletedProcess:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False, env=environment)


@pytest.mark.longer
def test_without_hydra(settings, tmp_path, capsys):
    """On a machine with no Hydra and no Open3D, and without importing the extraction."""
    (tmp_path / "run.json").write_text(json.dumps({**convert_to_dict(settings), "epochs": 1}))
    code = (  # in a fork, which begins without what the tests have imported of these
        "import atexit, re, runpy, sys\n"
        "bad = lambda names: [m for m in sys.modules if re.match(rf'({names})(\\.|$)', m)]\n"
        "for name in bad('hydra|omegaconf|open3d|topomerge'): del sys.modules[name]\n"
        "atexit.register(lambda: print('imported:', bad('hydra|omegaconf|open3d|topomerge.extraction')))\n"
        "runpy.run_module('topomerge.training', run_name='__main__')\n"
    )
    (tmp_path / "bare.py").write_text(code)
    done = run_words([tmp_path / "bare.py", tmp_path / "run.json", "name=bare"], ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.endswith("imported: []\n")
    assert load_embedder(tmp_path / "bare").about["run"] == "bare"
    assert main([str(tmp_path / "run.json"), "batch=0"]) == 1
    assert capsys.readouterr().err.startswith("train: batch")


def short(settings):
    """Words of a training of one epoch."""
    where = [f"runs={settings.runs}", f"cache={settings.cache}"]
    return [*where, "validation=other", "data.name=some", "epochs=1", "batch=4", "logger=none"]


@pytest.mark.slow
def test_train_py_and_a_sweep(settings, tmp_path):
    common = short(settings)
    done = run([sys.executable, "train.py", *common, "experiment=gat_scalars", "--overfit"])
    assert done.returncode == 0 and (tmp_path / "gat_scalars" / "best" / "embedder.onnx").exists(), done.stderr
    done = run([sys.executable, "train.py", "-m", *common, "geometry=scalars,pointnet", "node=none,gat"])
    assert done.returncode == 0 and (tmp_path / "sweep" / "table.md").read_text().count("\n") == 6, done.stderr
    names = {path.name for path in (tmp_path / "sweep").iterdir() if path.is_dir()}
    assert names == {f"geometry={geometry},node={node}" for geometry in ("scalars", "pointnet") for node in ("none", "gat")}
    start = json.loads((tmp_path / "sweep" / "geometry=scalars,node=gat" / "run.json").read_text())["starts"][0]
    assert start["command"].startswith("python train.py runs=") and "geometry=scalars" in start["command"]
    done = run([sys.executable, "train.py", *common, "epoch=3"])
    assert done.returncode == 1 and "epoch" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_launchers(settings, tmp_path, launcher):
    pytest.importorskip({"joblib": "hydra_plugins.hydra_joblib_launcher", "submitit_local": "submitit"}[launcher])
    common = short(settings)
    done = run([sys.executable, "train.py", "-m", *common, f"hydra/launcher={launcher}", "node=none,gat"])
    assert done.returncode == 0 and (tmp_path / "sweep" / "table.md").read_text().count("\n") == 4, done.stdout + done.stderr


@pytest.mark.slow
def test_two_processes(settings, tmp_path):
    """torchrun with gloo: both processes end with the same weights as each other, written once."""
    (tmp_path / "run.json").write_text(json.dumps(convert_to_dict(replace(settings, batch=2))))
    words = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "topomerge.training"]
    done = run([sys.executable, *words, str(tmp_path / "run.json"), "name=two"])
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in (tmp_path / "two" / "metrics.jsonl").read_text().splitlines()]
    assert len(rows) == 3 and load_embedder(tmp_path / "two")
