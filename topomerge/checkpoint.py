"""State of a training on disk: what it takes to go on as if nothing had been, without unpickling anything.

A folder: the embedder (`models.weights`), `optimizer.safetensors` and, written last, `state.json`:

    {"format": 2, "class": "topomerge.training", "sha256": {file: …}, "progress": {…}}
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load, save
from torch import Tensor

from topomerge.embedding.weights import SETTINGS_FILE, WEIGHTS_FILE
from topomerge.errors import InputError
from topomerge.models.embedder import Embedder
from topomerge.models.weights import save_embedder

STATE_FORMAT = 2
STATE_CLASS = "topomerge.training"
OPTIMIZER_FILE, STATE_FILE = "optimizer.safetensors", "state.json"


def save_state(
    folder: str | Path,
    network: Embedder,
    optimizer: torch.optim.Optimizer,
    progress: Mapping[str, Any],
    about: Mapping[str, Any],
) -> None:
    """Replace a folder by the state as it is; a kill in between leaves the old one, or the new one beside it.

    Args:
        progress: what else is needed to go on, as JSON has it.
        about: of the embedder.
    """
    folder = Path(folder)
    new, old = folder.with_name(f"{folder.name}.new"), folder.with_name(f"{folder.name}.old")
    for stale in (new, old):
        shutil.rmtree(stale, ignore_errors=True)
    save_embedder(network, new, about)
    (new / OPTIMIZER_FILE).write_bytes(save(_flat(optimizer)))
    digests = {name: _digest(new / name) for name in (WEIGHTS_FILE, SETTINGS_FILE, OPTIMIZER_FILE)}
    state = {"format": STATE_FORMAT, "class": STATE_CLASS, "sha256": digests, "progress": dict(progress)}
    (new / STATE_FILE).write_text(json.dumps(state, indent=1) + "\n", encoding="utf-8")
    if folder.exists():
        folder.rename(old)
    new.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def load_state(folder: str | Path, network: Embedder, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Put the state into a network and its optimizer; `progress` comes back.

    Raises:
        InputError: no such folder, damaged, of another format, class or network.
    """
    folder = Path(folder)
    if not folder.exists() and (newer := folder.with_name(f"{folder.name}.new")).joinpath(STATE_FILE).exists():
        folder = newer  # killed between two renames
    try:
        state = json.loads((folder / STATE_FILE).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{folder / STATE_FILE}: {error.strerror or error}; there is nothing to resume") from error
    except ValueError as error:
        raise InputError(f"{folder / STATE_FILE}: damaged or cut off ({' '.join(str(error).split())[:80]})") from error
    if not isinstance(state, dict) or state.get("class") != STATE_CLASS:
        raise InputError(f"{folder / STATE_FILE}: is no state of a training")
    if state.get("format") != STATE_FORMAT:
        raise InputError(
            f"{folder / STATE_FILE}: has format {state.get('format')!r}, this program reads {STATE_FORMAT}; start again"
        )
    for name in (WEIGHTS_FILE, SETTINGS_FILE, OPTIMIZER_FILE):
        if not (folder / name).exists() or _digest(folder / name) != state["sha256"].get(name):
            raise InputError(f"{folder / name}: missing, cut off, or not of this state; start again without resume")
    try:
        network.load_state_dict(load((folder / WEIGHTS_FILE).read_bytes()))
        _fill(optimizer, load((folder / OPTIMIZER_FILE).read_bytes()))
    except (RuntimeError, KeyError, ValueError) as error:
        reason = " ".join(str(error).split())[:160]
        raise InputError(f"{folder}: is of another network than the one configured ({reason})") from error
    progress: dict[str, Any] = state["progress"]
    return progress


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _flat(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    state = optimizer.state_dict()["state"]
    return {f"{k}.{name}": value.detach().cpu().contiguous() for k, of in state.items() for name, value in of.items()}


def _fill(optimizer: torch.optim.Optimizer, flat: Mapping[str, Tensor]) -> None:
    current = optimizer.state_dict()
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in flat.items():
        number, name = key.split(".", 1)
        state.setdefault(int(number), {})[name] = value
    optimizer.load_state_dict({**current, "state": state})
