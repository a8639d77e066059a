"""State of a training on disk: what it takes to go on as if nothing had been, without unpickling anything.

A folder: the files of the network (of an embedder: `models.weights`), `optimizer.safetensors` and, written last, `state.json`:

    {"format": 3, "class": "topomerge.training", "sha256": {file: …}, "progress": {…}}
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from topomerge.embedding.learned import STATE_FILE as EMBEDDER_STATE
from topomerge.errors import InputError

STATE_FORMAT = 3
STATE_CLASS = "topomerge.training"
NETWORK_FILE, OPTIMIZER_FILE, STATE_FILE = "network.safetensors", "optimizer.safetensors", "state.json"


def save_state(
    folder: str | Path,
    write: Callable[[Path], None],
    optimizer: torch.optim.Optimizer,
    progress: Mapping[str, Any],
    tensors: Mapping[str, Mapping[str, Tensor]] | None = None,
) -> None:
    """Replace a folder by the state as it is; a kill in between leaves the old one, or the new one beside it.

    Args:
        write: writes the files of the network into a folder.
        progress: what else is needed to go on, as JSON has it.
        tensors: name of a file -> what it holds, likewise.
    """
    folder = Path(folder)
    new, old = folder.with_name(f"{folder.name}.new"), folder.with_name(f"{folder.name}.old")
    for stale in (new, old):
        shutil.rmtree(stale, ignore_errors=True)
    new.mkdir(parents=True)
    write(new)
    (new / OPTIMIZER_FILE).write_bytes(save(_flatten_state(optimizer)))
    for name, values in (tensors or {}).items():
        (new / name).write_bytes(save({key: value.detach().cpu().contiguous() for key, value in values.items()}))
    digests = {path.name: _compute_digest(path) for path in sorted(new.iterdir())}
    state = {"format": STATE_FORMAT, "class": STATE_CLASS, "sha256": digests, "progress": dict(progress)}
    (new / STATE_FILE).write_text(json.dumps(state, indent=1) + "\n", encoding="utf-8")
    if folder.exists():
        folder.rename(old)
    new.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def write_network(network: torch.nn.Module, folder: Path) -> None:
    """Write a network's weights as `NETWORK_FILE`."""
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    (folder / NETWORK_FILE).write_bytes(save(state))


def read_network(network: torch.nn.Module, folder: Path) -> None:
    """Put what `write_network` wrote into a network.

    Raises:
        InputError: it is damaged, or of another network.
    """
    try:
        network.load_state_dict(load((folder / NETWORK_FILE).read_bytes()))
    except (RuntimeError, OSError, ValueError, SafetensorError) as error:
        reason = " ".join(str(error).split())[:160]
        raise InputError(f"{folder / NETWORK_FILE}: is not of the network configured ({reason}); train again") from error


def find_state_folder(folder: str | Path) -> Path:
    """Return the folder of a state, which is beside the one that is named after a kill between two renames."""
    folder = Path(folder)
    newer = folder.with_name(f"{folder.name}.new")
    return newer if not folder.exists() and (newer / STATE_FILE).exists() else folder


def load_state(
    folder: str | Path, network: torch.nn.Module, optimizer: torch.optim.Optimizer, weights: str = EMBEDDER_STATE
) -> dict[str, Any]:
    """Put the state into a network and its optimizer; `progress` comes back.

    Args:
        weights: the file of the network.

    Raises:
        InputError: no such folder, damaged, of another format, class or network.
    """
    folder = find_state_folder(folder)
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
    for name in {*state["sha256"], weights, OPTIMIZER_FILE}:
        if not (folder / name).exists() or _compute_digest(folder / name) != state["sha256"].get(name):
            raise InputError(f"{folder / name}: missing, cut off, or not of this state; start again without resume")
    try:
        network.load_state_dict(load((folder / weights).read_bytes()))
        _fill(optimizer, load((folder / OPTIMIZER_FILE).read_bytes()))
    except (RuntimeError, KeyError, ValueError) as error:
        reason = " ".join(str(error).split())[:160]
        raise InputError(f"{folder}: is of another network than the one configured ({reason})") from error
    progress: dict[str, Any] = state["progress"]
    return progress


def _compute_digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _flatten_state(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    state = optimizer.state_dict()["state"]
    return {f"{k}.{name}": value.detach().cpu().contiguous() for k, of in state.items() for name, value in of.items()}


def _fill(optimizer: torch.optim.Optimizer, flat: Mapping[str, Tensor]) -> None:
    current = optimizer.state_dict()
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in flat.items():
        number, name = key.split(".", 1)
        state.setdefault(int(number), {})[name] = value
    optimizer.load_state_dict({**current, "state": state})
