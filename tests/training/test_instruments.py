"""What a loop can have besides: an average of weights, the best epochs, a trace, anomalies; and the scaler of half precision."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from topomerge.models.weights import read_embedder
from torch import nn

from tests.graphs import write_set
from topomerge.embedding.network import Geometry, Network, Node
from topomerge.errors import InputError
from topomerge.training import embedding
from topomerge.training.embedding import EmbeddingJob, fit
from topomerge.training.instruments import StepTracer, WeightAverage, find_anomaly, rank_epochs
from topomerge.training.settings import Training

SMALL = Network(Geometry(["scalars"], width=16), Node("gat", 1, heads=2, width=8), size=16)


def quiet(text: str) -> None:
    """Say nothing."""


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cache")
    write_set(folder, "some", 8)
    write_set(folder, "other", 3)
    return folder


@pytest.fixture
def settings(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Training:
    """Three epochs of two steps that are not exported: `best/` keeps the weights of torch."""
    monkeypatch.setattr(EmbeddingJob, "export_best", lambda self, folder: None)
    common = {"runs": str(tmp_path), "cache": str(cache), "data": "some", "validation": "other", "logger": []}
    return Training(**common, epochs=3, batch=4, rate=0.01, network=SMALL)


def last(run: Path) -> dict[str, torch.Tensor]:
    return load_file(run / "last" / "embedder.safetensors")


def cut(monkeypatch: pytest.MonkeyPatch, settings: Training, step: int) -> None:
    """Train until a step, and go on after it."""
    real, done = EmbeddingJob.train_step, []

    def interrupt(self, batch, state):
        done.append(1)
        if len(done) == step:
            os.kill(os.getpid(), signal.SIGINT)
        return real(self, batch, state)

    monkeypatch.setattr(EmbeddingJob, "train_step", interrupt)
    with pytest.raises(KeyboardInterrupt):
        fit(settings, quiet)
    monkeypatch.setattr(EmbeddingJob, "train_step", real)
    fit(replace(settings, resume=True), quiet)


def test_an_average_follows_the_weights() -> None:
    network = nn.Sequential(nn.Linear(2, 1, bias=False), nn.BatchNorm1d(1))
    nn.init.zeros_(network[0].weight)
    average, expected = WeightAverage(network, 0.5), 0.0
    for step in range(30):
        nn.init.constant_(network[0].weight, float(step))
        average.update(step)
        decay = min(0.5, (1 + step) / (10 + step))
        expected = decay * expected + (1 - decay) * step
    assert average.kept["0.weight"].tolist() == [[pytest.approx(expected)] * 2] and expected == pytest.approx(28, abs=0.01)
    with average.apply():
        assert network[0].weight.tolist() == average.kept["0.weight"].tolist()
    assert network[0].weight.tolist() == [[29.0, 29.0]]
    assert "1.num_batches_tracked" not in average.kept and "1.running_mean" in average.kept


@pytest.mark.longer
def test_the_average_is_validated_and_kept_and_goes_on_to_the_byte(settings, tmp_path, monkeypatch) -> None:
    averaged = replace(settings, ema=0.9)
    fit(replace(averaged, name="whole"), quiet)
    fit(replace(settings, name="plain"), quiet)
    whole, plain = (last(tmp_path / name) for name in ("whole", "plain"))
    assert all(torch.equal(whole[name], plain[name]) for name in whole)  # the training itself is the same
    kept = load_file(tmp_path / "whole" / "last" / "average.safetensors")
    assert not torch.equal(kept["project.0.weight"], whole["project.0.weight"])
    rows = [json.loads(line) for line in (tmp_path / "whole" / "metrics.jsonl").read_text().splitlines()]
    best = max(range(3), key=lambda k: (rows[k]["val/recall@1"], -k))
    shown = read_embedder(tmp_path / "whole")[0].state_dict()
    if best == 2:
        assert torch.equal(shown["project.0.weight"], kept["project.0.weight"])
    assert not torch.equal(shown["project.0.weight"], read_embedder(tmp_path / "plain")[0].state_dict()["project.0.weight"])
    cut(monkeypatch, replace(averaged, name="cut"), 3)
    for file in ("last/average.safetensors", "last/embedder.safetensors", "best/embedder.safetensors"):
        assert (tmp_path / "cut" / file).read_bytes() == (tmp_path / "whole" / file).read_bytes(), file
    with pytest.raises(InputError, match=r"resume=true goes on .*ema \(was 0.9, now 0.5\)"):
        fit(replace(averaged, name="whole", resume=True, ema=0.5), quiet)


@pytest.mark.longer
def test_the_best_epochs_are_kept(settings, tmp_path, monkeypatch) -> None:
    scores = iter([0.3, 0.5, 0.1, 0.4])
    real = EmbeddingJob.compute_scores
    monkeypatch.setattr(EmbeddingJob, "compute_scores", lambda self: real(self) | {"recall@1": next(scores)})
    fit(replace(settings, top=2, epochs=3), quiet)
    assert sorted(p.name for p in (tmp_path / "run" / "top").iterdir()) == ["epoch_001", "epoch_002"]
    fit(replace(settings, top=2, epochs=4, resume=True), quiet)
    assert sorted(p.name for p in (tmp_path / "run" / "top").iterdir()) == ["epoch_002", "epoch_004"]
    network, about = read_embedder(tmp_path / "run" / "top" / "epoch_004")
    assert about["val/recall@1"] == 0.4 and torch.equal(
        network.state_dict()["project.0.weight"], last(tmp_path / "run")["project.0.weight"]
    )
    assert rank_epochs([[0.5, 1], [0.4, 0]], 0.4, 2, 2) == [[0.5, 1], [0.4, 0]]


def test_a_trace_of_the_first_epoch(settings, tmp_path) -> None:
    fit(replace(settings, profile=True, epochs=2), quiet)
    trace = json.loads((tmp_path / "run" / "trace.json").read_text())
    names = {event.get("name", "") for event in trace["traceEvents"]}
    assert any("addmm" in name or "linear" in name for name in names)
    fit(replace(settings, overwrite=True, epochs=1), quiet)
    assert not (tmp_path / "run" / "trace.json").exists()


def test_a_trace_leaves_out_the_first_step_and_ends_after_five(tmp_path) -> None:
    tracer = StepTracer(tmp_path / "trace.json", 9)
    for step in range(9):
        tracer.begin_step()
        assert (tracer.profiler is not None) == (1 <= step < 6)
        torch.ones(2) + 1
    assert (tmp_path / "trace.json").is_file()
    only = StepTracer(tmp_path / "one.json", 1)
    only.begin_step()
    only.close()
    assert (tmp_path / "one.json").is_file()


def test_an_anomaly_is_named(settings, monkeypatch) -> None:
    zero = torch.zeros(1, requires_grad=True)
    where = r"^anomaly: the gradient of SqrtBackward, computed in test_instruments.py:\d+, is no number$"
    with pytest.raises(InputError, match=where), find_anomaly():
        (zero.sqrt() * 0).sum().backward()
    with pytest.raises(RuntimeError, match="size"), find_anomaly():
        torch.ones(2) @ torch.ones(3)
    real = embedding.Objective.forward
    monkeypatch.setattr(
        embedding.Objective,
        "forward",
        lambda self, *given: {name: value + (value.detach() - value).sqrt() for name, value in real(self, *given).items()},
    )
    with pytest.raises(InputError, match=r"^anomaly: the gradient of \w+, computed in losses.py:\d+, is no number$"):
        fit(replace(settings, anomaly=True), quiet)


@pytest.mark.longer
def test_the_scaler_of_half_precision_goes_on_to_the_byte(settings, tmp_path, monkeypatch) -> None:
    """As of fp16: a scale that overflows at first, and grows after three good steps."""
    from lightning_fabric import Fabric
    from lightning_fabric.plugins import MixedPrecision

    scalers = []

    def start(settings: Training) -> Fabric:
        plugin = MixedPrecision("bf16-mixed", "cpu")
        plugin.scaler = torch.amp.GradScaler("cpu", init_scale=2.0**127, backoff_factor=2.0**-64, growth_interval=3)
        scalers.append(plugin.scaler)
        return Fabric(accelerator="cpu", devices=1, plugins=[plugin])

    monkeypatch.setattr(embedding, "start_fabric", start)
    fit(replace(settings, name="whole"), quiet)
    assert scalers[0].get_scale() == 2.0**64  # lowered once, and doubled after three of the five steps left
    cut(monkeypatch, replace(settings, name="cut"), 3)
    assert scalers[2].state_dict() == scalers[0].state_dict()
    for file in ("last/embedder.safetensors", "best/embedder.safetensors", "last/optimizer.safetensors"):
        assert (tmp_path / "cut" / file).read_bytes() == (tmp_path / "whole" / file).read_bytes(), file


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"ema": 1.0}, "ema must be 0 or more and below 1"),
        ({"top": 0}, "top must be 1"),
        ({"logger": ["board"]}, "logger: unknown 'board'"),
    ],
)
def test_what_makes_no_sense_is_refused(settings, change, said) -> None:
    with pytest.raises(InputError, match=said):
        fit(replace(settings, **change), quiet)
