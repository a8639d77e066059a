"""Training that starts from other weights: the whole network, frozen parts, replay; and fine-tuning that is kept if it helped."""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from topomerge.models.embedder import Embedder
from topomerge.models.export import build_embedder_sample, export_embedder
from topomerge.models.weights import read_embedder

from tests.cases import list_longer
from tests.graphs import write_set
from tests.matching.turned_maps import turned
from tests.scenes_map import building
from topomerge.archive import find_weights_file
from topomerge.cli.main import main as cli
from topomerge.embedding.learned import load_embedder, read_embedder_card
from topomerge.embedding.network import Geometry, Network, Node
from topomerge.errors import InputError
from topomerge.io.maps import save_map
from topomerge.networks.network import WEIGHTS_PACKAGE, card_of
from topomerge.training import finetuning, room_matcher
from topomerge.training.embedding import EmbeddingJob, adopt_network, fit
from topomerge.training.finetuning import judge
from topomerge.training.settings import Training, check
from topomerge.training.tasks import compose_settings
from topomerge.training.validate import LEAST_CERTAINTIES, PairScores

SMALL = Network(Geometry(["scalars"], width=16), Node("gat", 1, heads=2, width=8), size=16)


def quiet(text: str) -> None:
    """Say nothing."""


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cache")
    for name, count in (("some", 8), ("other", 3), ("more", 4)):
        write_set(folder, name, count)
    return folder


