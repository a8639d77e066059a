"""Where a training starts from: the weights of a network that was exported before."""

from __future__ import annotations

import hashlib
from typing import Any

from topomerge.errors import InputError
from topomerge.models.export import load_exported_weights
from topomerge.training.settings import NetworkTask
from topomerge.training.tasks import find_start


def start_from_exported(job: Any, settings: NetworkTask) -> None:
    """Load the weights that `init_from` names into the whole network of a job, and tell their digest in its origin.

    Raises:
        InputError: the task exports no network, or the weights are another network's.
    """
    if not hasattr(job, "exported"):
        raise InputError(f"task={settings.task}: init_from is for networks that are exported as one graph; leave it out")
    path = find_start(settings.task, settings.init_from)
    load_exported_weights(job.exported().module, path)
    job.origin = {**job.origin, "init_from": hashlib.sha256(path.read_bytes()).hexdigest()}
