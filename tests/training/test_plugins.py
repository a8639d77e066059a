"""What somebody else adds in a file of their own: it trains by train.py, is exported, loads without that file, and merges."""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.speed.researcher import OWN_CONFIGS, OWN_PARTS
from tests.forked import run_words
from tests.graphs import write_set
from tests.scenes_map import building
from topomerge.config import find_plugins
from topomerge.embedding.learned import load_embedder
from topomerge.errors import InputError
from topomerge.networks.network import Signature, Tensor, load_network
from topomerge.registry import DATASETS, LOSSES, NODES, Registry
from topomerge.training.embedding import EmbeddingJob
from topomerge.training.tasks import compose_settings

ROOT = Path(__file__).parent.parent.parent
OPTIMIZER = """
import torch
from topomerge.registry import OPTIMIZERS, SCHEDULES

@OPTIMIZERS.register("sign")
class SignDescent(torch.optim.Optimizer):
    def __init__(self, params, lr=1e-3, momentum=0.0):
        super().__init__(params, {"lr": lr, "momentum": momentum})

    @torch.no_grad()
    def step(self, closure=None):
        for group in self.param_groups:
            for p in group["params"]:
                if p.grad is not None:
                    kept = self.state[p].setdefault("kept", torch.zeros_like(p))
                    kept.mul_(group["momentum"]).add_(p.grad)
                    p.sub_(group["lr"] * kept.sign())

@SCHEDULES.register("steps")
def fall_in_steps(done, warmup):
    return 0.5 ** int(4 * done)
"""
TASK = '''
from dataclasses import dataclass

import numpy as np
import torch

from topomerge.networks.network import Signature, Tensor, load_network
from topomerge.registry import TASKS
from topomerge.training.loop import Exported, ExportedJob, run_network
from topomerge.training.settings import NetworkTask
from topomerge.training.tasks import Task

SIGNATURE = Signature("Area.", {"sides": Tensor(("n", 2), "log m")}, {"area": Tensor(("n", 1), "log m2")})

@dataclass
class Area(NetworkTask):
    task: str = "area"
    name: str = "area"
    steps: int = 5
    warmup: int = 1
    watch: str = "error"

class AreaJob(ExportedJob):
    """Area of a rectangle out of its sides, as logarithms."""

    def iter_batches(self, state):
        rng = np.random.default_rng([self.settings.seed, state.epoch])
        for sides in rng.random((self.settings.steps, self.settings.batch, 2), np.float32)[state.step:]:
            yield torch.from_numpy(sides)

    def train_step(self, batch, state):
        return self.optimize(((self.network(batch)[:, 0] - batch.sum(dim=1)) ** 2).mean(), self.settings, state)

    def count_items(self, batch):
        return len(batch)

    def compute_scores(self):
        with torch.no_grad():
            return {"error": float((self.network(torch.ones(1, 2)) - 2).abs())}

    def exported(self):
        return Exported(self.network, SIGNATURE, [torch.ones(3, 2)])

def fit(settings, log_line):
    torch.manual_seed(settings.seed)
    return run_network(AreaJob(settings, torch.nn.Linear(2, 1), {"set": "none"}), settings, settings.steps, log_line)

def judge(settings, file, log_line):
    (area,) = load_network(file, SIGNATURE)(sides=np.ones((1, 2), np.float32))
    return {"error": abs(float(area[0, 0]) - 2)}

TASKS.register("area")(Task(Area, fit, ("error",), judge, file="area.onnx", lower=("error",)))
'''
TASK_YAML = """# @package _global_
defaults:
  - area_schema
  - _self_

epochs: 4
"""


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a script of this repository in a folder."""
    return run_words([ROOT / words[0], *words[1:]], folder)


@pytest.mark.longer
def test_encoder_loss_optimizer_and_schedule_train_export_load_and_merge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.py").write_text(OWN_PARTS + OPTIMIZER)
    (tmp_path / "configs" / "loss").mkdir(parents=True)
    (tmp_path / "configs" / "loss" / "alignment.yaml").write_text(OWN_CONFIGS["loss/alignment.yaml"])
    write_set(tmp_path / "cache", "some", 8)
    words = ["plugins=[mine]", "loss=alignment", "network.node.kind=transformer", "optimizer=sign", "schedule=steps"]
    words += ["optimizer_options.momentum=0.5", "rate=0.001", "data=procedural", "validation=", "epochs=2", "batch=2"]
    shutil.copy(tmp_path / "cache" / "some.jsonl", tmp_path / "cache" / "procedural.jsonl")
    done = run(tmp_path, "train.py", *words, "logger=none", "name=x")
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in (tmp_path / "runs" / "x" / "metrics.jsonl").read_text().splitlines()]
    assert len(rows) == 2 and rows[1]["train/alignment"] < rows[0]["train/alignment"]
    ours = load_embedder(tmp_path / "runs" / "x")  # without the plugin
    assert ours.network.node.kind == "transformer" and "transformer" not in NODES and "alignment" not in LOSSES
    import topomerge as tm

    maps = [building(2, origin=(x, -3.0, 0.5)) for x in (2.0, 4.0)]
    result = tm.merge(maps, embedder=ours)
    assert len(result.maps) == 2 and len(ours(maps[0])) == len(maps[0].rooms)
    monkeypatch.setattr(EmbeddingJob, "export_best", lambda self, folder: None)  # in the forks, too: it was exported above
    again = run(tmp_path, "train.py", *words, "logger=none", "name=x", "resume=true", "epochs=3")
    assert again.returncode == 0, again.stderr
    table = run(tmp_path, "train.py", "-m", *words, "logger=none", "epochs=1", "network.node.layers=1", "runs=swept")
    assert table.returncode == 0, table.stderr
    assert (tmp_path / "swept" / "sweep" / "table.md").read_text().count("| transformer ") == 1


@pytest.mark.longer
def test_a_task_of_somebody_else_trains_and_is_judged(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(TASK)
    (tmp_path / "configs" / "task").mkdir(parents=True)
    (tmp_path / "configs" / "task" / "area.yaml").write_text(TASK_YAML)
    words = ["plugins=[mine]", "task=area", "rate=0.1"]
    done = run(tmp_path, "train.py", *words, "logger=none")
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in (tmp_path / "runs" / "area" / "metrics.jsonl").read_text().splitlines()]
    best = min(row["val/error"] for row in rows)  # less is better
    card = json.loads((tmp_path / "runs" / "area" / "best" / "area.card.json").read_text())
    assert len(rows) == 4 and card["metrics"]["val/error"] == pytest.approx(best, abs=1e-5) and card["task"] == "area"
    signature = Signature("Area.", {"sides": Tensor(("n", 2), "log m")}, {"area": Tensor(("n", 1), "log m2")})
    (area,) = load_network(tmp_path / "runs" / "area" / "best" / "area.onnx", signature)(sides=np.ones((1, 2), np.float32))
    assert abs(float(area[0, 0]) - 2) == pytest.approx(best, abs=1e-4)
    judged = run(tmp_path, "evaluate.py", "plugins=[mine]", "task=area", "run=runs/area")
    assert judged.returncode == 0 and f"| error | {best:.3f} |" in judged.stdout, judged.stderr


@pytest.mark.parametrize(
    ("text", "words", "said"),
    [
        ("", ["loss.kind=nothing"], "loss.kind: unknown 'nothing'; infonce, ntxent, triplet are possible"),
        ("", ["optimizer=nothing"], "optimizer: unknown 'nothing'; adamw, sgd are possible"),
        ("", ["schedule=nothing"], "schedule: unknown 'nothing'; cosine, constant are possible"),
        ("", ["task=nothing"], "task: unknown 'nothing'; plan_segmentation, "),
        ("import nothing_like_this", [], "plugins=mine: cannot be imported (ModuleNotFoundError: No module named 'nothing"),
        ("1 +", [], "plugins=mine: cannot be imported (SyntaxError: "),
        ("from topomerge.registry import LOSSES\nLOSSES.register('triplet')(print)", [],
         "plugins=mine: loss.kind: 'triplet' is registered twice; give yours another name"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line(
    text: str, words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    importlib.invalidate_caches()
    (tmp_path / "mine.py").write_text(text)
    with pytest.raises(InputError) as refused:
        compose_settings(["plugins=[mine]", "data=procedural", *words])
    assert str(refused.value).startswith(said) and "\n" not in str(refused.value)
    sys.modules.pop("mine", None)


def test_the_script_ends_with_that_line(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("import nothing_like_this")
    done = run(tmp_path, "train.py", "plugins=[mine]", "data=procedural")
    assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("train: plugins=mine: cannot be imported (ModuleNotFoundError: No module named 'nothing")


def test_a_plugin_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = list(sys.path)
    with pytest.raises(InputError, match=r"^plugins=no_such: cannot be imported \(ModuleNotFoundError: [^\n]*$"):
        find_plugins(["plugins=[no_such]"])
    assert sys.path == path
    assert find_plugins(["epochs=2"]) == ["epochs=2"]


def test_a_registry_knows_what_packages_announce(monkeypatch: pytest.MonkeyPatch) -> None:
    announced = [
        importlib.metadata.EntryPoint("root", "math:sqrt", "topomerge.tests"),
        importlib.metadata.EntryPoint("broken", "math:no_such", "topomerge.tests"),
    ]
    monkeypatch.setattr("topomerge.registry.list_announced", lambda group: announced if group == "topomerge.tests" else [])
    registry = Registry("key", "tests", shipped="math:floor")
    assert list(registry) == ["shipped", "root", "broken"] and len(registry) == 3
    assert registry["root"](4.0) == 2 and registry["shipped"](2.5) == 2
    with pytest.raises(InputError, match=r"^key=broken: math:no_such cannot be imported \(AttributeError: [^\n]*$"):
        registry["broken"]
    with pytest.raises(InputError, match=r"^key: unknown 'none'; shipped, root, broken are possible"):
        registry["none"]
    with pytest.raises(InputError, match="'root' is registered twice"):
        registry.register("root")(abs)

    def own() -> None:
        """Is registered once more when its module is."""

    registry.register("own")(own)
    assert registry.register("own")(own) is own is registry["own"]


def test_a_set_of_somebody_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from topomerge.datasets.pairs.pairs_file import read_pairs_file

    def list_twins(folder: Path) -> dict[str, object]:
        files = sorted(folder.glob("*.ply"))
        return {"captures": [{"name": p.stem, "file": p.name, "building": p.stem[:-1], "frame": "one"} for p in files]}

    monkeypatch.setitem(DATASETS._registered, "twins", list_twins)
    for name in ("h1a", "h1b", "h2a", "h2b"):
        (tmp_path / f"{name}.ply").write_text("")
    assert [(p.a, p.b) for p in read_pairs_file(tmp_path, "twins").pairs] == [("h1a", "h1b"), ("h2a", "h2b")]
    monkeypatch.setitem(DATASETS._registered, "twins", lambda folder: {"captured": []})
    with pytest.raises(InputError, match=r"data=twins\): unknown key 'captured'|data=twins\)[^\n]*captured"):
        read_pairs_file(tmp_path, "twins")
