"""An embedder with torch, written to and read from the two files of `embedding.weights`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from topomerge.models.embedder import Embedder

from topomerge.embedding.weights import (
    EMBEDDER_CLASS,
    EMBEDDER_FORMAT,
    SETTINGS_FILE,
    WEIGHTS_FILE,
    does_not_fit,
    features_read,
    read_weights,
)
from topomerge.errors import InputError
from topomerge.io.atomic import replacing


def save_embedder(network: Embedder, folder: str | Path, about: Mapping[str, Any] | None = None) -> None:
    """Write both files into a folder, which is made if need be.

    Args:
        about: on what it was trained, how good it is.

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
    settings = {
        "format": EMBEDDER_FORMAT,
        "class": EMBEDDER_CLASS,
        "network": asdict(network.network),
        "features": features_read(network.network),
        "sha256": hashlib.sha256(weights).hexdigest(),
        "about": dict(about or {}),
    }
    with replacing(folder / WEIGHTS_FILE) as beside:
        beside.write_bytes(weights)
    with replacing(folder / SETTINGS_FILE) as beside:
        beside.write_text(json.dumps(settings, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_embedder(folder: str | Path) -> tuple[Embedder, dict[str, Any]]:
    """The network, ready to use, and on what it was trained.

    Args:
        folder: one that `save_embedder` wrote, or a run, whose best embedder is taken.

    Raises:
        InputError: no such files, or damaged, of another format or class.
    """
    settings, weights, about = read_weights(folder)
    network = Embedder(settings)
    try:
        network.load_state_dict({name: torch.from_numpy(array.copy()) for name, array in weights.items()})
    except RuntimeError as error:
        raise does_not_fit(folder, error) from error
    return network.eval(), about
