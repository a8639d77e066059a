"""Optional instruments of a training loop: loggers, an average of weights, the best checkpoints, a trace, a search for what is no
number."""

from __future__ import annotations

import csv
import hashlib
import importlib.util
import os
import re
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import torch
from lightning_fabric.loggers import Logger, TensorBoardLogger
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

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


AVERAGE_FILE = "average.safetensors"  # in `last/`
TRACE_FILE = "trace.json"
TOP = "top"  # folder of the best epochs
TRACED_STEPS = 5
EpochReport = Callable[[dict[str, Any]], None]
# What is told the row of each epoch besides the loggers; it may raise, which ends the run (`training.search`).
REPORT: ContextVar[EpochReport | None] = ContextVar("report", default=None)


class WeightAverage:
    """Exponential moving average of the weights and buffers of a network (Polyak & Juditsky 1992).

    The first steps count more: the decay is at most (1 + step) / (10 + step).

    Args:
        decay: of a step.
    """

    def __init__(self, network: torch.nn.Module, decay: float) -> None:
        self.decay = decay
        self.live = {name: tensor for name, tensor in network.state_dict().items() if tensor.is_floating_point()}
        self.kept = {name: tensor.detach().clone() for name, tensor in self.live.items()}

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Take in the weights after a step, the first of which is number 0."""
        share = 1 - min(self.decay, (1 + step) / (10 + step))
        torch._foreach_lerp_(list(self.kept.values()), list(self.live.values()), share)

    @contextmanager
    def apply(self) -> Iterator[None]:
        """Let the network have the average instead of its weights for a while."""
        before = {name: tensor.detach().clone() for name, tensor in self.live.items()}
        self._copy(self.kept, self.live)
        try:
            yield
        finally:
            self._copy(before, self.live)

    def load(self, path: Path) -> None:
        """Read an average that was kept.

        Raises:
            InputError: it is damaged, or of another network.
        """
        try:
            self._copy(load(path.read_bytes()), self.kept)
        except (KeyError, RuntimeError, OSError, ValueError, SafetensorError) as error:
            reason = " ".join(str(error).split())[:120]
            raise InputError(f"{path}: holds no average of this network ({reason}); start again without resume") from error

    @torch.no_grad()
    def _copy(self, source: dict[str, Tensor], target: dict[str, Tensor]) -> None:
        for name, tensor in target.items():
            tensor.copy_(source[name])


def rank_epochs(before: Sequence[Sequence[float]], score: float, epoch: int, count: int) -> list[list[float]]:
    """Return the best epochs so far, best first, as [score, epoch]; of equal ones the earlier."""
    return sorted([*(list(one) for one in before), [score, epoch]], key=lambda one: (-one[0], one[1]))[:count]


def name_top(folder: Path, epoch: int) -> Path:
    """Name the folder of an epoch that is one of the best."""
    return folder / TOP / f"epoch_{epoch + 1:03d}"


def tidy_top(folder: Path, ranked: Sequence[Sequence[float]]) -> None:
    """Delete the folders of epochs that are no longer among the best."""
    kept = {name_top(folder, int(epoch)) for _, epoch in ranked}
    for path in (folder / TOP).glob("epoch_*"):
        if path not in kept:
            shutil.rmtree(path)


class StepTracer:
    """Trace of a few steps of an epoch, the first one left out, for chrome://tracing or ui.perfetto.dev.

    Args:
        steps: of the epoch.
    """

    def __init__(self, path: Path, steps: int) -> None:
        self.path, self.first, self.done = path, min(1, steps - 1), 0
        self.profiler: Any = None

    def begin_step(self) -> None:
        """Begin with the trace, or end it, as it is time."""
        if self.done == self.first:
            kinds = torch.profiler.ProfilerActivity
            activities = [kinds.CPU, *([kinds.CUDA] if torch.cuda.is_available() else [])]
            os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # it prints errors where there is no card
            self.profiler = torch.profiler.profile(activities=activities)
            self.profiler.start()
        elif self.done == self.first + TRACED_STEPS:
            self.close()
        self.done += 1

    def close(self) -> None:
        """Write the trace, if it began."""
        if self.profiler is not None:
            self.profiler.stop()
            self.profiler.export_chrome_trace(str(self.path))
            self.profiler = None


@contextmanager
def find_anomaly() -> Iterator[None]:
    """Name the operation of a backward pass whose gradient is no number, and the line of its forward pass.

    Raises:
        InputError: such an operation.
    """
    with warnings.catch_warnings(record=True) as warned, torch.autograd.detect_anomaly(check_nan=True):
        warnings.simplefilter("always")
        try:
            yield
        except RuntimeError as error:
            found = re.match(r"Function '(\w+)' returned nan values", str(error))
            if not found:
                raise
            text = "\n".join(str(one.message) for one in warned)
            own = [where for where in re.findall(r'File "([^"]+)", line (\d+)', text) if "site-packages" not in where[0]]
            where = f", computed in {Path(own[-1][0]).name}:{own[-1][1]}," if own else ""
            raise InputError(f"anomaly: the gradient of {found[1].removesuffix('0')}{where} is no number") from error
