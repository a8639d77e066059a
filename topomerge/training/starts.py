"""Where a training starts from: the weights of a network that was exported before."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from topomerge.archive import find_weights_file
from topomerge.embedding.learned import PRETRAINED
from topomerge.errors import InputError
from topomerge.models.export import load_exported_weights
from topomerge.networks.network import WEIGHTS_PACKAGE
from topomerge.training.settings import NetworkTask


def start_from_exported(job: Any, settings: NetworkTask, file: str) -> None:
    """Load the weights that `init_from` names into the whole network of a job, and tell their digest in its origin.

    Args:
        file: name of the weights that ship.

    Raises:
        InputError: the task exports no network, or the weights are another network's.
    """
    if not hasattr(job, "exported"):
        raise InputError(f"task={settings.task}: init_from is for networks that are exported as one graph; leave it out")
    shipped = settings.init_from == PRETRAINED
    path = find_weights_file(WEIGHTS_PACKAGE, file) if shipped else Path(settings.init_from)
    load_exported_weights(job.exported().module, path)
    job.origin = {**job.origin, "init_from": hashlib.sha256(path.read_bytes()).hexdigest()}
