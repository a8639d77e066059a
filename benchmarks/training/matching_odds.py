"""The weights of `topomerge/matching/odds.py`: how likely a hypothesis is right, and rooms that it lays over each other are one.

Run from the root: ``python -m benchmarks.training.matching_odds MANIFEST``, of pairs of the *training* split (``python -m
topomerge.datasets.pairs.build data=matching_train cache=cache/matching``). Hypotheses are searched in each pair, and in as
many of two
buildings; a softmax over the hypotheses and "none" is fitted to which one is right, and a logistic model to which rooms that
meet under the true transform are one true room. Prints both, and how often what they tell of left-out buildings is so.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from topomerge.datasets.pairs.evaluation_pair import KeptPair, load_set

from topomerge.fusion.fuse import rooms_in_common
from topomerge.matching.match import match
from topomerge.matching.odds import hypothesis_features, match_features
from topomerge.types import Array

RIGHT = (0.5, np.radians(5))  # m in the middle of what both maps saw, rad
FOLDS = 5
PULL = 0.05  # to 0, of all weights but the constant
BANDS = (0, 0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.97, 1.0)


class Found(NamedTuple):
    """Of a pair of maps: its building, features of its hypotheses and which are right; and of the pairs of rooms that meet."""

    building: str
    hypotheses: Array
    right: Array
    rooms: Array
    one: Array


def collect(manifest: Path) -> Iterator[Found]:
    """Of each pair, and of each map with one of another building."""
    pairs = [p for p in load_set(manifest) if p.transform is not None and len(p.matches)]
    for n, p in enumerate(pairs):
        a, own = p.maps()
        for b, true in ((own, True), (pairs[(n + 7) % len(pairs)].maps()[1], False)):
            hypotheses = match(a, b).alternatives
            off = [is_right(p, h.transform) for h in hypotheses] if true else [False] * len(hypotheses)
            evidence = np.array([list(h.features.values()) for h in hypotheses]).reshape(-1, 3)
            rooms, one = np.zeros((0, 5)), np.zeros(0, bool)
            if true and p.transform is not None:
                meet, fit = rooms_in_common(a, b, p.transform)
                rooms = match_features(a, b, meet, fit)
                one = (p.true[0][meet[:, 0]] == p.true[1][meet[:, 1]]) & (p.true[0][meet[:, 0]] >= 0)
            yield Found(str(p.about["building"]), hypothesis_features(evidence), np.array(off, bool), rooms, one)


def is_right(pair: KeptPair, pose: object) -> bool:
    """As merges are judged."""
    truth = pair.transform
    assert truth is not None
    off = np.linalg.norm((pose.apply(pair.anchor[None]) - truth.apply(pair.anchor[None]))[0])  # type: ignore[attr-defined]
    turn = (pose.yaw - truth.yaw + np.pi) % (2 * np.pi) - np.pi  # type: ignore[attr-defined]
    return bool(off < RIGHT[0] and abs(turn) < RIGHT[1])


def fit_hypotheses(found: Sequence[Found]) -> Array:
    """(4,) weights of the most likely softmax."""

    def loss(w: Array) -> float:
        total = PULL * float(w[1:] @ w[1:])
        for f in found:
            logits = np.append(f.hypotheses @ w, 0.0)
            total -= float(np.logaddexp.reduce(logits[np.append(f.right, not f.right.any())]) - np.logaddexp.reduce(logits))
        return total

    out: Array = minimize(loss, np.zeros(4)).x
    return out


def fit_rooms(found: Sequence[Found]) -> Array:
    """(5,) weights of the logistic model."""
    x, y = np.concatenate([f.rooms for f in found]), np.concatenate([f.one for f in found])

    def loss(w: Array) -> float:
        return PULL * float(w[1:] @ w[1:]) + float(np.logaddexp(0, np.where(y, -1, 1) * (x @ w)).sum())

    out: Array = minimize(loss, np.zeros(x.shape[1])).x
    return out


def told(found: Sequence[Found]) -> tuple[Array, Array]:
    """(n, 2) what is told and whether it is so, of left-out buildings: of the likeliest hypotheses, and of rooms that meet."""
    names = sorted({f.building for f in found})
    fold = np.random.default_rng(0).permutation(len(names)) % FOLDS
    first, rooms = [], []
    for k in range(FOLDS):
        out = {n for n, at in zip(names, fold, strict=True) if at == k}
        w, v = (fit([f for f in found if f.building not in out]) for fit in (fit_hypotheses, fit_rooms))
        for f in (f for f in found if f.building in out):
            if len(f.right):
                odds = np.exp(np.clip(f.hypotheses @ w, -50, 50))
                first.append((odds.max() / (odds.sum() + 1), f.right[odds.argmax()]))
            rooms += zip((1 / (1 + np.exp(-f.rooms @ v))).tolist(), f.one.tolist(), strict=True)
    return np.array(first, float), np.array(rooms, float)


def report(what: str, pairs: Array) -> None:
    """Bands of what was told, and the expected calibration error over them."""
    gap = 0.0
    for low, high in pairwise(BANDS):
        some = pairs[(pairs[:, 0] >= low) & (pairs[:, 0] < high + (high == 1))]
        if len(some):
            told, true = some.mean(axis=0)
            gap += len(some) / len(pairs) * abs(told - true)
            print(f"  {low:.2f} to {high:.2f}: {len(some)}, told {told:.2f}, so {true:.2f}")
    print(f"{what}: expected calibration error {gap:.3f} over {len(pairs)}")


def main(manifest: str) -> None:
    """Fit and print."""
    found = list(collect(Path(manifest)))
    for name, fit in (("HYPOTHESIS", fit_hypotheses), ("MATCH", fit_rooms)):
        print(name, "=", tuple(np.round(fit(found), 2).tolist()))
    for name, pairs in zip(("hypotheses", "rooms"), told(found), strict=True):
        report(name, pairs)


if __name__ == "__main__":
    main(sys.argv[1])
