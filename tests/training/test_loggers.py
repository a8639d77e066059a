"""Loggers of runs: each tells every epoch, goes on where the run does, and names its extra where it is not installed."""

from __future__ import annotations

import csv
import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.training import tiny
from topomerge.errors import InputError
from topomerge.registry import LOGGERS
from topomerge.training import door_classification
from topomerge.training.run_folder import MetricsLog
from topomerge.training.tasks import bracket_lists, check_start, compose_settings, train


def quiet(text: str) -> None:
    """Say nothing."""


@pytest.fixture
def words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A training of a second."""
    monkeypatch.setattr(door_classification, "build_door_examples", lambda *_: tiny.door_tables(320))
    return ["task=door_classification", f"runs={tmp_path}", "name=x", "epochs=2", "batch=64", "hidden=4", "networks=2"]


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.longer
def test_loggers_tell_every_epoch_once(words, tmp_path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    train(compose_settings([*words, "logger=tensorboard,csv"]), quiet)
    train(compose_settings([*words, "logger=[tensorboard,csv]", "resume=true", "epochs=3"]), quiet)
    rows = [json.loads(line) for line in (tmp_path / "x" / "metrics.jsonl").read_text().splitlines()]
    told = read_csv(tmp_path / "x" / "metrics.csv")
    assert [row["epoch"] for row in told] == ["0", "1", "2"]
    board = EventAccumulator(str(tmp_path / "x" / "tb")).Reload()
    for name in ("train/rate", "train/norm", "train/loss", "val/log_loss", "val/auc"):
        assert [float(row[name]) for row in told] == [row[name] for row in rows]
        points = board.Scalars(name)
        assert [p.step for p in points] == [0, 1, 2] and [p.value for p in points] == pytest.approx([r[name] for r in rows])
    assert rows[0]["train/rate"] > rows[2]["train/rate"] > 0
    plugin = board.SummaryMetadata("_hparams_/session_start_info").plugin_data
    assert plugin.plugin_name == "hparams" and b"optimizer" in plugin.content and b"adamw" in plugin.content
    train(compose_settings([*words, "logger=none", "overwrite=true"]), quiet)
    assert not (tmp_path / "x" / "metrics.csv").exists() and not (tmp_path / "x" / "tb").exists()


def test_a_logger_of_somebody_else(words, tmp_path, monkeypatch) -> None:
    told: list[tuple[str, object]] = []

    class Teller:
        def __init__(self, folder: Path, settings: dict[str, object], epoch: int) -> None:
            told.append(("begin", (folder.name, epoch)))

        def log_hyperparams(self, params: dict[str, object]) -> None:
            told.append(("settings", params["hidden"]))

        def log_metrics(self, metrics: dict[str, float], step: int) -> None:
            told.append(("epoch", step))

        def save(self) -> None:
            """Do nothing."""

        def finalize(self, status: str) -> None:
            told.append(("end", status))

    monkeypatch.setitem(LOGGERS._registered, "teller", Teller)
    train(compose_settings([*words, "logger=teller"]), quiet)
    expected = [("begin", ("x", 0)), ("settings", 4), ("epoch", 0), ("epoch", 1), ("end", "success")]
    assert told == expected
    monkeypatch.setattr(door_classification.DoorJob, "compute_scores", lambda self: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        train(compose_settings([*words, "logger=teller", "overwrite=true"]), quiet)
    assert told[-1] == ("end", "aborted")


@pytest.mark.parametrize("name", ["wandb", "mlflow", "tensorboard"])
def test_a_package_that_is_not_installed(words, tmp_path, monkeypatch, name) -> None:
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda module, *more: None if module == name else real(module, *more))
    extra = "learn" if name == "tensorboard" else name
    with pytest.raises(InputError, match=rf"^logger={name} needs {name}: pip install topomerge\[{extra}\]$"):
        check_start(compose_settings([*words, f"logger={name}"]))
    monkeypatch.setattr(importlib.util, "find_spec", real)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "not_there").mkdir()  # as `wandb/` beside a run is
    assert importlib.util.find_spec("not_there").origin is None and "not_there" not in sys.modules


@pytest.mark.longer
def test_weights_and_biases_without_a_login(words, tmp_path, monkeypatch) -> None:
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    train(compose_settings([*words, "logger=wandb"]), quiet)
    wandb.teardown()  # it writes what it holds back
    (log,) = (tmp_path / "x" / "wandb").glob("offline-run-*/run-*.wandb")
    content = log.read_bytes()
    assert b"train/rate" in content and b"val/auc" in content and b"hold_out" in content


@pytest.mark.longer
def test_mlflow_writes_files(words, tmp_path) -> None:
    pytest.importorskip("mlflow")
    train(compose_settings([*words, "logger=mlflow"]), quiet)
    train(compose_settings([*words, "logger=mlflow", "resume=true", "epochs=3"]), quiet)
    (metric,) = (tmp_path / "mlruns").glob("*/*/metrics/val/auc")  # one run
    rows = [json.loads(line) for line in (tmp_path / "x" / "metrics.jsonl").read_text().splitlines()]
    assert [float(line.split()[1]) for line in metric.read_text().splitlines()] == pytest.approx([r["val/auc"] for r in rows])
    assert (metric.parent.parent.parent / "params" / "hidden").read_text() == "4"
    settings = compose_settings([*words, "logger=mlflow", "overwrite=true"])
    (tmp_path / "y").mkdir()
    log = MetricsLog(replace(settings, name="y"))
    log.append_row({"epoch": 0, "val/recall@1": 0.5})
    log.close()
    assert len(list((tmp_path / "mlruns").glob("*/*/metrics/val/recall_at_1"))) == 1


def test_lists_may_be_one_word() -> None:
    assert bracket_lists(["logger=csv", "plugins=[a,b]", "name=csv", "logger="]) == [
        "logger=[csv]",
        "plugins=[a,b]",
        "name=csv",
        "logger=",
    ]
