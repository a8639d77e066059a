"""An embedder on disk: `embedder.safetensors` and `embedder.json`. Nothing in them is ever run.

{"format": 1, "class": "topomerge.models.Embedder", "network": {…}, "sha256": of the weights' file, "about": {…}}
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from topomerge.models.config import network_from
from topomerge.models.embedder import Embedder

from topomerge.errors import InputError
from topomerge.io.atomic import replacing

FORMAT = 1
CLASS = "topomerge.models.Embedder"
WEIGHTS, SETTINGS = "embedder.safetensors", "embedder.json"


def save_embedder(network: Embedder, folder: str | Path, about: Mapping[str, Any] | None = None) -> None:
    """Write both files into a folder, which is made if need be.

    Args:
        about: what else should be known: on what it was trained, how good it is.

    Raises:
        InputError: the folder can't be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: can't be written ({error.strerror or error})") from error
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    weights = save(state)
    told = {
        "format": FORMAT,
        "class": CLASS,
        "network": asdict(network.network),
        "sha256": hashlib.sha256(weights).hexdigest(),
        "about": dict(about or {}),
    }
    with replacing(folder / WEIGHTS) as beside:
        beside.write_bytes(weights)
    with replacing(folder / SETTINGS) as beside:
        beside.write_text(json.dumps(told, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_embedder(folder: str | Path) -> tuple[Embedder, dict[str, Any]]:
    """The network, ready to use, and what is told about it.

    Args:
        folder: one that `save_embedder` wrote, or a run, whose best embedder is taken.

    Raises:
        InputError: no such files, or damaged, of another format or class.
    """
    folder = Path(folder)
    if folder.name in (WEIGHTS, SETTINGS):
        folder = folder.parent
    if not (folder / SETTINGS).exists() and (folder / "best" / SETTINGS).exists():
        folder = folder / "best"
    told = _settings(folder / SETTINGS)
    try:
        weights = (folder / WEIGHTS).read_bytes()
    except OSError as error:
        raise InputError(f"{folder / WEIGHTS}: {error.strerror or error}; copy both files of an embedder") from error
    if hashlib.sha256(weights).hexdigest() != told["sha256"]:
        raise InputError(f"{folder / WEIGHTS}: cut off, damaged, or not the weights that {SETTINGS} is about; copy both again")
    try:
        network = Embedder(network_from(told["network"]))
    except InputError as error:
        raise InputError(f"{folder / SETTINGS}: {str(error)[:300]}; export it again") from error
    try:
        state = load(weights)
        network.load_state_dict(state)
    except (SafetensorError, RuntimeError, KeyError) as error:
        reason = " ".join(str(error).split())[:160]
        raise InputError(f"{folder / WEIGHTS}: does not fit its {SETTINGS} ({reason})") from error
    if not all(bool(torch.isfinite(value).all()) for value in state.values()):
        raise InputError(f"{folder / WEIGHTS}: has weights that are no finite numbers; training diverged, take another run")
    return network.eval(), dict(told["about"])


def _settings(path: Path) -> dict[str, Any]:
    """The JSON file, if it is of this format and class."""
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}; give a run's folder, or one of export-embedder") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: damaged or cut off ({' '.join(str(error).split())[:80]})") from error
    if not isinstance(told, dict) or told.get("class") != CLASS:
        found = told.get("class") if isinstance(told, dict) else None
        raise InputError(f"{path}: is of class {str(found)[:60]!r}, not {CLASS}")
    if told.get("format") != FORMAT:
        raise InputError(f"{path}: has format {told.get('format')!r}, this program reads {FORMAT}; export it again")
    if not all(isinstance(told.get(key), kind) for key, kind in (("network", dict), ("sha256", str), ("about", dict))):
        raise InputError(f"{path}: lacks network, sha256 or about; export it again")
    return told
