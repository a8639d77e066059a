"""A trained embedder on disk: `embedder.safetensors` and `embedder.json`. Read without torch; nothing in them is ever run.

{"format": 2, "class": "topomerge.models.Embedder", "network": {…}, "features": {table: [column, …]},
 "sha256": of the weights' file, "about": {…}}

Files of format 1 are converted when they are read (`embedding.earlier_weights`).
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.embedding.earlier_weights import format_2_network, format_2_weights
from topomerge.embedding.network import Network, network_from, tensors
from topomerge.embedding.schema import TABLES
from topomerge.errors import InputError
from topomerge.types import Array

EMBEDDER_FORMAT = 2
EMBEDDER_CLASS = "topomerge.models.Embedder"
WEIGHTS_FILE, SETTINGS_FILE = "embedder.safetensors", "embedder.json"
LARGEST_HEADER, LARGEST_FILE = 1 << 20, 1 << 28  # bytes: of the names and shapes, and of all; an embedder has 0.4 MB
Weights = dict[str, Array]


def read_weights(folder: str | Path) -> tuple[Network, Weights, dict[str, Any]]:
    """What a network is made of, its weights by name (float32), and on what it was trained.

    Args:
        folder: one that `models.weights.save_embedder` wrote, or a run, whose best embedder is taken.

    Raises:
        InputError: no such files, or damaged, of another format or class, or trained on other features.
    """
    folder = embedder_folder(folder)
    settings = _settings(folder / SETTINGS_FILE)
    path = folder / WEIGHTS_FILE
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(f"{path}: has more than {LARGEST_FILE >> 20} MB, no embedder is as large; copy both files again")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}; copy both files of an embedder") from error
    if hashlib.sha256(data).hexdigest() != settings["sha256"]:
        raise InputError(f"{path}: cut off, damaged, or not the weights that {SETTINGS_FILE} is about; copy both again")
    old = settings["format"] == 1
    try:
        network = network_from(format_2_network(settings["network"]) if old else settings["network"])
    except InputError as error:
        raise InputError(f"{folder / SETTINGS_FILE}: {str(error)[:300]}; export it again") from error
    if not old:
        _check_features(folder / SETTINGS_FILE, network, settings["features"])
    try:
        weights = unpacked(data)
        weights = format_2_weights(settings["network"], weights) if old else weights
    except (ValueError, RecursionError) as error:
        raise does_not_fit(folder, error) from error
    if not all(np.isfinite(array).all() for array in weights.values()):
        raise InputError(f"{path}: has weights that are no finite numbers; training diverged, take another run")
    return network, weights, dict(settings["about"])


def embedder_hash(folder: str | Path) -> str:
    """Hash of the weights of an embedder: what tells its rows from those of others.

    Raises:
        InputError: there is none, or it is damaged.
    """
    return str(_settings(embedder_folder(folder) / SETTINGS_FILE)["sha256"])


def embedder_folder(folder: str | Path) -> Path:
    """The folder with both files: itself, that of one of the files, or the best embedder of a run."""
    folder = Path(folder)
    if folder.name in (WEIGHTS_FILE, SETTINGS_FILE):
        folder = folder.parent
    if not (folder / SETTINGS_FILE).exists() and (folder / "best" / SETTINGS_FILE).exists():
        folder = folder / "best"
    return folder


def does_not_fit(folder: str | Path, error: BaseException) -> InputError:
    """What to say of weights that are not those of the network."""
    reason = " ".join(str(error).split())[:160]
    return InputError(f"{embedder_folder(folder) / WEIGHTS_FILE}: does not fit its {SETTINGS_FILE} ({reason})")


def features_read(network: Network) -> dict[str, list[str]]:
    """Columns of each table that a network reads, by the table's name."""
    return {name: list(TABLES[name]) for name in tensors(network) if name in TABLES}


def unpacked(data: bytes) -> Weights:
    """Arrays out of the bytes of a safetensors file.

    Raises:
        ValueError: it is none, cut off, has a header of more than `LARGEST_HEADER`, or holds other things than float32.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    if len(data) < 8 or int.from_bytes(data[:8], "little") > min(LARGEST_HEADER, len(data) - 8):
        raise ValueError("no safetensors file, or its header is cut off")
    try:
        arrays: Weights = load(data)
    except (SafetensorError, KeyError, TypeError, AttributeError) as error:  # the latter of types that NumPy lacks
        raise ValueError(f"no safetensors file of float32: {error}") from error
    for name, array in arrays.items():
        if array.dtype != np.float32 or array.ndim > 5:
            raise ValueError(f"{name[:60]}: is no float32 of at most five axes")
    return arrays


def _check_features(path: Path, network: Network, features: dict[str, Any]) -> None:
    for name, columns in features_read(network).items():
        trained = features.get(name)
        if trained != columns:
            trained = trained if isinstance(trained, list) else []
            differing = [str(column)[:40] for column in (*trained, *columns) if (column in trained) != (column in columns)]
            what = ", ".join(differing[:3]) or "their order"
            raise InputError(
                f"{path}: was trained on {len(trained)} columns of {name}, this version has {len(columns)} (other: {what}); "
                f"train it again"
            )


def _settings(path: Path) -> dict[str, Any]:
    """The JSON file, if it is of this format and class."""
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}; give a run's folder, or one of export-embedder") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: damaged or cut off ({' '.join(str(error).split())[:80]})") from error
    if not isinstance(settings, dict) or settings.get("class") != EMBEDDER_CLASS:
        other = settings.get("class") if isinstance(settings, dict) else None
        raise InputError(f"{path}: is of class {str(other)[:60]!r}, not {EMBEDDER_CLASS}")
    if settings.get("format") not in (1, EMBEDDER_FORMAT):
        raise InputError(
            f"{path}: has format {str(settings.get('format'))[:20]}, this program reads 1 and {EMBEDDER_FORMAT}; export it again"
        )
    needs = {"network": dict, "sha256": str, "about": dict} | ({"features": dict} if settings["format"] != 1 else {})
    if not all(isinstance(settings.get(key), kind) for key, kind in needs.items()):
        raise InputError(f"{path}: lacks {', '.join(needs)}; export it again")
    return settings
