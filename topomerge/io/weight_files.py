"""Files of weights that ship with the package, and how to try others in their place.

The folder that ``TOPOMERGE_WEIGHTS`` names is looked into first: a file there takes the place of the packaged one of the same
name. ``python train.py task=... export=FOLDER`` writes such files. Caches of pairs and evaluations name what they are made of
by the packaged files: with other weights take caches of their own.
"""

from __future__ import annotations

import json
import os
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

from topomerge.errors import InputError

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
