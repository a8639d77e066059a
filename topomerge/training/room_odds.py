"""Task `compute_room_odds`: is a room of a map one, whole, entered, outside (`extraction.room_odds`)?

Simulated scans are extracted with and without the sensor's places, robots' grids and scans of buildings with their surroundings
without; what is true about their rooms answers. Each scan counts alike per root of its rooms, so that hospitals do not outweigh
flats.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.stats import rankdata

from topomerge.datasets.pairs.plan_examples import PlanRecipe
from topomerge.datasets.pairs.room_examples import build_rooms, read_room_rows
from topomerge.errors import InputError
from topomerge.extraction.room_odds import (
    ENTERED_BY_POSES,
    FAMILIES,
    Family,
    build_model_inputs,
    load_room_weights,
)
from topomerge.numpy_nn import sigmoid
from topomerge.training.closed_form import FitResult, compute_calibration_error, run_fit
from topomerge.training.packed_pairs import number_buildings, read_scan_building
from topomerge.training.scan_settings import RoomOdds
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn

CLIPPED = (0.005, 0.995)  # quantiles that features are clipped to
ANSWER_OF = {"confidence": "one", "whole": "whole", "entered": "entered", "outside": "outside", ENTERED_BY_POSES: "posed.entered"}
Rows = Mapping[str, Array]  # of one scan, as `room_examples.build_room_rows` makes them


def fit(settings: RoomOdds, log_line: LogFn) -> dict[str, float]:
    """Fit all models; the scores of left-out scans."""
    return run_fit(settings, fit_room_odds, log_line)


def fit_room_odds(settings: RoomOdds, log_line: LogFn) -> FitResult:
    """Fit weights from all scans, and scores of those that were fitted without each fold of them.

    Raises:
        InputError: `fit` names no family, or no scan could be made.
    """
    if not settings.fit or set(settings.fit) - set(FAMILIES):
        raise InputError(f"fit must be some of {', '.join(FAMILIES)}, not {settings.fit}")
    weights: dict[str, Any] = {} if set(settings.fit) == set(FAMILIES) else load_room_weights()
    scores: dict[str, float] = {}
    origin: dict[str, Any] = {"split": list_recipes(settings, heldout=False)[settings.fit[0]][0].split}
    for key in settings.fit:
        family, sets = FAMILIES[key], list_recipes(settings, heldout=False)[key]
        scans = [scan for recipe in sets for scan in build_room_scans(recipe, settings, log_line)]
        origin[key] = {"sets": [recipe.name for recipe in sets], "scans": len(scans)}
        scores |= _score_left_out(family, scans, settings)
        weights = merge_family_weights(weights, family, fit_family_weights(family, scans, settings.pull))
    return FitResult(weights, scores, origin)


def list_recipes(settings: RoomOdds, heldout: bool) -> dict[str, list[PlanRecipe]]:
    """The sets of scans of each of `FAMILIES`, to fit to or to judge on. What lies outside is told in ordinary scans, too."""
    if heldout:
        return {
            "scans": [settings.heldout],
            "open": [settings.heldout_open, settings.heldout],
            "grids": [settings.heldout_grids],
        }
    return {"scans": [settings.data], "open": [settings.open, settings.closed], "grids": [settings.grids]}


def merge_family_weights(weights: dict[str, Any], family: Family, fitted: dict[str, Any]) -> dict[str, Any]:
    """Return the weights with those of a family in place of its earlier ones."""
    return {**weights, family.key: fitted} if family.key else {**weights, **fitted}


def _score_left_out(family: Family, scans: Sequence[Rows], settings: RoomOdds) -> dict[str, float]:
    """Scores of a family's models on buildings that were left out of the fit, a fold at a time."""
    fold = number_buildings([str(scan["building"]) for scan in scans]) % settings.folds
    guesses: dict[str, list[Array]] = {name: [] for name in family.lengths}
    for k in range(settings.folds):
        rest = [scan for scan, at in zip(scans, fold, strict=True) if at != k]
        if len(rest) < len(scans):
            weights = fit_family_weights(family, rest, settings.pull)
            _append_predictions(weights, family, [scan for scan, at in zip(scans, fold, strict=True) if at == k], guesses)
    return _score_family(family, guesses)


def build_room_scans(recipe: PlanRecipe, settings: RoomOdds, log_line: LogFn) -> list[Rows]:
    """Build the rooms of each scan of a set that has any, cached.

    Raises:
        InputError: no scan could be made.
    """
    paths = build_rooms(recipe, settings, log_line)
    scans: list[Rows] = [{**read_room_rows(path), "building": np.array(read_scan_building(path))} for path in paths]
    scans = [scan for scan in scans if len(scan["x"])]
    if not scans:
        raise InputError(f"{recipe.name}: no scan could be made; see the reasons above")
    return scans


