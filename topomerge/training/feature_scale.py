"""Task `feature_scale`: what the engineered features are scaled by (`embedding.engineered`).

Their mean and spread over rooms, and the covariance of the differences between two maps' views of one room. Rooms weigh alike,
looked-into ones (most of the outline unseen) not at all.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from topomerge.datasets.core.builder import derive, read_derived
from topomerge.datasets.pairs.evaluation_pair import load_evaluation_pair
from topomerge.datasets.pairs.items import Recipe
from topomerge.embedding.engineered import FEATURES, compute_raw_features
from topomerge.errors import InputError
from topomerge.matching.assignment import rank_partners
from topomerge.training.closed_form import FitResult, run_fit
from topomerge.training.match_odds import build_map_pairs
from topomerge.training.packed_pairs import name_building
from topomerge.training.task_settings import FeatureScale
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn, is_mostly_unseen

CLIPPED = 4.0  # standard deviations that a difference counts for at most
FOLDS = 5  # of buildings, for the scores


class PairFeatures(NamedTuple):
    """Of a pair of maps: its building, features (R, 18) of the rooms of a and of b, which rooms were looked into only, rooms that
    are one (M, 2), and which of these are seen well by both maps (M,)."""

    building: str
    a: Array
    b: Array
    glimpsed_a: Array
    glimpsed_b: Array
    matches: Array
    clear: Array


def fit(settings: FeatureScale, log_line: LogFn) -> dict[str, float]:
    """Measure; recall@1 of rooms of left-out buildings."""
    return run_fit(settings, fit_scale, log_line)


def fit_scale(settings: FeatureScale, log_line: LogFn) -> FitResult:
    """Return the scale from all pairs, and how well rooms of buildings are found by the scale of the others."""
    pairs = build_pair_features(settings.data, settings, log_line)
    names = sorted({p.building for p in pairs})
    parts = np.array_split(np.random.default_rng(0).permutation(len(names)), min(FOLDS, len(names)))
    ranks = []
    for part in parts:
        test = {names[k] for k in part}
        rest = [p for p in pairs if p.building not in test]
        if rest:
            ranks.append(rank_scaled([p for p in pairs if p.building in test], compute_statistics(rest, settings.shrink)))
    weights = compute_statistics(pairs, settings.shrink)
    origin = {"set": settings.data.name, "split": settings.data.split, "pairs": len(pairs)}
    return FitResult(weights, rank_scores(np.concatenate([*ranks, np.zeros(0, int)])), origin)


def build_pair_features(recipe: Recipe, settings: FeatureScale, log_line: LogFn) -> list[PairFeatures]:
    """Build the features of each pair of a set, cached."""
    paths = build_map_pairs(recipe, settings, log_line)
    files, _ = derive(f"{recipe.name}_features", compute_features, [[path] for path in paths], settings, log_line=log_line)
    pairs = []
    for file in files:
        arrays = read_derived(file)
        pairs.append(PairFeatures(str(arrays.pop("building")), **arrays))
    return pairs


def compute_features(path: Path) -> dict[str, Array]:
    """Return the `PairFeatures` of a pair's file."""
    pair = load_evaluation_pair(path)
    maps = pair.load_maps()
    a, b = (compute_raw_features(m) for m in maps)
    glimpsed = [is_mostly_unseen(m.rooms) for m in maps]
    i, j = pair.matches.T
    clear = pair.one[0][i] & pair.one[1][j] & ~glimpsed[0][i] & ~glimpsed[1][j]
    building = np.array(name_building(pair.about))
    both = {"glimpsed_a": glimpsed[0], "glimpsed_b": glimpsed[1]}
    return {"building": building, "a": a, "b": b, **both, "matches": pair.matches, "clear": clear}


def compute_statistics(pairs: Sequence[PairFeatures], shrink: float) -> dict[str, Any]:
    """Compute the statistics in `engineered.json`.

    Raises:
        InputError: no room is seen by two maps.
    """
    rooms = np.concatenate([values for p in pairs for values in (p.a[~p.glimpsed_a], p.b[~p.glimpsed_b])])
    differences = np.concatenate([(p.a[p.matches[:, 0]] - p.b[p.matches[:, 1]])[p.clear] for p in pairs])
    if not len(differences):
        raise InputError("data.pairs: too few pairs: no room is seen well by two maps")
    limit = CLIPPED * rooms.std(axis=0)
    differences = np.clip(differences, -limit, limit)
    second = differences.T @ differences / len(differences)
    second += np.diag(shrink * rooms.var(axis=0) + 1e-6)
    return {
        "features": list(FEATURES),
        "rooms": len(rooms),
        "pairs_of_rooms": len(differences),
        "mean": np.round(rooms.mean(axis=0), 5).tolist(),
        "spread": np.round(rooms.std(axis=0) + 1e-6, 5).tolist(),
        "differences": np.round(second, 6).tolist(),
    }


def rank_scaled(pairs: Sequence[PairFeatures], weights: dict[str, Any]) -> Array:
    """Return (n,) rank of the partner of each room that has one, by the distance of features scaled as ``"matched"``."""
    root = np.linalg.cholesky(np.linalg.inv(np.array(weights["differences"])))
    ranks = [np.zeros(0, int)]
    for p in pairs:
        if len(p.matches):
            a, b = ((values - weights["mean"]) @ root for values in (p.a, p.b))
            alike = -np.linalg.norm(a[:, None] - b[None], axis=2)
            ranks += [rank_partners(alike, p.matches)[1], rank_partners(alike.T, p.matches[:, ::-1])[1]]
    return np.concatenate(ranks)


def rank_scores(ranks: Array) -> dict[str, float]:
    """Return shares of partners that are first or among the first five, and their mean reciprocal rank."""
    if not len(ranks):
        return {"recall@1": 0.0, "recall@5": 0.0, "mrr": 0.0, "rooms": 0.0}
    scores = {f"recall@{k}": float((ranks <= k).mean()) for k in (1, 5)}
    return {**scores, "mrr": float((1 / ranks).mean()), "rooms": float(len(ranks))}


def judge(settings: FeatureScale, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Return recall@1 of engineered features with these weights on pairs of buildings that trained nothing."""
    weights = json.loads(file.read_text(encoding="utf-8"))
    return rank_scores(rank_scaled(build_pair_features(settings.heldout, settings, log_line), weights))


TASK = Task(FeatureScale, fit, ("recall@1", "recall@5", "mrr"), judge, "topomerge.embedding", "engineered.json", hours=0.3)
