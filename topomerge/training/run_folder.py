"""A run is a folder: settings, metrics, best weights, state, what a run logs, and where it comes from (`run.json`)."""

from __future__ import annotations

import hashlib
import json
import platform
import shutil
import time
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from importlib import resources
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

import topomerge
from topomerge.archive import convert_to_plain, replace_on_success
from topomerge.code_digest import read_commit
from topomerge.config import read_command
from topomerge.errors import InputError
from topomerge.networks import network as networks
from topomerge.progress import Stopwatch
from topomerge.registry import LOGGERS, NO_LOGGER

RUN_FILE, CONFIG_FILE, RUN_FORMAT = "run.json", "config.json", 1
PACKAGES = ("torch", "torch-geometric", "numpy", "topomerge")
# Keys that a run may go on with other values of: how long, where and by how many workers it trains, and what it tells.
MAY_CHANGE = {"epochs", "patience", "accelerator", "precision", "batches", "graphs", "threads", "jobs", "cluster", "cache"}
MAY_CHANGE |= {"name", "runs", "logger", "export", "resume", "overwrite", "top", "profile", "anomaly", "compile"}
# Keys that follow from the `path` of one's own captures; `record_start` compares what the sets hold.
OWN_SETS = {"data", "data.name", "heldout.name", "validation"}
UNTOLD = {"name", "runs", "resume", "overwrite"}  # of them


def compare_settings(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Return the keys that differ, such as ``loss.kind``, with both values. A key that one of both lacks counts for nothing: it
    is of another version."""
    first, second = flatten_table(before), flatten_table(json.loads(json.dumps(convert_to_plain(dict(now)))))
    return {key: [first[key], second[key]] for key in first if second.get(key, first[key]) != first[key]}


def flatten_table(table: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Return the values of a table within tables by keys such as ``loss.kind``."""
    out: dict[str, Any] = {}
    for key, value in table.items():
        out |= flatten_table(value, f"{above}{key}.") if isinstance(value, Mapping) else {f"{above}{key}": value}
    return out


def check_folder(folder: Path, settings: Mapping[str, Any]) -> None:
    """Refuse a folder that holds another run, or this one with other settings; make it where it is missing.

    Raises:
        InputError: such a folder, or one that can't be written.
    """
    if settings["resume"]:
        differing = {k: v for k, v in _find_changes(folder, settings).items() if k.split(".")[0] not in MAY_CHANGE}
        if differing:
            keys = ", ".join(f"{key} (was {was!r}, now {now!r})" for key, (was, now) in differing.items())
            raise InputError(f"{folder}: resume=true goes on with the settings of the run, but others are given: {keys}")
        return
    metrics = folder / "metrics.jsonl"
    holds = (folder / "last").exists() or (folder / "best").exists() or (metrics.is_file() and metrics.stat().st_size > 0)
    if holds and not settings["overwrite"]:
        raise InputError(f"{folder}: holds a run; resume=true goes on with it, overwrite=true replaces it, or give another name=")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: can't be written ({error.strerror or error})") from error


def _find_changes(folder: Path, settings: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Find the settings that differ from those in the folder of a run."""
    try:
        before = json.loads((folder / CONFIG_FILE).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}  # `load_state` says that there is nothing
    except (OSError, ValueError) as error:
        raise InputError(f"{folder / CONFIG_FILE}: can't be read ({' '.join(str(error).split())[:80]}); start anew") from error
    differing = compare_settings(before, settings)
    return {key: values for key, values in differing.items() if not (settings.get("path") and key in OWN_SETS)}


def record_start(folder: Path, settings: Mapping[str, Any], data: Mapping[str, Any], device: str, threads: int) -> None:
    """Write a start of a run, or that it goes on, into its `run.json`; before `config.json` is written.

    Args:
        data: as of `describe_data`.
        device: that the network is on; threads: of it.

    Raises:
        InputError: the run goes on, and its data is another.
    """
    earlier = read_run(folder) if settings["resume"] else {}
    for name, of in earlier.get("data", {}).items():
        now = data.get(name, of)
        if of["sha256"] and now["sha256"] and of["sha256"] != now["sha256"]:
            raise InputError(f"{folder}: {name}={now['name']} holds other pairs than when the run began; start anew")
    changes = _find_changes(folder, settings) if settings["resume"] else {}
    start = {
        "began": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "command": read_command(),
        **dict(zip(("commit", "changed_sources"), read_commit(), strict=True)),
        "versions": {"python": platform.python_version(), **{name: _get_version(name) for name in PACKAGES}},
        "seed": settings["seed"],
        "threads": threads,
        "device": device,
        "resumed": bool(settings["resume"]),
        "changed": {key: values for key, values in changes.items() if key not in UNTOLD},
    }
    record = {"format": RUN_FORMAT, "data": earlier.get("data") or dict(data), "starts": [*earlier.get("starts", []), start]}
    with replace_on_success(folder / RUN_FILE) as temporary:
        temporary.write_text(json.dumps(convert_to_plain(record), indent=1) + "\n", encoding="utf-8")


def _get_version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def read_run(folder: Path) -> dict[str, Any]:
    """Read `run.json`; return nothing where there is none, as in runs of earlier versions.

    Raises:
        InputError: it is damaged.
    """
    path = folder / RUN_FILE
    if not path.is_file():
        return {}
    try:
        record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return {"data": dict(record["data"]), "starts": list(record["starts"])}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: damaged ({' '.join(str(error).split())[:80]}); start the run anew") from error


def describe_provenance(folder: Path) -> dict[str, Any]:
    """Describe the run in a folder for a card: all but times, so that the same training gives the same card."""
    run = read_run(folder)
    return {**run, "starts": [{k: v for k, v in start.items() if k != "began"} for start in run["starts"]]} if run else {}


def describe_data(settings: Any) -> dict[str, Any]:
    """Describe, of each set that a task learns from or watches, its name, its recipe where that is known, and a digest of its
    manifest, which names every file by a hash of what it was made from."""
    out = {}
    sets = ("data", "validation", *(["replay_data"] if getattr(settings, "replay", 0) else []))
    for key, value in vars(settings).items():
        named = value.name if is_dataclass(value) and hasattr(value, "name") else value if key in sets else ""
        if not named or "heldout" in key:
            continue
        path = Path(named) if Path(named).suffix in (".jsonl", ".npz") else Path(settings.cache) / f"{named}.jsonl"
        recipe = asdict(value) if is_dataclass(value) and not isinstance(value, type) else _read_recipe(path)
        digest = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
        out[key] = {"name": str(named), "recipe": recipe, "sha256": digest}
    return out


def _read_recipe(manifest: Path) -> Any:
    """Read the recipe that `pairs.build` wrote beside a manifest; None where it did not."""
    path = manifest.with_suffix(".recipe.json")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


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
        interface: what a network does, its inputs and outputs (`networks.network.Signature`).
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
        self.watch, self.first, self.total = Stopwatch(), done, total

    def format_time_left(self, done: int) -> str:
        """Return hh:mm:ss that remain when `done` of the total are done."""
        seconds_each = self.watch.elapsed / max(done - self.first, 1)
        return time.strftime("%H:%M:%S", time.gmtime(seconds_each * (self.total - done)))
