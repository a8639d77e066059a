"""Loggers of runs, beside metrics.jsonl: TensorBoard, CSV, Weights & Biases and MLflow.

An entry of `topomerge.registry.LOGGERS` is called with the folder of a run, its settings as a flat table, and the epoch that
comes next. It returns a logger of Fabric (`lightning_fabric.loggers.Logger`). Each epoch is told by `log_metrics`, the end by
`finalize`.
"""

from __future__ import annotations

import csv
import hashlib
import importlib.util
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning_fabric.loggers import Logger, TensorBoardLogger

from topomerge.archive import replace_on_success
from topomerge.errors import InputError
from topomerge.training.run_folder import read_run

PROJECT = "topomerge"  # of W&B and MLflow, where the environment names no other
MODULES = {"tensorboard": ("tensorboard", "learn"), "wandb": ("wandb", "wandb"), "mlflow": ("mlflow", "mlflow")}
LONGEST_VALUE = 250  # characters of a setting


def check_installed(names: Sequence[str]) -> None:
    """Refuse loggers whose package is not installed.

    Raises:
        InputError: names the extra.
    """
    for name in names:
        module, extra = MODULES.get(name, ("", ""))
        spec = importlib.util.find_spec(module) if module else None
        if module and (spec is None or spec.origin is None):  # a folder of this name is no package
            raise InputError(f"logger={name} needs {module}: pip install topomerge[{extra}]")


class BoardLogger(TensorBoardLogger):
    """TensorBoard with settings in its table of hyperparameters, beside the last value of the score that is watched."""

    def log_hyperparams(self, params: Any, *_: Any, **__: Any) -> None:
        """Write the settings."""
        from torch.utils.tensorboard.summary import hparams

        values = {key: value if isinstance(value, bool | int | float | str) else str(value) for key, value in params.items()}
        writer = self.experiment._get_file_writer()  # type: ignore[no-untyped-call]
        for summary in hparams(values, {f"val/{params['watch']}": 0.0}):  # type: ignore[no-untyped-call]
            writer.add_summary(summary)


def build_board_logger(folder: Path, settings: Mapping[str, Any], epoch: int) -> BoardLogger:
    """Build the logger that writes `tb/`; what an earlier start wrote of this and later epochs is hidden."""
    return BoardLogger(folder, "tb", "", default_hp_metric=False, purge_step=epoch)


class CsvLogger(Logger):
    """Writes `metrics.csv`: an epoch a line, a column for each number."""

    def __init__(self, folder: Path, settings: Mapping[str, Any], epoch: int) -> None:
        self.path, self.rows = folder / "metrics.csv", list[dict[str, Any]]()
        if epoch and self.path.is_file():
            with self.path.open(encoding="utf-8", newline="") as file:
                self.rows = [row for row in csv.DictReader(file) if int(row["epoch"]) < epoch]

    @property
    def name(self) -> str:
        """Name the logger."""
        return "csv"

    @property
    def version(self) -> str:
        """Name no version."""
        return ""

    def log_hyperparams(self, params: Any, *_: Any, **__: Any) -> None:
        """Leave the settings to config.json."""

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Write the file with one more line."""
        self.rows.append({"epoch": step, **metrics})
        columns = list(dict.fromkeys(name for row in self.rows for name in row))
        with replace_on_success(self.path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            writer.writerows(self.rows)


def identify_run(folder: Path) -> str:
    """Return what tells a run from others, also from one that it replaced in its folder; it stays when the run goes on."""
    starts = read_run(folder).get("starts", [])
    began = starts[0]["began"] if starts else ""
    return hashlib.sha256(f"{folder.resolve()} {began}".encode()).hexdigest()[:16]


class WandbLogger(Logger):
    """Weights & Biases, in the run's folder `wandb/` where the machine is not logged in: `wandb sync` sends it later."""

    def __init__(self, folder: Path, settings: Mapping[str, Any], epoch: int) -> None:
        import wandb

        mode: Any = os.environ.get("WANDB_MODE") or ("online" if wandb.login(prompt=False) else "offline")
        self.run = wandb.init(
            dir=folder, project=os.environ.get("WANDB_PROJECT", PROJECT), name=str(settings["name"]), id=identify_run(folder),
            resume="allow" if mode == "online" else None, mode=mode, settings=wandb.Settings(silent=True, console="off"),
        )  # fmt: skip

    @property
    def name(self) -> str:
        """Name the project."""
        return str(self.run.project)

    @property
    def version(self) -> str:
        """Return the run's mark."""
        return str(self.run.id)

    def log_hyperparams(self, params: Any, *_: Any, **__: Any) -> None:
        """Send the settings."""
        self.run.config.update(dict(params), allow_val_change=True)

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Send an epoch."""
        self.run.log(dict(metrics), step=step)

    def finalize(self, status: str) -> None:
        """End the run."""
        self.run.finish(exit_code=0 if status == "success" else 1)


class MlflowLogger(Logger):
    """MLflow, in files below `<runs>/mlruns`, or where MLFLOW_TRACKING_URI says."""

    def __init__(self, folder: Path, settings: Mapping[str, Any], epoch: int) -> None:
        os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")  # else MLflow 3.7 refuses files
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        from mlflow import MlflowClient

        where = os.environ.get("MLFLOW_TRACKING_URI") or (Path(str(settings["runs"])) / "mlruns").resolve().as_uri()
        self.client, self.project = MlflowClient(where), os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT)
        experiment = self.client.get_experiment_by_name(self.project)
        number = self.client.create_experiment(self.project) if experiment is None else experiment.experiment_id
        mark = identify_run(folder)
        before = self.client.search_runs([number], filter_string=f"tags.topomerge = '{mark}'", max_results=1)
        tags = {"topomerge": mark}
        self.run = before[0] if before else self.client.create_run(number, tags=tags, run_name=str(settings["name"]))
        self.is_new = not before

    @property
    def name(self) -> str:
        """Name the experiment."""
        return self.project

    @property
    def version(self) -> str:
        """Return the run's mark."""
        return str(self.run.info.run_id)

    def log_hyperparams(self, params: Any, *_: Any, **__: Any) -> None:
        """Write the settings, once: MLflow lets none change."""
        for key, value in params.items() if self.is_new else ():
            self.client.log_param(self.version, key, str(value)[:LONGEST_VALUE])

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Write an epoch; names may hold no @."""
        for key, value in metrics.items():
            self.client.log_metric(self.version, key.replace("@", "_at_"), value, step=step)

    def finalize(self, status: str) -> None:
        """End the run."""
        self.client.set_terminated(self.version, "FINISHED" if status == "success" else "KILLED")
