"""An embedder with torch: read from what was exported, or from the state of a training.

A training under way keeps `embedder.safetensors` and `embedder.json`, as earlier versions exported them:
{"format": 2, "class": "topomerge.models.Embedder", "network": {…}, "features": {table: [column, …]},
 "sha256": of the weights' file, "about": {…}}
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from topomerge.models.embedder import Embedder
from topomerge.models.export import Ordered, read_weights, run_with_torch
from torch import Tensor

from topomerge.archive import replace_on_success
from topomerge.embedding.learned import (
    STATE_FILE,
    STATE_SETTINGS,
    check_settings,
    describe_embedder,
    find_embedder,
    find_state,
    read_embedder_card,
)
from topomerge.embedding.network import build_embedder_signature
from topomerge.errors import InputError
from topomerge.networks.network import read_checked_bytes

if TYPE_CHECKING:
    from topomerge.embedding.learned import LearnedEmbedder


STATE_FORMAT = 2
LARGEST_FILE = 1 << 28  # bytes


def wrap_network(network: Embedder, about: Mapping[str, Any] | None = None) -> LearnedEmbedder:
    """Return a network that torch runs as a callable map -> (R, D): one that was just trained."""
    from topomerge.embedding.learned import LearnedEmbedder  # here: it reads maps, which a machine that only trains does not

    run = run_with_torch(Ordered(network), build_embedder_signature(network.network))
    return LearnedEmbedder(run, network.network, float(network.temperature.detach()), about)


def save_state(network: Embedder, folder: str | Path, about: Mapping[str, Any] | None = None) -> None:
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
    weights = save({name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()})
    known = {"format": STATE_FORMAT, "sha256": hashlib.sha256(weights).hexdigest()}
    settings = {**known, **describe_embedder(network.network, about)}
    with replace_on_success(folder / STATE_FILE) as temporary:
        temporary.write_bytes(weights)
    with replace_on_success(folder / STATE_SETTINGS) as temporary:
        temporary.write_text(json.dumps(settings, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_embedder(path: str | Path | None = None) -> tuple[Embedder, dict[str, Any]]:
    """Read the network, ready to use, and on what it was trained.

    Args:
        path: as of `embedding.learned.find_embedder`, or a folder with the state of a training.

    Raises:
        InputError: no embedder there, or damaged, of another format or class.
    """
    folder = None if path is None else find_state(path)
    if folder is not None:
        return read_state(folder)
    card = read_embedder_card(find_embedder(path))
    read_checked_bytes(card.path, card.digest)
    network = Embedder(card.network)
    unread = {"log_temperature": torch.tensor(card.temperature).log()}  # what no output depends on is not in the file
    read = {name.removeprefix("network."): value for name, value in read_weights(card.path).items()}  # those of `Ordered`
    weights = {**network.state_dict(), **unread, **read}
    return _filled(network, {name: weights[name] for name in network.state_dict()}, path), card.about


def read_state(folder: Path) -> tuple[Embedder, dict[str, Any]]:
    """Return the network of the state of a training, and on what it was trained.

    Raises:
        InputError: no such files, or damaged, of another format or class.
    """
    path, settings = folder / STATE_FILE, folder / STATE_SETTINGS
    try:
        values = json.loads(settings.read_text(encoding="utf-8"))
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(f"{path}: has more than {LARGEST_FILE >> 20} MB, no embedder is as large; copy both again")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{error.filename}: {error.strerror or error}; copy both files of a state") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{settings}: damaged or cut off ({' '.join(str(error).split())[:80]}); copy both again") from error
    network = Embedder(check_settings(settings, values if isinstance(values, dict) else {}, STATE_FORMAT))
    if hashlib.sha256(data).hexdigest() != values["sha256"]:
        raise InputError(f"{path}: cut off, damaged, or not the weights that {STATE_SETTINGS} is about; copy both again")
    try:
        weights = load(data)
    except (SafetensorError, KeyError, TypeError, AttributeError, ValueError) as error:  # of headers that lie
        raise InputError(f"{path}: is no safetensors file ({' '.join(str(error).split())[:80]}); copy both again") from error
    return _filled(network, weights, path), values["about"]


def _filled(network: Embedder, weights: Mapping[str, Tensor], path: str | Path | None) -> Embedder:
    """Return the network with weights, ready to use."""
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        raise InputError(f"{path}: does not fit its settings ({' '.join(str(error).split())[:160]})") from error
    return network.eval()
