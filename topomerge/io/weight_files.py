"""Files of weights that ship with the package, and how to try others in their place.

The folder that ``TOPOMERGE_WEIGHTS`` names is looked into first: a file there takes the place of the packaged one of the same
name. ``python train.py task=... export=FOLDER`` writes such files. Caches of pairs and evaluations name what they are made of
by the packaged files: with other weights take caches of their own.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.types import Array

VARIABLE = "TOPOMERGE_WEIGHTS"


def weights_file(package: str, name: str) -> Path:
    """The file `name` of the folder that `VARIABLE` names, if it is there; else that of `package`."""
    folder = os.environ.get(VARIABLE)
    if folder:
        if not Path(folder).is_dir():
            raise InputError(f"{VARIABLE}: {folder} is no folder; name one with exported weights, or unset it")
        if (Path(folder) / name).is_file():
            return Path(folder) / name
    return _packaged(package, name)


@cache
def _packaged(package: str, name: str) -> Path:
    return Path(str(resources.files(package).joinpath(name)))


def read_layers(path: Path, what: str, taps: Mapping[str, int]) -> dict[str, Array]:
    """Layers of a network as float32: of each name a matrix ``<name>.w`` and ``<name>.b``.

    Args:
        what: network it should be, for messages.
        taps: layer -> what the number of rows of its matrix is a multiple of.

    Raises:
        InputError: another file, a damaged one, or one without these layers.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            layers = {name: file[name].astype(np.float32) for name in file.files}
    except Exception as error:  # zip, header and data each have their own errors
        raise InputError(f"{path}: is no network of {what} ({error}); install topomerge again") from error
    for name, rows in taps.items():
        w, b = layers.get(f"{name}.w"), layers.get(f"{name}.b")
        fits = w is not None and b is not None and w.ndim == 2 and not w.shape[0] % rows and b.shape == w.shape[1:]
        if not fits or not np.isfinite(layers[f"{name}.w"]).all() or not np.isfinite(layers[f"{name}.b"]).all():
            raise InputError(f"{path}: is no network of {what} (layer {name}); install topomerge again")
    return layers


def read_weights_json(package: str, name: str) -> dict[str, Any]:
    """What a JSON file of weights holds, read once.

    Raises:
        InputError: it is damaged, or no table.
    """
    return _read(weights_file(package, name))


@lru_cache(maxsize=16)
def _read(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged ({' '.join(str(error).split())[:120]}); install topomerge again") from error
    if not isinstance(values, dict):
        raise InputError(f"{path}: holds no table of weights; install topomerge again")
    return values
