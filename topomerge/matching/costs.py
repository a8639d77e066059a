"""Costs of pairing rooms: distances of their descriptors (seeds 3.3)."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from topomerge.embedding.turns import Rows, aligned
from topomerge.types import Array


def descriptor_costs(a: Rows, b: Rows, standardise: bool = False) -> Array:
    """(R_a, R_b) Euclidean distances of the rows of a (R_a, D) and b (R_b, D), over the root of D; where rooms have a row for
    each quarter turn, at that which both maps have to each other (`embedding.turns`).

    Args:
        standardise: scale each column by its standard deviation over the rooms of both maps first. Rooms that only one map has
            then change the costs of all, so it is not for descriptors that are scaled already.
    """
    a, b = aligned(a, b)
    if standardise and len(a) + len(b):
        spread = np.concatenate([a, b]).std(axis=0)
        scale = np.where(spread > 1e-9, spread, 1.0)
        a, b = a / scale, b / scale
    out: Array = cdist(a, b) / np.sqrt(max(a.shape[1], 1))
    return out


def similarities(cost: Array, temperature: float | None = None, dustbin: float | None = None) -> Array:
    """(R_a, R_b) 0..1 of each pair: softmax along its row times that along its column, each with the choice of no partner.

    Args:
        temperature: cost that divides likelihoods by e; a fifth of the median cost if None.
        dustbin: cost of having no partner; the median of each room's cheapest pair, times 1.5, if None.
    """
    if not cost.size:
        return np.zeros(cost.shape)
    t = temperature if temperature is not None else max(float(np.median(cost)) / 5, 1e-9)
    none = dustbin if dustbin is not None else usual_best(cost) * 1.5
    weight = np.exp(-np.clip(cost / t, 0, 600))
    bin_weight = np.exp(-min(none / t, 600))
    out: Array = weight / (weight.sum(axis=1, keepdims=True) + bin_weight) * weight / (weight.sum(axis=0) + bin_weight)
    return np.sqrt(out)


def usual_best(cost: Array) -> float:
    """Median over rooms of both maps of their cheapest pair's cost; 0 without any."""
    return float(np.median(np.concatenate([cost.min(axis=0), cost.min(axis=1)]))) if cost.size else 0.0


def best_partners(cost: Array, number: int) -> Array:
    """(P, 2) pairs that are among the `number` cheapest of their row or of their column, ascending."""
    if not cost.size:
        return np.zeros((0, 2), np.int64)
    keep = np.zeros(cost.shape, bool)
    columns = np.argsort(cost, axis=1, kind="stable")[:, :number]
    keep[np.arange(len(cost))[:, None], columns] = True
    rows = np.argsort(cost, axis=0, kind="stable")[:number]
    keep[rows, np.arange(cost.shape[1])[None]] = True
    return np.argwhere(keep)
