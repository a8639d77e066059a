"""Settings that all tasks of `train.py` share, and those of the ones that train a network."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from topomerge.errors import InputError


def check_numbers(settings: Mapping[str, Any], above: str = "") -> None:
    """Refuse numbers that are not finite.

    Raises:
        InputError: names the key.
    """
    for key, value in settings.items():
        if isinstance(value, Mapping):
            check_numbers(value, f"{above}{key}.")
        elif isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"{above}{key} must be a finite number, not {value}")


@dataclass
class TaskSettings:
    """What every task has.

    Args:
        task: which of the learned parts.
        name: of the run; its folder is `runs`/`name`.
        cache: folder of the data, which is made where it is missing, by so many processes (`jobs`), or those of a Dask cluster.
        part: [k, n]: make every n-th item of the data from the k-th on, for machines that share nothing.
        resume: go on where the run of this name stopped, with the same settings; overwrite: replace that run.
        export: where the best weights go at the end: `package`, or a folder; empty: they stay in the run's.
    """

    task: str = ""
    name: str = "run"
    runs: str = "runs"
    cache: str = "cache"
    seed: int = 0
    jobs: int = 1
    cluster: str | None = None
    part: list[int] = field(default_factory=lambda: [1, 1])
    resume: bool = False
    overwrite: bool = False
    tensorboard: bool = True
    export: str = ""

    @property
    def folder(self) -> Path:
        """Where the run is written."""
        return Path(self.runs) / self.name


@dataclass
class NetworkTask(TaskSettings):
    """What tasks that train a network have besides.

    Args:
        epochs: at most; rate: of learning; decay: of weights; batch: examples a step.
        patience: epochs without a better validation after which it ends; 0: never.
        hold_out: the scans of every n-th physical building are watched and train nothing.
        watch: what is best: a score of validation.
    """

    epochs: int = 10
    batch: int = 8
    rate: float = 2e-3
    decay: float = 1e-3
    patience: int = 0
    hold_out: int = 8
    watch: str = ""


@dataclass
class RasterTask(NetworkTask):
    """What tasks whose networks look at rasters have besides.

    Args:
        accelerator: cpu or cuda. Only cpu gives the same bytes again for the same seed.
    """

    accelerator: str = "cpu"
