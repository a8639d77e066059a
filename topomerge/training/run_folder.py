"""A run is a folder: its settings, what it reports, the best weights, the state to go on from; and what it exports.

config.json, config.yaml     what was asked for
run.json                     where it comes from: `training.provenance`
metrics.jsonl, tb/           `training.log`
best/                        files as the package has them, and their card
last/                        `topomerge.checkpoint`, of networks
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

import topomerge
from topomerge.errors import InputError
from topomerge.io.atomic import replacing
from topomerge.networks import network as networks
from topomerge.training.provenance import RUN_FILE, describe_data, describe_provenance, record_start

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
        for name in ("best", "last", "last.new", "last.old", "tb"):
            shutil.rmtree(folder / name, ignore_errors=True)
        for name in ("metrics.jsonl", RUN_FILE):
            (folder / name).unlink(missing_ok=True)
    record_start(folder, asdict(settings), describe_data(settings), device, threads)
    write_settings(folder, {**asdict(settings), "resume": False, "overwrite": False})  # what another run may begin with


def write_settings(folder: Path, settings: Mapping[str, Any]) -> None:
    """Write config.json and config.yaml into a folder that is there."""
    import yaml

    texts = {"config.json": json.dumps(settings, indent=1) + "\n", "config.yaml": yaml.safe_dump(dict(settings), sort_keys=False)}
    for name, text in texts.items():
        with replacing(folder / name) as beside:
            beside.write_text(text, encoding="utf-8")


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
    keys = (f"{k}={v}" for k, v in settings.items() if isinstance(v, int | float | str) and k in ("seed", "epochs"))
    command = f"python train.py task={settings['task']} {' '.join(keys)} export=package".replace("  ", " ")
    card = {
        **(interface or {}),
        "task": settings["task"],
        "version": topomerge.__version__,
        "command": command,
        "settings": settings,
        "data": data,
        "provenance": describe_provenance(file.parent.parent),
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
            with replacing(folder / path.name) as beside:
                shutil.copyfile(path, beside)
    except OSError as error:
        raise InputError(f"export={target}: can't be written ({error.strerror or error})") from error
    return [folder / path.name for path in files]
