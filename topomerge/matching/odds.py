"""How likely what geometry proposes is so: a hypothesis, and that two rooms which it lays over each other are one room.

Logistic models, fitted to 100 simulated training pairs by ``train.py task=match_odds``; their weights stand in `odds.json`.
Of left-out buildings the expected calibration error was 0.05 for hypotheses and 0.01 for matches under the true transform.
"""

from __future__ import annotations

import numpy as np

from topomerge.errors import InputError
from topomerge.io.weight_files import read_weights_json
from topomerge.types import Array, TopometricMap, mostly_unseen

CONFLICT = 2.0  # weight of a metre that disagrees against one that agrees
FLOOR = 0.1  # m of wall that a m2 of floor in common is worth
SCRAP = 0.5  # m2
ODDS_LENGTHS = {"hypothesis": 4, "match": 5}
HYPOTHESIS, MATCH = "hypothesis", "match"  # weights of `hypothesis_features`, against "none", and of `match_features`


def odds_weights(model: str) -> Array:
    """(4,) or (5,) weights of one of both models.

    Raises:
        InputError: `odds.json` holds none of that length.
    """
    weights = np.array(read_weights_json("topomerge.matching", "odds.json").get(model, ()), float)
    if weights.shape != (ODDS_LENGTHS[model],) or not np.isfinite(weights).all():
        raise InputError(f"odds.json: {model} must be {ODDS_LENGTHS[model]} numbers: run train.py task=match_odds export=package")
    return weights


def hypothesis_features(evidence: Array) -> Array:
    """(H, 4) what the odds of a hypothesis depend on: 1, the amount of evidence, the share that conflicts, and the score, from
    metres that agree, metres that conflict and m2 of floor in common (H, 3)."""
    agree, conflict, floor = evidence.T
    score = agree - CONFLICT * conflict + FLOOR * floor
    return np.stack([np.ones(len(agree)), np.log1p(agree), conflict / (agree + 3), score / 10], axis=1)


def hypothesis_probability(evidence: Array) -> Array:
    """(H,) that each is the right one; with "none of them" they sum to 1."""
    odds = np.exp(np.clip(hypothesis_features(evidence) @ odds_weights(HYPOTHESIS), -50, 50))
    out: Array = odds / (odds.sum() + 1)
    return out


def match_features(a: TopometricMap, b: TopometricMap, rooms: Array, fit: Array) -> Array:
    """(M, 5) 1, how well two rooms fit, log m2 of the smaller one, how many of both are mostly unseen, and whether one of
    both is in several matches.

    Args:
        rooms, fit: (M, 2), (M,) of `consistency.matches_under`.
    """
    i, j = rooms.T
    smaller = np.maximum(np.minimum(a.rooms["area"][i], b.rooms["area"][j]), SCRAP)
    unseen = mostly_unseen(a.rooms)[i].astype(float) + mostly_unseen(b.rooms)[j]
    several = (np.bincount(i, minlength=1)[i] > 1) | (np.bincount(j, minlength=1)[j] > 1)
    return np.stack([np.ones(len(fit)), fit, np.log(smaller), unseen, several], axis=1)


def match_probability(a: TopometricMap, b: TopometricMap, rooms: Array, fit: Array) -> Array:
    """(M,) that rooms which share floor under the right transform are one: scraps, glimpses and pieces of a room seldom are."""
    out: Array = 1 / (1 + np.exp(-match_features(a, b, rooms, fit) @ odds_weights(MATCH)))
    return out
