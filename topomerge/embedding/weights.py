"""A trained embedder on disk: `embedder.safetensors` and `embedder.json`. Read without torch; nothing in them is ever run.

{"format": 1, "class": "topomerge.models.Embedder", "network": {…}, "sha256": of the weights' file, "about": {…}}
"""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.embedding.network import Network, network_from
from topomerge.errors import InputError
from topomerge.types import Array

FORMAT = 1
CLASS = "topomerge.models.Embedder"
WEIGHTS, SETTINGS = "embedder.safetensors", "embedder.json"
HEADER, LARGEST = 1 << 20, 1 << 28  # bytes, at most: of the names and shapes, and of the file; an embedder has 0.4 MB
Weights = dict[str, Array]


def read_weights(folder: str | Path) -> tuple[Network, Weights, dict[str, Any]]:
    """What a network is made of, its weights by name (float32), and what is told about it.

    Args:
        folder: one that `models.weights.save_embedder` wrote, or a run, whose best embedder is taken.

    Raises:
        InputError: no such files, or damaged, of another format or class.
    """
    folder = embedder_folder(folder)
    told = _settings(folder / SETTINGS)
    path = folder / WEIGHTS
    try:
        if path.stat().st_size > LARGEST:
            raise InputError(f"{path}: has more than {LARGEST >> 20} MB, no embedder is as large; copy both files again")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}; copy both files of an embedder") from error
    if hashlib.sha256(data).hexdigest() != told["sha256"]:
        raise InputError(f"{path}: cut off, damaged, or not the weights that {SETTINGS} is about; copy both again")
    try:
        network = network_from(told["network"])
    except InputError as error:
        raise InputError(f"{folder / SETTINGS}: {str(error)[:300]}; export it again") from error
    try:
        weights = unpacked(data)
    except (ValueError, RecursionError) as error:
        raise does_not_fit(folder, error) from error
    if not all(np.isfinite(value).all() for value in weights.values()):
        raise InputError(f"{path}: has weights that are no finite numbers; training diverged, take another run")
    return network, weights, dict(told["about"])


def embedder_folder(folder: str | Path) -> Path:
    """The folder with both files: itself, that of one of the files, or the best embedder of a run."""
    folder = Path(folder)
    if folder.name in (WEIGHTS, SETTINGS):
        folder = folder.parent
    if not (folder / SETTINGS).exists() and (folder / "best" / SETTINGS).exists():
        folder = folder / "best"
    return folder


def does_not_fit(folder: str | Path, error: BaseException) -> InputError:
    """What to say of weights that are not those of the network."""
    reason = " ".join(str(error).split())[:160]
    return InputError(f"{embedder_folder(folder) / WEIGHTS}: does not fit its {SETTINGS} ({reason})")


def unpacked(data: bytes) -> Weights:
    """Arrays out of the bytes of a safetensors file: the length of a JSON header, the header, numbers.

    Raises:
        ValueError: it is none, cut off, or holds other things than float32.
    """
    size = int.from_bytes(data[:8], "little")
    if len(data) < 8 or size > min(HEADER, len(data) - 8):
        raise ValueError("no safetensors file, or its header is cut off")
    header = json.loads(data[8 : 8 + size].decode())
    if not isinstance(header, dict):
        raise ValueError("its header is no table")
    return {name: _array(data, 8 + size, name, told) for name, told in header.items() if name != "__metadata__"}


def _array(data: bytes, start: int, name: str, told: Any) -> Array:
    """One array, if what the header tells of it is possible."""
    shape, ends = (told.get(key) if isinstance(told, dict) else None for key in ("shape", "data_offsets"))
    whole = [n for some in (shape, ends) if isinstance(some, list) for n in some]
    if not isinstance(shape, list) or not isinstance(ends, list) or len(ends) != 2 or len(shape) > 5:
        raise ValueError(f"{name[:60]}: the header tells no shape and place")
    if told.get("dtype") != "F32" or not all(isinstance(n, int) and not isinstance(n, bool) and n >= 0 for n in whole):
        raise ValueError(f"{name[:60]}: is no float32")
    first, last = ends
    if last - first != 4 * math.prod(shape) or start + last > len(data):
        raise ValueError(f"{name[:60]}: cut off")
    return np.frombuffer(data, "<f4", math.prod(shape), start + first).reshape(shape)


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