def fit_family_weights(family: Family, scans: Sequence[Rows], pull: float) -> dict[str, Any]:
    """Fit the weights of a family in `room_odds.json`."""
    x = np.concatenate([scan["x"] for scan in scans])
    low, high = np.quantile(x, CLIPPED, axis=0)
    clipped = np.clip(x, low, high)
    standard = {"low": low, "high": high, "mean": clipped.mean(axis=0), "scale": clipped.std(axis=0) + 1e-3}
    weights: dict[str, Any] = {"features": list(family.features)}
    weights |= {name: np.round(values, 4).tolist() for name, values in standard.items()}
    for name in family.lengths:
        tables = [table for scan in scans if len(table := _build_table(weights, family, scan, name)[0])]
        answers = [answer for scan in scans if len(answer := _build_table(weights, family, scan, name)[1])]
        if not tables:
            raise InputError("data.scans: too few scans: none has poses")
        weights[name] = np.round(_fit_logistic(tables, answers, pull), 4).tolist()
    return weights


def _build_table(weights: dict[str, Any], family: Family, scan: Rows, name: str) -> tuple[Array, Array]:
    """Inputs of a model and answers, of the rooms of a scan; none where the model needs poses and the scan has none."""
    if name != ENTERED_BY_POSES:
        return build_model_inputs(weights, family, scan["x"]), scan[ANSWER_OF[name]]
    if "posed.x" not in scan or not np.isfinite(scan["posed.p"]).all():
        return np.zeros((0, family.lengths[name])), np.zeros(0, bool)
    return build_model_inputs(weights, family, scan["posed.x"], scan["posed.p"]), scan[ANSWER_OF[name]]


def _fit_logistic(tables: Sequence[Array], answers: Sequence[Array], pull: float) -> Array:
    """Weights of the most likely logistic model, pulled to 0 but for the constant."""
    x, y = np.concatenate(tables), np.concatenate(answers)
    share = np.concatenate([np.full(len(table), 1 / np.sqrt(len(table))) for table in tables])
    share *= len(share) / share.sum()
    sign = np.where(y, -1.0, 1.0)

    def loss(w: Array) -> tuple[float, Array]:
        odds = sign * (x @ w)
        slope = x.T @ (share * sign * sigmoid(np.clip(odds, -50, 50)))
        slope[1:] += 2 * pull * w[1:]
        return float(share @ np.logaddexp(0, odds)) + pull * float(w[1:] @ w[1:]), slope

    weights: Array = minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B").x
    return weights


def _append_predictions(weights: dict[str, Any], family: Family, scans: Sequence[Rows], guesses: dict[str, list[Array]]) -> None:
    """Add to each model's guesses (n, 2): probability and whether it is so."""
    for name in family.lengths:
        for scan in scans:
            table, answer = _build_table(weights, family, scan, name)
            p = sigmoid(np.clip(table @ np.array(weights[name]), -30, 30))
            guesses[name].append(np.column_stack([p, answer]))


def _score_family(family: Family, guesses: Mapping[str, Sequence[Array]]) -> dict[str, float]:
    scores: dict[str, float] = {}
    for name, parts in guesses.items():
        rows = np.concatenate([np.zeros((0, 2)), *parts])
        if len(rows):
            title = f"{family.key}_{name}" if family.key else name
            scores |= {f"{title}_{score}": value for score, value in score_predictions(rows[:, 0], rows[:, 1] > 0).items()}
    return scores


def score_predictions(p: Array, y: Array) -> dict[str, float]:
    """Area under the ROC curve (a half where all answers are alike), calibration error, log loss and share of answers that are
    yes, of probabilities (n,) and answers (n,) bool."""
    yes, no = int(y.sum()), int((~y).sum())
    above = (rankdata(p)[y].sum() - yes * (yes + 1) / 2) / (yes * no) if yes and no else 0.5
    p = np.clip(p, 1e-6, 1 - 1e-6)
    loss = -np.mean(np.log(np.where(y, p, 1 - p)))
    return {
        "auc": float(above),
        "calibration_error": compute_calibration_error(p, y),
        "log_loss": float(loss),
        "share": yes / len(y),
    }


def judge(settings: RoomOdds, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Return scores of weights on scans of buildings that trained nothing."""
    weights = json.loads(file.read_text(encoding="utf-8"))
    scores: dict[str, Any] = {}
    for key, sets in list_recipes(settings, heldout=True).items():
        family = FAMILIES[key]
        scans = [scan for recipe in sets for scan in build_room_scans(recipe, settings, log_line)]
        guesses: dict[str, list[Array]] = {name: [] for name in family.lengths}
        _append_predictions(weights[family.key] if family.key else weights, family, scans, guesses)
        scores |= _score_family(family, guesses)
    return scores


TASK = Task(
    RoomOdds, fit, ("entered_auc", "whole_auc", "confidence_auc"), judge, "topomerge.extraction", "room_odds.json", hours=0.5
)
