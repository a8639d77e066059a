"""The fits of the belief in merges: logistic models in which what speaks for a merge never counts against it, weighed by the
stated priors of what a pair may be (`fusion.posterior`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize

from topomerge.numpy_nn import softmax
from topomerge.registration.posterior import KINDS, PRIORS, SAME_PLAN, WRONG
from topomerge.training.belief_hypotheses import kind_of
from topomerge.types import Array

LEAST_SPREAD = 1e-4  # the file of weights holds five decimals: less would be 0 there
SAME_PLAN_KINDS = {"storeys": "storey", "point-symmetric": "half"}  # kind of look-alikes -> what they are
THRESHOLDS = [round(0.5 + 0.01 * k, 2) for k in range(50)]
SIGN = {
    "ratio": 1, "walls": 1, "conflict": -1, "worst": -1, "free": 1, "opposed": -1, "lift": 1, "met": 1, "missed": -1, "share": 1,
    "level": -1, "ceilings": -1, "margin": 1, "ahead": 1, "tall": -1, "crossing": 1, "worst_ratio": 1, "squares": 1,
    "bad_squares": -1, "in_place": 1, "out_of_place": -1, "kept": 1, "moved_walls": -1, "hanging": 1, "fallen": -1, "held": 1,
    "alone": 1, "strain": -1, "doubted": -1, "place_mean": 1, "place_total": 1, "place_worst": 1,
    "furniture": 1, "furniture_sliced": 1,
}  # fmt: skip


def spread(x: Array) -> Array:
    """(k,) standard deviation of each column of (n, k); 1 of one that is the same throughout."""
    deviation: Array = x.std(axis=0)
    return np.where(deviation > LEAST_SPREAD, deviation, 1.0)


def fitted(x: Array, y: Array, names: Sequence[str], strength: float, weight: Array | None = None) -> dict[str, Any]:
    """Standardised logistic regression as plain numbers, in which what speaks for a merge never counts against it (`SIGN`)."""
    mean, scale = x.mean(axis=0), spread(x)
    z, sign = (x - mean) / scale, np.where(y, 1.0, -1.0)
    weight = np.ones(len(y)) if weight is None else weight

    def loss(t: Array) -> tuple[float, Array]:
        margin = sign * (z @ t[:-1] + t[-1])
        slope = -weight * sign / (1 + np.exp(margin))
        value = (weight * np.logaddexp(0, -margin)).sum() + (t[:-1] ** 2).sum() / (2 * strength)
        return float(value), np.append(z.T @ slope + t[:-1] / strength, slope.sum())

    bounds = [{1: (0, None), -1: (None, 0)}.get(SIGN.get(n, 0), (None, None)) for n in names] + [(None, None)]
    t = minimize(loss, np.zeros(len(names) + 1), jac=True, bounds=bounds, method="L-BFGS-B").x
    return {"mean": mean.tolist(), "scale": scale.tolist(), "weight": t[:-1].tolist(), "bias": float(t[-1])}


def logits(model: dict[str, Any], x: Array) -> Array:
    """(n,) log odds."""
    out: Array = (x - model["mean"]) / model["scale"] @ np.array(model["weight"]) + model["bias"]
    return out


def what_it_is(row: dict[str, Any], label: int) -> str:
    """Which of `POSTERIOR` is the truth of a pair whose best hypothesis is right (label 1) or not."""
    if label == 1:
        return "here"
    if row.get("lookalike"):
        return SAME_PLAN_KINDS.get(row["lookalike"], "wing")
    if row["kind"] == "overlap":
        return "outside" if kind_of(row).startswith("none") else "elsewhere"
    return {"other-storey": "storey", "twin-wing": "wing"}.get(row["kind"], "building")


def is_same_plan(row: dict[str, Any]) -> bool:
    """Is it a pair of places that were made of one plan, of which the one is not the other?"""
    return SAME_PLAN_KINDS.get(row.get("lookalike", ""), "") in SAME_PLAN


def plan_weights(alike: Array, weight: Array) -> Array:
    """(n,) weights of pairs that are of one place and of those that are alike by plan (n,) bool, as frequent as `PRIORS` state;
    their sum is that of `weight`."""
    out = np.zeros(len(alike))
    for mine, prior in ((alike, sum(PRIORS[name] for name in SAME_PLAN)), (~alike, PRIORS["here"])):
        if weight[mine].sum() > 0:
            out[mine] = prior * weight[mine] / weight[mine].sum()
    scaled: Array = out * weight.sum() / max(out.sum(), 1e-9)
    return scaled


def prior_weights(truth: Array, weight: Array) -> Array:
    """(n,) weights under which the kinds of pairs are as frequent as `PRIORS` state; kinds that are missing are left out. Their
    sum is that of `weight`."""
    out = np.zeros(len(truth))
    for kind, prior in PRIORS.items():
        mine = truth == kind
        if weight[mine].sum() > 0:
            out[mine] = prior * weight[mine] / weight[mine].sum()
    scaled: Array = out * weight.sum() / max(out.sum(), 1e-9)
    return scaled


def risk_curve(believed: Array, true: Array, truth: Array, weight: Array) -> list[list[float]]:
    """(threshold, false merges in a thousand pairs) for rising thresholds: of pairs drawn by `PRIORS`, by what left-out pairs
    show; kinds of which there are none count nothing.

    Args:
        believed, true: (n,) probability of the best hypothesis of each pair, and is it right (1), wrong (0) or neither?
        truth: (n,) what it is, of `POSTERIOR`.
        weight: (n,) of each pair among those of its kind.
    """
    kinds = {kind: (truth == kind) & (true == 0) for kind in WRONG}
    least = min((1000 * PRIORS[kind] / int(mine.sum()) for kind, mine in kinds.items() if mine.any()), default=0.0)
    curve: list[list[float]] = []
    for threshold in THRESHOLDS:
        false = 0.0
        for kind, mine in kinds.items():
            if mine.any():
                false += 1000 * PRIORS[kind] * float(np.average(believed[mine] >= threshold, weights=weight[mine]))
        false = max(false, least)  # less than one pair of a kind was not measured
        curve.append([threshold, min(false, curve[-1][1]) if curve else false])
    return curve


def fitted_kinds(x: Array, truth: Array, weight: Array, strength: float) -> dict[str, Any]:
    """Standardised multinomial logistic regression: what it is (`KINDS`) where the best hypothesis is wrong."""
    mean, scale = x.mean(axis=0), spread(x)
    z = np.column_stack([(x - mean) / scale, np.ones(len(x))])
    one = (truth[:, None] == np.array(KINDS)).astype(float)

    def loss(flat: Array) -> tuple[float, Array]:
        w = flat.reshape(len(KINDS), -1)
        chance = softmax(z @ w.T)
        pull = np.pad(w[:, :-1], ((0, 0), (0, 1))) / strength
        value = -(weight * np.log(np.maximum((chance * one).sum(axis=1), 1e-12))).sum() + (w[:, :-1] ** 2).sum() / (2 * strength)
        return float(value), ((weight[:, None] * (chance - one)).T @ z + pull).ravel()

    w = minimize(loss, np.zeros(len(KINDS) * z.shape[1]), jac=True, method="L-BFGS-B").x.reshape(len(KINDS), -1)
    return {"mean": mean.tolist(), "scale": scale.tolist(), "weight": w[:, :-1].tolist(), "bias": w[:, -1].tolist()}


def folds(groups: Array, count: int, ordinary: int) -> Iterator[tuple[Array, Array]]:
    """Rows to train on and rows to test on; no group is in both. Groups from `ordinary` on (of look-alikes) are dealt in turn, so
    that the folds of the others are the same without them."""
    first = int(groups[groups < ordinary].max(initial=-1)) + 1
    of = np.append(np.random.default_rng(0).permutation(first), np.arange(first, groups.max() + 1))[groups] % count
    for k in range(count):
        yield np.flatnonzero(of != k), np.flatnonzero(of == k)
