"""Task `passages`: how much all evidence together says of a door between two segments (`extraction.passages`).

A logistic model for scans that show walls, pulled towards the plan's own answer: what evidence adds must show in the scans.
Slices have none: on them the plan alone was better.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from topomerge.datasets.pairs.passage_examples import PassageExamples, build_passages, load_passages
from topomerge.datasets.pairs.plan_examples import PlanRecipe
from topomerge.errors import InputError
from topomerge.extraction.extract import KINDS, SCORE_INPUTS, compute_inputs
from topomerge.numpy_nn import sigmoid
from topomerge.training.closed_form import FitResult, compute_calibration_error, run_fit
from topomerge.training.packed_pairs import number_buildings, read_scan_building
from topomerge.training.scan_settings import Passages
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn

PRIOR = np.array([float(name == "plan") for name in SCORE_INPUTS])  # weights are pulled to the plan alone
STIFF = np.array([1.0 if name == "constant" else 4.0 for name in SCORE_INPUTS])  # of each pull


def fit(settings: Passages, log_line: LogFn) -> dict[str, float]:
    """Fit the models; the scores of left-out scans."""
    return run_fit(settings, fit_passages, log_line)


def fit_passages(settings: Passages, log_line: LogFn) -> FitResult:
    """Weights of the models from all scans, and scores of those that were fitted without each building."""
    scans = read_scans(settings.data, settings, log_line)
    fold = number_buildings([scan.building for scan in scans]) % settings.folds
    parts = [[scan for scan, at in zip(scans, fold, strict=True) if at == k] for k in range(settings.folds)]
    left_out = []
    for k, part in enumerate(parts):
        weights = fit_models([scan for j, other in enumerate(parts) if j != k for scan in other], settings.pull)
        left_out += [score(scan, weights) for scan in part]
    origin = {"set": settings.data.name, "split": settings.data.split, "scans": len(scans)}
    return FitResult(fit_models(scans, settings.pull), compute_figures(left_out), origin)


def read_scans(recipe: PlanRecipe, settings: Passages, log_line: LogFn) -> list[PassageExamples]:
    """Return the passages of each scan of a set that shows any.

    Raises:
        InputError: too few scans.
    """
    paths = build_passages(recipe, settings, log_line)
    scans = [replace(load_passages(path), building=read_scan_building(path)) for path in paths]
    scans = [scan for scan in scans if scan.kind and len(scan.parted)]
    if len(scans) < settings.folds:
        raise InputError(f"data.scans={recipe.scans}: too few scans for {settings.folds} folds")
    return scans


def fit_models(scans: Sequence[PassageExamples], pull: float) -> dict[str, list[float]]:
    """Of each of `KINDS` the weights of `SCORE_INPUTS`; scans with many passages count less than proportionally."""
    models = {}
    for kind in KINDS:
        own = [scan for scan in scans if scan.kind == kind]
        weights = PRIOR
        if own:
            x = np.concatenate([compute_inputs(scan.plan, scan.shown) for scan in own])
            y = np.concatenate([scan.parted for scan in own])
            count = np.concatenate([np.full(len(scan.parted), 1 / np.sqrt(len(scan.parted))) for scan in own])
            weights = minimize(_loss, PRIOR, (x, y, count / count.mean(), pull), jac=True, method="BFGS").x
        models[kind] = np.round(weights, 3).tolist()
    return models


def _loss(weights: Array, x: Array, y: Array, count: Array, pull: float) -> tuple[float, Array]:
    """Negative log likelihood with what pulls the weights to `PRIOR`, and its gradient."""
    z, off = x @ weights, weights - PRIOR
    loss = float((count * np.logaddexp(0, np.where(y, -z, z))).sum() + pull * (STIFF * off**2).sum() / 2)
    return loss, x.T @ (count * (sigmoid(z) - y)) + pull * STIFF * off


def score(scan: PassageExamples, weights: dict[str, list[float]]) -> tuple[Array, Array, Array]:
    """(n,) probability of a door in each passage, of the plan alone, and are they doors?"""
    inputs = compute_inputs(scan.plan, scan.shown)
    return sigmoid(inputs @ np.array(weights[scan.kind])), sigmoid(scan.plan), scan.parted


def compute_figures(scans: Sequence[tuple[Array, Array, Array]]) -> dict[str, float]:
    """Log loss of all evidence and of the plan alone, calibration error, share of right answers at .5."""
    p, plan, y = (np.concatenate(arrays) for arrays in zip(*scans, strict=True))
    loss = {name: -np.mean(np.log(np.clip(np.where(y, q, 1 - q), 1e-6, 1))) for name, q in (("all", p), ("plan", plan))}
    return {
        "log_loss": float(loss["all"]),
        "log_loss_of_plan": float(loss["plan"]),
        "calibration_error": compute_calibration_error(p, y),
        "accuracy": float(((p > 0.5) == y).mean()),
        "accuracy_of_plan": float(((plan > 0.5) == y).mean()),
        "passages": float(len(y)),
    }


def judge(settings: Passages, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Scores of weights on scans of buildings that trained nothing."""
    weights = json.loads(file.read_text(encoding="utf-8"))
    return compute_figures([score(scan, weights) for scan in read_scans(settings.heldout, settings, log_line)])


TASK = Task(
    Passages, fit, ("log_loss", "accuracy"), judge, "topomerge.extraction", "passages.json", hours=0.2, lower=("log_loss",)
)
