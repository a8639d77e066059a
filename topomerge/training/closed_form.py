"""Common parts of tasks without epochs: weights out of one fit, with a run's folder, scores, a card and an export all the
same."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from topomerge.archive import replace_on_success
from topomerge.progress import Stopwatch
from topomerge.registry import TASKS
from topomerge.training.run_folder import MetricsLog, begin_run, export_files, write_card
from topomerge.training.settings import TaskSettings
from topomerge.types import Array, LogFn

PROBABILITY_BANDS = (0, 0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.97, 1.0)  # over which calibration is measured
Settings = TypeVar("Settings", bound=TaskSettings)


@dataclass(frozen=True)
class FitResult:
    """The result of a fit: weights as the package reads them, scores on what was left out, and what was learned from."""

    weights: dict[str, Any]
    metrics: dict[str, float]
    origin: dict[str, Any]


def run_fit(settings: Settings, make: Callable[[Settings, LogFn], FitResult], log_line: LogFn) -> dict[str, float]:
    """Fit, and leave a run's folder. With `resume` a run that has ended is left as it is: its data is cached either way.

    Returns:
        The scores, as in metrics.jsonl.
    """
    best = settings.folder / "best" / TASKS[settings.task].file
    metrics = settings.folder / "metrics.jsonl"
    if settings.resume and best.exists() and metrics.exists():
        log_line(f"{best}: is there")
        row = json.loads(metrics.read_text(encoding="utf-8").splitlines()[-1])
    else:
        watch = Stopwatch()
        fitted = make(settings, log_line)
        begin_run(replace(settings, resume=False), threads=settings.jobs)
        log = MetricsLog(settings)
        scores = {f"val/{name}": float(value) for name, value in fitted.metrics.items()}
        row = {"epoch": 0, "seconds": watch.elapsed, **scores}
        log.append_row(row)
        log.close()
        best.parent.mkdir(parents=True, exist_ok=True)
        with replace_on_success(best) as temporary:
            temporary.write_text(json.dumps(fitted.weights, indent=1) + "\n", encoding="utf-8")
        write_card(best, asdict(settings), fitted.origin, scores)
        log_line(", ".join(f"{name} {value:.3f}" for name, value in fitted.metrics.items()))
    if settings.export:
        export_files(best.parent, settings.export, TASKS[settings.task].package)
    return {name: value for name, value in row.items() if isinstance(value, float)}


def compute_calibration_error(p: Array, y: Array) -> float:
    """Compute the expected calibration error: how far probabilities (n,) are from how often it was so (n,), over
    `PROBABILITY_BANDS`."""
    error = 0.0
    for low, high in pairwise(PROBABILITY_BANDS):
        band = (p >= low) & (p < high + (high == 1))
        if band.any():
            error += band.mean() * abs(float(np.mean(p[band])) - float(np.mean(y[band])))
    return float(error)