@pytest.fixture
def settings(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Training:
    """Runs that are not exported: `best/` keeps the weights of torch."""
    monkeypatch.setattr(EmbeddingJob, "export_best", lambda self, folder: None)
    common = {"runs": str(tmp_path), "cache": str(cache), "data": "some", "validation": "other", "logger": []}
    return Training(**common, epochs=1, batch=4, rate=1e-3, network=SMALL)


def weights(run: Path) -> dict[str, torch.Tensor]:
    return read_embedder(run)[0].state_dict()


def test_the_embedder_that_ships_is_read_back_for_training() -> None:
    network, runtime = read_embedder("pretrained")[0], load_embedder()
    sample = build_embedder_sample(network)
    with torch.no_grad():
        torch_rows = network(sample)
    for ours, theirs in zip(torch_rows, runtime.run(**{n: t.numpy() for n, t in sample.items()}), strict=True):
        assert np.allclose(ours.numpy(), theirs, rtol=0, atol=1e-5)
    assert abs(float(network.temperature.detach()) - runtime.temperature) < 1e-6


@pytest.mark.parametrize("freeze", ["encoders", *list_longer("", "geometry")])
def test_the_whole_network_starts_from_a_run(settings: Training, tmp_path: Path, freeze: str) -> None:
    fit(replace(settings, name="first"), quiet)
    start = {"init_from": str(tmp_path / "first"), "network": Network(), "freeze": freeze, "rate": 1e-5, "seed": 7}
    fit(replace(settings, name="second", **start), quiet)
    before, after = weights(tmp_path / "first"), weights(tmp_path / "second")
    assert max(float((before[n] - after[n]).abs().max()) for n in before) < 1e-3  # else it began at random
    still = {"": (), "geometry": ("geometry.",), "encoders": ("geometry.", "node.")}[freeze]
    for part in ("geometry.", "node.", "project."):
        same = all(torch.equal(before[n], after[n]) for n in before if n.startswith(part))
        assert same == (part in still), part
    assert json.loads((tmp_path / "second" / "config.json").read_text())["network"]["size"] == 16
    fit(replace(settings, name="second", **start, resume=True, epochs=2), quiet)  # the file's settings are those of the run


def test_another_network_is_refused_by_name(settings: Training, tmp_path: Path) -> None:
    for asked, said in (
        ({"node": Node("none")}, r"node.kind \('gat' there, 'none' asked for\)"),
        ({"size": 32}, r"size \(64 there, 32 asked for\)"),
    ):
        with pytest.raises(InputError, match=f"init_from=pretrained: is another network: {said}") as raised:
            fit(replace(settings, init_from="pretrained", network=replace(Network(), **asked)), quiet)
        assert "\n" not in str(raised.value)
    taken = adopt_network(replace(settings, init_from="pretrained", network=replace(Network(), dropout=0.3)))
    assert taken.network.turns == 4 and taken.network.dropout == 0.3
    words = ["init_from=pretrained", "geometry=pointnet"]
    with pytest.raises(InputError, match=r"geometry.parts .*asked for"):
        adopt_network(compose_settings(words))
    assert adopt_network(compose_settings(["init_from=pretrained"])).network == read_embedder()[0].network
    with pytest.raises(InputError, match="init_from=.*nowhere.*No such file"):
        fit(replace(settings, init_from=str(tmp_path / "nowhere")), quiet)


@pytest.mark.parametrize("name", ["embedder.onnx", "plan_network.onnx"])
def test_a_start_that_is_not_what_its_card_says_is_refused(settings: Training, tmp_path: Path, name: str) -> None:
    """Cut off, or another network under its name: neither a traceback, nor random weights in the place of what is missing."""
    shipped = find_weights_file(WEIGHTS_PACKAGE, name)
    (tmp_path / "embedder.onnx").write_bytes(shipped.read_bytes()[: 100_000 if name == "embedder.onnx" else None])
    shutil.copy(card_of(find_weights_file(WEIGHTS_PACKAGE, "embedder.onnx")), tmp_path)
    with pytest.raises(InputError, match=r"embedder.onnx: cut off, damaged, or not the network that its card is about") as raised:
        fit(replace(settings, init_from=str(tmp_path)), quiet)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"freeze": "encoders"}, "freeze=encoders needs init_from=<run>, or"),
        ({"freeze": "geometry"}, "freeze=geometry needs init_from=<run> or geometry_from=<run>"),
        ({"freeze": "head"}, "geometry or encoders, or nothing"),
        ({"init_from": "a", "geometry_from": "b"}, "give one of them"),
        ({"replay": 1.0}, "replay must be 0 or more and below 1"),
        ({"replay": -0.1}, "replay must be"),
    ],
)
def test_settings_that_make_no_sense(settings: Training, change: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        check(replace(settings, **change))  # type: ignore[arg-type]


@pytest.mark.longer
def test_replay_mixes_another_set_in(settings: Training, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[list[int]] = []
    real = EmbeddingJob._draw_order
    monkeypatch.setattr(EmbeddingJob, "_draw_order", lambda self, g: drawn.append(real(self, g)) or drawn[-1])
    mixed = replace(settings, replay=0.5, replay_data="more", epochs=2)
    fit(mixed, quiet)
    fit(replace(mixed, name="again"), quiet)
    assert drawn[:2] == drawn[2:] and drawn[0] != drawn[1]
    for order in drawn:
        assert sorted(n for n in order if n < 8) == list(range(8)) and sum(8 <= n < 12 for n in order) == 8 == len(order) - 8
    assert all(
        torch.equal(a, b) for a, b in zip(weights(tmp_path / "run").values(), weights(tmp_path / "again").values(), strict=True)
    )
    assert "replay_data" in json.loads((tmp_path / "run" / "run.json").read_text())["data"]
    with pytest.raises(InputError, match="missing.jsonl"):
        fit(replace(mixed, name="third", replay_data="missing"), quiet)


def scores(first: int, rooms: int = 10, found: int = 8) -> PairScores:
    """A pair with so many rooms found first, and so many of ten matches right."""
    ranks = np.where(np.arange(rooms) < first, 1, 3)
    none = np.zeros(rooms, bool)
    return PairScores(ranks, none, none, np.tile([10, found, 10, found], (len(LEAST_CERTAINTIES), 1)), [])


def about(count: int, building: str = "x") -> list[dict[str, object]]:
    return [{"captures": [f"t{k}", f"n{k}"], "building": building} for k in range(count)]


def test_a_verdict_needs_pairs_and_a_gain_in_most_of_them() -> None:
    old = [scores(6) for _ in range(12)]
    better = judge(old, [scores(8, found=9) for _ in old], about(12), {f"t{k}" for k in range(12)})
    assert better.helped and better.unit == "captures left out" and better.units == 12
    assert better.gain["recall@1"] == pytest.approx((0.2, 0.2, 0.2)) and better.overall[0] == pytest.approx(0.15)
    assert better.format_lines()[-1].startswith("it helped; the mean of recall@1 and F1 changed by +0.150")
    mixed = judge(old, [scores(10 if k % 2 else 3) for k in range(12)], about(12), set())
    assert not mixed.helped and mixed.overall[0] > 0 > mixed.overall[1]
    assert "it did not help" in mixed.format_lines()[-1]
    few = judge(old[:3], [scores(10, found=10)] * 3, about(3), set())
    assert not few.helped and few.unit == "captures left out"
    assert few.format_lines()[-1].startswith("too few captures to tell whether it helped: 3 left out, at least 8 are needed; ")
    assert "[" not in "".join(few.format_lines())  # an interval over three would say nothing
    many = [{"captures": [f"t{k}", f"n{k % 3}"], "building": "x"} for k in range(12)]  # twelve pairs of three captures
    sure = judge(old, [scores(8, found=9) for _ in old], many, {f"t{k}" for k in range(12)})
    assert not sure.helped and sure.units == 3 and "too few captures to tell" in sure.format_lines()[-1]
    assert judge(old, old, about(12), set()).overall == (0.0, 0.0, 0.0)
    one = [{"captures": ["t", f"n{k % 2}"], "building": f"b{k % 9}"} for k in range(12)]
    assert judge(old, old, one, set()).unit == "buildings"
    with pytest.raises(InputError, match="no rooms match"):
        judge([scores(0, 0)], [scores(0, 0)], about(1), set())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three buildings of two maps each."""
    place, pairs = tmp_path / "mine", []
    for k in range(3):
        (place / f"b{k}").mkdir(parents=True)
        map = building(k + 1)
        there, pose = turned(map, (7.0, -3.0, 1.5))
        save_map(map, place / f"b{k}" / f"a{k}.tmap")
        save_map(there, place / f"b{k}" / f"z{k}.tmap")
        pairs.append({"a": f"a{k}", "b": f"z{k}", "transform": pose.matrix.tolist()})
    captures = [{"file": f"b{k}/{side}{k}.tmap"} for k in range(3) for side in "az"]
    (place / "pairs.yaml").write_text(yaml.safe_dump({"captures": captures, "pairs": pairs}))
    return place


@pytest.mark.longer
def test_finetune_keeps_what_helped(folder: Path, tmp_path: Path, monkeypatch, capsys, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    for name in ("onnxscript", "onnx_ir", "torch.onnx"):
        logging.getLogger(name).setLevel(logging.NOTSET)
    export_embedder(Embedder(SMALL), tmp_path / "start")
    assert [r.name for r in caplog.records] == []  # an export tells nothing
    caplog.set_level(logging.WARNING)
    out = tmp_path / "tuned"
    words = ["finetune", str(folder), "-o", str(out), "--from", str(tmp_path / "start"), "--epochs", "1", "--batch", "1", "-q"]
    words += ["--cache", str(tmp_path / "cache")]
    assert cli(words) == 2  # one pair is left out
    said = capsys.readouterr()
    assert said.err == "" and "too few captures to tell" in said.out and not (out / "embedder.onnx").exists()
    assert cli([*words, "--keep"]) == 0
    told = load_embedder(out)
    assert told.about["finetuned"]["helped"] is False and set(told.about["finetuned"]["old"]) == {"recall@1", "recall@5", "F1"}
    assert told(building(1)).shape == (3, 16)
    capsys.readouterr()
    assert cli(["match", str(folder / "b2/a2.tmap"), str(folder / "b2/z2.tmap"), "--descriptor", str(out)]) in (0, 2)
    real = judge
    monkeypatch.setattr(finetuning, "judge", lambda *given: replace(real(*given), helped=True))
    monkeypatch.setattr(finetuning, "fit", lambda *_: None)  # the run is there
    assert cli(words) == 0 and "it helped" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--rate", "0"], "--rate: must be a number above 0, not '0'"),
        (["--rate", "nan"], "--rate: must be a number above 0, not 'nan'"),
        (["--from", "nowhere"], "init_from=nowhere"),
        (["--replay", "1"], "replay must be"),
    ],
)
def test_bad_words_are_one_line(folder: Path, tmp_path: Path, capsys, words: list[str], said: str) -> None:
    assert cli(["finetune", str(folder), "-o", str(tmp_path / "x"), "--cache", str(tmp_path / "cache"), *words]) == 1
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1 and not (tmp_path / "x").exists()


@pytest.mark.longer
def test_a_run_on_own_pairs_goes_on_and_other_pairs_are_refused(folder: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(EmbeddingJob, "export_best", lambda self, folder: None)
    common = {
        "runs": str(tmp_path),
        "cache": str(tmp_path / "cache"),
        "data": "folder",
        "path": str(folder),
        "logger": [],
    }
    run = Training(**common, epochs=1, batch=1, network=SMALL)
    fit(run, quiet)
    fit(replace(run, epochs=2, resume=True), quiet)
    assert len((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()) == 2
    shutil.copytree(folder, tmp_path / "copy")
    with pytest.raises(InputError, match="path .*was"):
        fit(replace(run, path=str(tmp_path / "copy"), resume=True, epochs=3), quiet)
    values = yaml.safe_load((folder / "pairs.yaml").read_text())
    for pair in values["pairs"]:
        pair["transform"] = (np.array(pair["transform"]) + np.eye(4, k=3) * 0.3).tolist()
    (folder / "pairs.yaml").write_text(yaml.safe_dump(values))
    with pytest.raises(InputError, match="holds other pairs than when the run began"):
        fit(replace(run, epochs=3, resume=True), quiet)


@pytest.mark.longer
def test_a_matcher_reads_rows_of_the_embedder_that_is_named(tmp_path: Path) -> None:
    for name, node in (("turned", Node("gat", 1, width=8, ways=True)), ("plain", Node("none"))):
        export_embedder(Embedder(Network(Geometry(["scalars"], width=8), node, size=8)).eval(), tmp_path / name, {})
    network, digest = room_matcher.load_turned_embedder(str(tmp_path / "turned"))
    assert network.network.size == 8
    assert digest == read_embedder_card(tmp_path / "turned").digest != room_matcher.load_turned_embedder("pretrained")[1]
    with pytest.raises(InputError, match=r"^embedder=.*plain: tells no turns apart, as the matcher needs"):
        room_matcher.load_turned_embedder(str(tmp_path / "plain"))
    with pytest.raises(InputError, match=r"nowhere/embedder.onnx: No such file"):
        room_matcher.load_turned_embedder(str(tmp_path / "nowhere"))
