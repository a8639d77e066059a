"""Task `match_odds`: how likely a hypothesis is right, and rooms that it lays over each other are one (`matching.consistency`).

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

from topomerge.datasets.core.builder import derive, read_derived
from topomerge.datasets.pairs.build import Build, build
from topomerge.datasets.pairs.evaluation_pair import EvaluationPair, load_evaluation_pair
from topomerge.datasets.pairs.items import Recipe
from topomerge.errors import InputError
from topomerge.fusion.fuse import match_common_rooms
from topomerge.matching.consistency import HYPOTHESIS, MATCH, ODDS_LENGTHS, compute_hypothesis_features, compute_match_features
from topomerge.matching.match import match
from topomerge.training.closed_form import FitResult, compute_calibration_error, run_fit
from topomerge.training.packed_pairs import name_building
from topomerge.training.settings import TaskSettings
from topomerge.training.task_settings import MatchOdds
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn, Sim3

RIGHT_POSE = (0.5, np.radians(5))  # m in the middle of what both maps saw, rad
NEGATIVE_OFFSET = 7  # pairs further on is a map of another building, mostly


class MatchEvidence(NamedTuple):
    """Of a pair of maps: its building, features of its hypotheses (H, 4) and which are right; of the pairs of rooms that meet
    (M, 5) which are one."""

    building: str
    hypotheses: Array
    right: Array
    rooms: Array
    one: Array


def build_map_pairs(recipe: Recipe, settings: TaskSettings, log_line: LogFn) -> list[Path]:
    """Build files of the pairs of a set, made where they are missing, their maps beside them.

    Raises:
        InputError: their maps are not kept, or no pair could be made.
    """
    if not recipe.maps:
        raise InputError(f"{recipe.name}: its maps are not kept; set data.maps=true")
    manifest = build(Build(recipe, settings.cache, settings.jobs, settings.cluster, list(settings.part)), log_line).manifest
    rows = [json.loads(line) for line in manifest.read_text(encoding="utf-8").splitlines()]
    if not rows:
        raise InputError(f"{recipe.name}: no pair could be made; see the reasons above")
    return [manifest.parent / "pairs" / row["file"] for row in rows]


def fit(settings: MatchOdds, log_line: LogFn) -> dict[str, float]:
    """Fit both models; the scores of left-out buildings."""
    return run_fit(settings, fit_odds, log_line)


def fit_odds(settings: MatchOdds, log_line: LogFn) -> FitResult:
    """Fit weights of both models from all pairs, and scores of those that were fitted without each building."""
    evidence = build_pair_evidence(settings.data, settings, log_line)
    weights = {
        HYPOTHESIS: np.round(fit_hypotheses(evidence, settings.l2), 2).tolist(),
        MATCH: np.round(fit_rooms(evidence, settings.l2), 2).tolist(),
    }
    origin = {"set": settings.data.name, "split": settings.data.split, "pairs": len(evidence)}
    return FitResult(weights, score_odds(*predict_left_out(evidence, settings)), origin)


def build_pair_evidence(recipe: Recipe, settings: MatchOdds, log_line: LogFn) -> list[MatchEvidence]:
    """Build the evidence of each pair, and of each map with one of another building, cached."""
    paths = [path for path in build_map_pairs(recipe, settings, log_line) if _has_matches(load_evaluation_pair(path))]
    sources = [[path] for path in paths]
    sources += [[path, paths[(n + NEGATIVE_OFFSET) % len(paths)]] for n, path in enumerate(paths)]
    files, _ = derive(f"{recipe.name}_odds", compute_evidence, sources, settings, log_line=log_line)
    if not files:
        raise InputError(f"{recipe.name}: no pair has rooms that match")
    evidence = []
    for file in files:
        a = read_derived(file)
        evidence.append(MatchEvidence(str(a["building"]), a["hypotheses"], a["right"], a["rooms"], a["one"]))
    return evidence


def _has_matches(pair: EvaluationPair) -> bool:
    return pair.transform is not None and len(pair.matches) > 0


def compute_evidence(path: Path, other: Path | None = None) -> dict[str, Array]:
    """Compute the evidence of a pair's hypotheses and rooms; with `other`, of its first and another pair's second map."""
    pair = load_evaluation_pair(path)
    a, b = pair.load_maps()
    if other is not None:
        b = load_evaluation_pair(other).load_maps()[1]
    hypotheses = match(a, b).alternatives
    right = [other is None and is_right(pair, h.transform) for h in hypotheses]
    evidence = np.array([list(h.features.values()) for h in hypotheses]).reshape(-1, 3)
    rooms, one = np.zeros((0, ODDS_LENGTHS[MATCH])), np.zeros(0, bool)
    if other is None and pair.transform is not None:
        meet, overlap = match_common_rooms(a, b, pair.transform)
        rooms = compute_match_features(a, b, meet, overlap)
        one = (pair.true[0][meet[:, 0]] == pair.true[1][meet[:, 1]]) & (pair.true[0][meet[:, 0]] >= 0)
    features = compute_hypothesis_features(evidence)
    building = np.array(name_building(pair.about))
    return {"building": building, "hypotheses": features, "right": np.array(right, bool), "rooms": rooms, "one": one}


def is_right(pair: EvaluationPair, pose: Sim3) -> bool:
    """Return whether a hypothesis is right, as for merges."""
    truth = pair.transform
    assert truth is not None
    off = np.linalg.norm((pose.apply(pair.anchor[None]) - truth.apply(pair.anchor[None]))[0])
    turn = (pose.yaw - truth.yaw + np.pi) % (2 * np.pi) - np.pi
    return bool(off < RIGHT_POSE[0] and abs(turn) < RIGHT_POSE[1])


def fit_hypotheses(evidence: Sequence[MatchEvidence], l2: float) -> Array:
    """Fit (4,) weights of the most likely softmax."""

    def loss(w: Array) -> float:
        total = l2 * float(w[1:] @ w[1:])
        for e in evidence:
            logits = np.append(e.hypotheses @ w, 0.0)
            right = logits[np.append(e.right, not e.right.any())]
            total -= float(np.logaddexp.reduce(right) - np.logaddexp.reduce(logits))
        return total

    weights: Array = minimize(loss, np.zeros(ODDS_LENGTHS[HYPOTHESIS])).x
    return weights


def fit_rooms(evidence: Sequence[MatchEvidence], l2: float) -> Array:
    """Fit (5,) weights of the logistic model."""
    x, y = np.concatenate([e.rooms for e in evidence]), np.concatenate([e.one for e in evidence])

    def loss(w: Array) -> float:
        return l2 * float(w[1:] @ w[1:]) + float(np.logaddexp(0, np.where(y, -1, 1) * (x @ w)).sum())

    weights: Array = minimize(loss, np.zeros(x.shape[1])).x
    return weights


def predict_left_out(evidence: Sequence[MatchEvidence], settings: MatchOdds) -> tuple[Array, Array]:
    """Return the probabilities (`predict_probabilities`) of each building by models that were fitted without it."""
    names = sorted({e.building for e in evidence})
    fold = np.random.default_rng(0).permutation(len(names)) % settings.folds
    parts = []
    for k in range(settings.folds):
        test = {name for name, at in zip(names, fold, strict=True) if at == k}
        rest = [e for e in evidence if e.building not in test]
        if test and rest:
            weights = fit_hypotheses(rest, settings.l2), fit_rooms(rest, settings.l2)
            parts.append(predict_probabilities([e for e in evidence if e.building in test], *weights))
    if not parts:
        raise InputError("data.pairs: pairs of two buildings are needed")
    return np.concatenate([first for first, _ in parts]), np.concatenate([rooms for _, rooms in parts])


def predict_probabilities(evidence: Sequence[MatchEvidence], hypothesis: Array, match: Array) -> tuple[Array, Array]:
    """Predict (n, 2) probability and whether it is so: of the likeliest hypothesis of each pair, and of rooms that meet."""
    first: list[tuple[float, bool]] = []
    rooms: list[tuple[float, bool]] = []
    for e in evidence:
        if len(e.right):
            odds = np.exp(np.clip(e.hypotheses @ hypothesis, -50, 50))
            first.append((odds.max() / (odds.sum() + 1), e.right[odds.argmax()]))
        rooms += zip((1 / (1 + np.exp(-e.rooms @ match))).tolist(), e.one.tolist(), strict=True)
    return np.array(first, float).reshape(-1, 2), np.array(rooms, float).reshape(-1, 2)


def score_odds(hypotheses: Array, rooms: Array) -> dict[str, float]:
    """Compute calibration error, log loss and share that is right of both models' probabilities."""
    scores: dict[str, float] = {}
    for name, pairs in ((HYPOTHESIS, hypotheses), (MATCH, rooms)):
        if len(pairs):
            p, y = np.clip(pairs[:, 0], 1e-6, 1 - 1e-6), pairs[:, 1] > 0
            scores[f"{name}_calibration_error"] = compute_calibration_error(p, y)
            scores[f"{name}_log_loss"] = float(-np.mean(np.log(np.where(y, p, 1 - p))))
            scores[f"{name}_accuracy"] = float(((p > 0.5) == y).mean())
            scores[f"{name}_count"] = float(len(pairs))
    return scores


def judge(settings: MatchOdds, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Return scores of weights on pairs of buildings that trained nothing."""
    weights = json.loads(file.read_text(encoding="utf-8"))
    evidence = build_pair_evidence(settings.heldout, settings, log_line)
    return score_odds(*predict_probabilities(evidence, np.array(weights[HYPOTHESIS]), np.array(weights[MATCH])))


TASK = Task(MatchOdds, fit, ("match_accuracy", "hypothesis_accuracy"), judge, "topomerge.matching", "odds.json", hours=0.3)
