"""Task `match_belief`: how likely rooms that `match` names are one, once the places of both maps were compared
(`fusion.match_belief`).

Rooms are matched in each pair of maps, and in as many of two buildings; a logistic model of each method is fitted to which
matches are one true room. Each pair counts by the root of its matches: those of a pair are right or wrong together.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from topomerge.datasets.core.builder import derive, read_derived
from topomerge.datasets.pairs.evaluation_pair import load_evaluation_pair
from topomerge.datasets.pairs.items import Recipe
from topomerge.errors import InputError
from topomerge.fusion.match_belief import BELIEF_NAMES, BELIEVED_METHODS, compute_belief_features, find_places
from topomerge.matching.match import match
from topomerge.numpy_nn import sigmoid
from topomerge.statistics import measure_calibration
from topomerge.training.closed_form import FitResult, run_fit
from topomerge.training.match_odds import NEGATIVE_OFFSET, build_map_pairs
from topomerge.training.packed_pairs import name_building
from topomerge.training.task_settings import MatchBelief
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn

SURE = (0.5, 0.8)  # probabilities from which precision is told
BEFORE, AFTER = "before", "after"  # places were compared


class MatchRows(NamedTuple):
    """Of a pair of maps: its building, do both show it, and of each method the features of its matches (M, 6), their
    probabilities by matching alone (M,) and which are right (M,)."""

    building: str
    sharing: bool
    features: dict[str, Array]
    matching: dict[str, Array]
    right: dict[str, Array]


def fit(settings: MatchBelief, log_line: LogFn) -> dict[str, float]:
    """Fit the model of each method; the scores of left-out buildings."""
    return run_fit(settings, fit_belief, log_line)


def fit_belief(settings: MatchBelief, log_line: LogFn) -> FitResult:
    """Fit weights from all pairs, and scores of those that were fitted without each building."""
    rows = build_match_rows(settings.data, settings, log_line)
    weights = {method: np.round(fit_match_weights(rows, method, settings.l2), 3).tolist() for method in BELIEVED_METHODS}
    guesses = {method: predict_left_out(rows, method, settings) for method in BELIEVED_METHODS}
    origin = {"set": settings.data.name, "split": settings.data.split, "pairs": len(rows)}
    return FitResult({"names": list(BELIEF_NAMES), **weights}, score_beliefs(rows, guesses), origin)


def build_match_rows(recipe: Recipe, settings: MatchBelief, log_line: LogFn) -> list[MatchRows]:
    """Build the matches of each pair, and of each map with one of another building, cached.

    Raises:
        InputError: no rooms match.
    """
    pairs = [(path, load_evaluation_pair(path)) for path in build_map_pairs(recipe, settings, log_line)]
    shared = [(path, name_building(pair.about)) for path, pair in pairs if pair.transform is not None and len(pair.matches)]
    sources = [[path] for path, _ in shared]
    for n, (path, building) in enumerate(shared):
        others = [other for other, name in shared[n:] + shared[:n] if name != building]
        sources += [[path, others[NEGATIVE_OFFSET % len(others)]]] if others else []
    files, _ = derive(f"{recipe.name}_belief", compute_match_rows, sources, settings, log_line=log_line)
    if not files:
        raise InputError(f"{recipe.name}: no pair has rooms that match")
    rows = []
    for data in map(read_derived, files):
        by_name = [{method: data[f"{method}.{name}"] for method in BELIEVED_METHODS} for name in ("x", "p", "y")]
        rows.append(MatchRows(str(data["building"]), bool(data["sharing"]), *by_name))
    return rows


def compute_match_rows(path: Path, other: Path | None = None) -> dict[str, Array]:
    """Compute the matches of a pair by each method; with `other` those of its first map and of the second one of another pair."""
    pair = load_evaluation_pair(path)
    a, b = pair.load_maps()
    if other is not None:
        b = load_evaluation_pair(other).load_maps()[1]
    out = {"building": np.array(name_building(pair.about)), "sharing": np.array(other is None)}
    for method in BELIEVED_METHODS:
        matching = match(a, b, method=method)
        i, j = matching.rooms.T
        right = (pair.true[0][i] == pair.true[1][j]) & (pair.true[0][i] >= 0) if other is None else np.zeros(len(i), bool)
        posed = matching.transform is not None and len(i) > 0
        x = compute_belief_features(matching, a, b, find_places(matching, a, b)) if posed else np.zeros((0, len(BELIEF_NAMES)))
        out |= {f"{method}.x": x, f"{method}.p": matching.probability[: len(x)], f"{method}.y": right[: len(x)]}
    return out


def fit_match_weights(rows: Sequence[MatchRows], method: str, l2: float) -> Array:
    """Return (6,) weights of the most likely logistic model, pulled to what matching says. None but the constant is below 0: what
    speaks for a match never lowers it.

    Raises:
        InputError: there are no matches.
    """
    x, y = (np.concatenate([getattr(r, name)[method] for r in rows]) for name in ("features", "right"))
    if not len(x):
        raise InputError(f"data.pairs: none has rooms that match by method {method}")
    share = np.concatenate([np.full(len(r.right[method]), max(len(r.right[method]), 1) ** -0.5) for r in rows])
    sign, start = np.where(y, -1.0, 1.0), (np.array(BELIEF_NAMES) == "matching").astype(float)

    def loss(w: Array) -> float:
        return l2 * float((w - start)[1:] @ (w - start)[1:]) + float(share @ np.logaddexp(0, sign * (x @ w)))

    bounds = [(None if name == "constant" else 0.0, None) for name in BELIEF_NAMES]
    weights: Array = minimize(loss, start, method="L-BFGS-B", bounds=bounds).x
    return weights


def predict_left_out(rows: Sequence[MatchRows], method: str, settings: MatchBelief) -> list[Array]:
    """Predict the (M,) probabilities of each pair by a model that was fitted without its building.

    Raises:
        InputError: all pairs are of one building.
    """
    names = sorted({r.building for r in rows})
    if len(names) < 2:
        raise InputError("data.pairs: pairs of two buildings are needed")
    fold = dict(zip(names, (np.random.default_rng(0).permutation(len(names)) % settings.folds).tolist(), strict=True))
    weights = {k: fit_match_weights([r for r in rows if fold[r.building] != k], method, settings.l2) for k in set(fold.values())}
    return [_predict_probability(r.features[method], weights[fold[r.building]]) for r in rows]


def _predict_probability(x: Array, weights: Array) -> Array:
    return np.asarray(sigmoid(np.clip(x @ weights, -50, 50)), float)


def score_beliefs(rows: Sequence[MatchRows], guesses: dict[str, list[Array]]) -> dict[str, float]:
    """Score each method on all pairs and those that share a building, before and after: calibration error (equal mass),
    the same from 0.1 on, log loss, and precision, recall and number from each probability of `SURE` on."""
    scores: dict[str, float] = {}
    for method, each in guesses.items():
        for which in ("all", "sharing"):
            chosen = [k for k, r in enumerate(rows) if (r.sharing or which == "all") and len(each[k])]
            if not chosen:
                continue
            y = np.concatenate([rows[k].right[method] for k in chosen])
            for when in (BEFORE, AFTER):
                p = np.concatenate([each[k] if when == AFTER else rows[k].matching[method] for k in chosen])
                scores |= {f"{method}_{which}_{when}_{name}": v for name, v in _compute_scores(p, y).items()}
    return scores


def _compute_scores(p: Array, y: Array) -> dict[str, float]:
    reliability, sure = measure_calibration(p, y), np.clip(p, 1e-4, 1 - 1e-4)
    accuracy = float(((p > 0.5) == y).mean())
    scores = {"error": reliability.error, "by_chance": reliability.by_chance, "count": float(len(p)), "accuracy": accuracy}
    if reliability.above is not None:
        scores |= {"error_above": reliability.above.error, "above_by_chance": reliability.above.by_chance}
    scores["log_loss"] = float(-np.mean(np.log(np.where(y, sure, 1 - sure))))
    for least in SURE:
        at, right = p >= least, max(float(y.sum()), 1.0)
        scores[f"precision_{least}"] = float(y[at].mean()) if at.any() else 1.0
        scores[f"recall_{least}"], scores[f"count_{least}"] = float(y[at].sum()) / right, float(at.sum())
    return scores


def judge(settings: MatchBelief, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Return scores of weights on pairs of buildings that trained nothing."""
    weights = json.loads(file.read_text(encoding="utf-8"))
    rows = build_match_rows(settings.heldout, settings, log_line)
    guesses = {m: [_predict_probability(r.features[m], np.array(weights[m])) for r in rows] for m in BELIEVED_METHODS}
    return score_beliefs(rows, guesses)


TASK = Task(MatchBelief, fit, ("attention_all_after_accuracy",), judge, "topomerge.fusion", "match_belief.json", hours=0.3)
