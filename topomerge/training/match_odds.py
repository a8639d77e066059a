"""Task `match_odds`: how likely a hypothesis is right, and rooms that it lays over each other are one (`matching.odds`).

Hypotheses are searched in each pair of maps, and in as many of two buildings; a softmax over the hypotheses and "none" is fitted
to which one is right, and a logistic model to which rooms that meet under the true transform are one true room.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from topomerge.datasets.core.derived import derive, read_derived
from topomerge.datasets.pairs.build import Build, build
from topomerge.datasets.pairs.evaluation_pair import EvaluationPair, load_evaluation_pair
from topomerge.datasets.pairs.recipe import Recipe
from topomerge.errors import InputError
from topomerge.fusion.fuse import rooms_in_common
from topomerge.matching.match import match
from topomerge.matching.odds import HYPOTHESIS, MATCH, ODDS_LENGTHS, hypothesis_features, match_features
from topomerge.training.closed_form import Fitted, calibration_error, run_fit
from topomerge.training.loop import Say
from topomerge.training.shared_settings import TaskSettings
from topomerge.training.splits import name_building
from topomerge.training.task_settings import MatchOdds
from topomerge.types import Array, Sim3

RIGHT_POSE = (0.5, np.radians(5))  # m in the middle of what both maps saw, rad
STRANGER = 7  # pairs further on is a map of another building, mostly


class Evidence(NamedTuple):
    """Of a pair of maps: its building, features of its hypotheses (H, 4) and which are right; of the pairs of rooms that meet
    (M, 5) which are one."""

    building: str
    hypotheses: Array
    right: Array
    rooms: Array
    one: Array


def map_pairs(recipe: Recipe, settings: TaskSettings, say: Say) -> list[Path]:
    """Files of the pairs of a set, made where they are missing, their maps beside them.

    Raises:
        InputError: their maps are not kept, or no pair could be made.
    """
    if not recipe.maps:
        raise InputError(f"{recipe.name}: its maps are not kept; set data.maps=true")
    manifest = build(Build(recipe, settings.cache, settings.jobs, settings.cluster, list(settings.part)), say).manifest
    rows = [json.loads(line) for line in manifest.read_text(encoding="utf-8").splitlines()]
    if not rows:
        raise InputError(f"{recipe.name}: no pair could be made; see the reasons above")
    return [manifest.parent / "pairs" / row["file"] for row in rows]


def fit(settings: MatchOdds, say: Say) -> dict[str, float]:
    """Fit both models; the scores of left-out buildings."""
    return run_fit(settings, fit_odds, say)


def fit_odds(settings: MatchOdds, say: Say) -> Fitted:
    """Weights of both models from all pairs, and scores of those that were fitted without each building."""
    evidence = pair_evidence(settings.data, settings, say)
    weights = {
        HYPOTHESIS: np.round(fit_hypotheses(evidence, settings.pull), 2).tolist(),
        MATCH: np.round(fit_rooms(evidence, settings.pull), 2).tolist(),
    }
    origin = {"set": settings.data.name, "split": settings.data.split, "pairs": len(evidence)}
    return Fitted(weights, odds_scores(*left_out(evidence, settings)), origin)


def pair_evidence(recipe: Recipe, settings: MatchOdds, say: Say) -> list[Evidence]:
    """Of each pair, and of each map with one of another building, cached."""
    paths = [path for path in map_pairs(recipe, settings, say) if _has_matches(load_evaluation_pair(path))]
    sources = [[path] for path in paths]
    sources += [[path, paths[(n + STRANGER) % len(paths)]] for n, path in enumerate(paths)]
    files, _ = derive(f"{recipe.name}_odds", evidence_of, sources, settings, say=say)
    if not files:
        raise InputError(f"{recipe.name}: no pair has rooms that match")
    evidence = []
    for file in files:
        a = read_derived(file)
        evidence.append(Evidence(str(a["building"]), a["hypotheses"], a["right"], a["rooms"], a["one"]))
    return evidence


def _has_matches(pair: EvaluationPair) -> bool:
    return pair.transform is not None and len(pair.matches) > 0


def evidence_of(path: Path, other: Path | None = None) -> dict[str, Array]:
    """What hypotheses and rooms of a pair show; with `other` those of its first map and of the second one of another pair."""
    pair = load_evaluation_pair(path)
    a, b = pair.maps()
    if other is not None:
        b = load_evaluation_pair(other).maps()[1]
    hypotheses = match(a, b).alternatives
    right = [other is None and is_right(pair, h.transform) for h in hypotheses]
    evidence = np.array([list(h.features.values()) for h in hypotheses]).reshape(-1, 3)
    rooms, one = np.zeros((0, ODDS_LENGTHS[MATCH])), np.zeros(0, bool)
    if other is None and pair.transform is not None:
        meet, overlap = rooms_in_common(a, b, pair.transform)
        rooms = match_features(a, b, meet, overlap)
        one = (pair.true[0][meet[:, 0]] == pair.true[1][meet[:, 1]]) & (pair.true[0][meet[:, 0]] >= 0)
    features = hypothesis_features(evidence)
    building = np.array(name_building(pair.about))
    return {"building": building, "hypotheses": features, "right": np.array(right, bool), "rooms": rooms, "one": one}


def is_right(pair: EvaluationPair, pose: Sim3) -> bool:
    """As merges are judged."""
    truth = pair.transform
    assert truth is not None
    off = np.linalg.norm((pose.apply(pair.anchor[None]) - truth.apply(pair.anchor[None]))[0])
    turn = (pose.yaw - truth.yaw + np.pi) % (2 * np.pi) - np.pi
    return bool(off < RIGHT_POSE[0] and abs(turn) < RIGHT_POSE[1])


def fit_hypotheses(evidence: Sequence[Evidence], pull: float) -> Array:
    """(4,) weights of the most likely softmax."""

    def loss(w: Array) -> float:
        total = pull * float(w[1:] @ w[1:])
        for e in evidence:
            logits = np.append(e.hypotheses @ w, 0.0)
            right = logits[np.append(e.right, not e.right.any())]
            total -= float(np.logaddexp.reduce(right) - np.logaddexp.reduce(logits))
        return total

    weights: Array = minimize(loss, np.zeros(ODDS_LENGTHS[HYPOTHESIS])).x
    return weights


def fit_rooms(evidence: Sequence[Evidence], pull: float) -> Array:
    """(5,) weights of the logistic model."""
    x, y = np.concatenate([e.rooms for e in evidence]), np.concatenate([e.one for e in evidence])

    def loss(w: Array) -> float:
        return pull * float(w[1:] @ w[1:]) + float(np.logaddexp(0, np.where(y, -1, 1) * (x @ w)).sum())

    weights: Array = minimize(loss, np.zeros(x.shape[1])).x
    return weights


def left_out(evidence: Sequence[Evidence], settings: MatchOdds) -> tuple[Array, Array]:
    """`probabilities` of each building by models that were fitted without it."""
    names = sorted({e.building for e in evidence})
    fold = np.random.default_rng(0).permutation(len(names)) % settings.folds
    parts = []
    for k in range(settings.folds):
        test = {name for name, at in zip(names, fold, strict=True) if at == k}
        rest = [e for e in evidence if e.building not in test]
        if test and rest:
            weights = fit_hypotheses(rest, settings.pull), fit_rooms(rest, settings.pull)
            parts.append(probabilities([e for e in evidence if e.building in test], *weights))
    if not parts:
        raise InputError("data.pairs: pairs of two buildings are needed")
    return np.concatenate([first for first, _ in parts]), np.concatenate([rooms for _, rooms in parts])


def probabilities(evidence: Sequence[Evidence], hypothesis: Array, match: Array) -> tuple[Array, Array]:
    """(n, 2) probability and whether it is so: of the likeliest hypothesis of each pair, and of rooms that meet."""
    first: list[tuple[float, bool]] = []
    rooms: list[tuple[float, bool]] = []
    for e in evidence:
        if len(e.right):
            odds = np.exp(np.clip(e.hypotheses @ hypothesis, -50, 50))
            first.append((odds.max() / (odds.sum() + 1), e.right[odds.argmax()]))
        rooms += zip((1 / (1 + np.exp(-e.rooms @ match))).tolist(), e.one.tolist(), strict=True)
    return np.array(first, float).reshape(-1, 2), np.array(rooms, float).reshape(-1, 2)


def odds_scores(hypotheses: Array, rooms: Array) -> dict[str, float]:
    """Calibration error, log loss and share that is right of both models' probabilities."""
    scores: dict[str, float] = {}
    for name, pairs in ((HYPOTHESIS, hypotheses), (MATCH, rooms)):
        if len(pairs):
            p, y = np.clip(pairs[:, 0], 1e-6, 1 - 1e-6), pairs[:, 1] > 0
            scores[f"{name}_calibration_error"] = calibration_error(p, y)
            scores[f"{name}_log_loss"] = float(-np.mean(np.log(np.where(y, p, 1 - p))))
            scores[f"{name}_accuracy"] = float(((p > 0.5) == y).mean())
            scores[f"{name}_count"] = float(len(pairs))
    return scores


def judge(settings: MatchOdds, file: Path, say: Say) -> dict[str, Any]:
    """Scores of weights on pairs of buildings that trained nothing."""
    weights = json.loads(file.read_text(encoding="utf-8"))
    evidence = pair_evidence(settings.heldout, settings, say)
    return odds_scores(*probabilities(evidence, np.array(weights[HYPOTHESIS]), np.array(weights[MATCH])))
