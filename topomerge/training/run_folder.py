"""A run is a folder: settings, metrics, best weights, state; and what a run logs."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Mapping
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

import topomerge
from topomerge.archive import replace_on_success
from topomerge.errors import InputError
from topomerge.networks import network as networks
from topomerge.registry import LOGGERS, NO_LOGGER
from topomerge.training.provenance import RUN_FILE, describe_data, describe_provenance, flatten_table, record_start

PACKAGE = "package"  # export: into the package itself


def begin_run(settings: Any, device: str = "cpu", threads: int = 1) -> None:
    """Write what a run begins with, or goes on with; what an earlier run left in the folder goes, unless it is this one.

    Args:
        device: that the network is on; threads: of it.

    Raises:
        InputError: the folder can't be written, or the data of a run that goes on is another.
    """
    folder: Path = settings.folder
    if not settings.resume:
        for name in ("best", "last", "last.new", "last.old", "top", "tb", "wandb"):
            shutil.rmtree(folder / name, ignore_errors=True)
        for name in ("metrics.jsonl", "metrics.csv", "trace.json", RUN_FILE):
            (folder / name).unlink(missing_ok=True)
    record_start(folder, asdict(settings), describe_data(settings), device, threads)
    write_settings(folder, {**asdict(settings), "resume": False, "overwrite": False})  # what another run may begin with


def write_settings(folder: Path, settings: Mapping[str, Any]) -> None:
    """Write config.json and config.yaml into a folder that is there."""
    import yaml

    texts = {"config.json": json.dumps(settings, indent=1) + "\n", "config.yaml": yaml.safe_dump(dict(settings), sort_keys=False)}
    for name, text in texts.items():
        with replace_on_success(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8")


def write_card(
    file: Path,
    settings: Mapping[str, Any],
    data: Mapping[str, Any],
    metrics: Mapping[str, Any],
    interface: Mapping[str, Any] | None = None,
) -> Path:
    """Write the card of a file of weights, which stands in `best/` of a run, beside it: what it is trained on, by which command
    and version, and how good it is.

    Args:
        settings: of the run.
        data: what was learned from: counts, names of sets.
        metrics: on what was held out of the training.
        interface: what a network does, its inputs and outputs (`networks.signature`).
    """
    run = next((folder for folder in file.parents[1:3] if (folder / RUN_FILE).is_file()), file.parent.parent)
    keys = (f"{k}={v}" for k, v in settings.items() if isinstance(v, int | float | str) and k in ("seed", "epochs"))
    command = f"python train.py task={settings['task']} {' '.join(keys)} export=package".replace("  ", " ")
    card = {
        **(interface or {}),
        "task": settings["task"],
        "version": topomerge.__version__,
        "command": command,
        "settings": settings,
        "data": data,
        "provenance": describe_provenance(run),
        "metrics": {k: round(v, 5) if isinstance(v, float) else v for k, v in metrics.items()},
    }
    return networks.write_card(file, card)


def export_files(best: Path, target: str, package: str) -> list[Path]:
    """Copy the best weights and their card to where they are read.

    Args:
        target: `PACKAGE`: into the package; else a folder, which TOPOMERGE_WEIGHTS can then name.
        package: that reads them.

    Raises:
        InputError: nothing was trained yet, or the folder can't be written.
    """
    folder = Path(str(resources.files(package))) if target == PACKAGE else Path(target)
    files = sorted(path for path in best.glob("*") if path.is_file())
    if not files:
        raise InputError(f"{best}: holds no weights to export")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path in files:
            with replace_on_success(folder / path.name) as temporary:
                shutil.copyfile(path, temporary)
    except OSError as error:
        raise InputError(f"export={target}: can't be written ({error.strerror or error})") from error
    return [folder / path.name for path in files]


class MetricsLog:
    """Metrics of a run: metrics.jsonl, and its loggers (`topomerge.registry.LOGGERS`).

    Args:
        settings: of the run.
        epoch: rows of this and later epochs, of a run that goes on, are dropped.
    """

    def __init__(self, settings: Any, epoch: int = 0) -> None:
        folder: Path = settings.folder
        self.path, self.rows = folder / "metrics.jsonl", list[dict[str, Any]]()
        if epoch and self.path.exists():
            rows = [json.loads(line) for line in self.path.read_text(encoding="utf-8").splitlines()]
            self.rows = [row for row in rows if row["epoch"] < epoch]
        self._write()
        flat = flatten_table(asdict(settings))
        self.loggers = [LOGGERS[name](folder, flat, epoch) for name in settings.logger if name != NO_LOGGER]
        for logger in self.loggers:
            logger.log_hyperparams(flat)

    @property
    def board(self) -> Any:
        """TensorBoard's writer, for pictures; None where nothing is logged there."""
        return next((one.experiment for one in self.loggers if hasattr(getattr(one, "experiment", None), "add_figure")), None)

    def append_row(self, values: Mapping[str, Any]) -> None:
        """Keep the metrics of an epoch."""
        self.rows.append(dict(values))
        self._write()
        numbers = {name: value for name, value in values.items() if isinstance(value, float) and np.isfinite(value)}
        for logger in self.loggers:
            logger.log_metrics(numbers, step=values["epoch"])
            logger.save()

    def _write(self) -> None:
        with replace_on_success(self.path) as temporary:
            temporary.write_text("".join(json.dumps(row) + "\n" for row in self.rows), encoding="utf-8")

    def close(self, status: str = "success") -> None:
        """Tell the loggers how the run ended."""
        for logger in self.loggers:
            logger.finalize(status)


class EtaClock:
    """Seconds since it was made, and how many are left at the pace so far."""

    def __init__(self, done: int, total: int) -> None:
        self.began, self.first, self.total = time.monotonic(), done, total

    def format_time_left(self, done: int) -> str:
        """Return hh:mm:ss that remain when `done` of the total are done."""
        pace = (time.monotonic() - self.began) / max(done - self.first, 1)
        return time.strftime("%H:%M:%S", time.gmtime(pace * (self.total - done)))
