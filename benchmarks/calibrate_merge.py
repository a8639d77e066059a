"""Fit the coefficients by which merges are believed: ``topomerge/fusion/calibration.json``.

``python benchmarks/calibrate_merge.py gather [folder]`` judges the hypotheses of the cached training pairs
(`merge_pairs.py train`; resumable), one line of JSON a pair; ``... fit`` fits both logistic models on them, with cross-validation
over buildings, and prints what is accepted at several thresholds. Only training buildings may be gathered.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from merge_pairs import GridPair, load
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GroupKFold

from topomerge.fusion.evidence import plans
from topomerge.fusion.search import View, search, wrapped
from topomerge.fusion.verify import VECTOR, Judge, lead, rank, vector
from topomerge.types import Array, Sim3

ROWS = Path("cache/merge/features.jsonl")
VARIANTS = {"cells": False, "points": True}  # does a map know the middle of the points of each cell?
TARGET = Path("topomerge/fusion/calibration.json")
KEPT = 25  # hypotheses of a pair
RIGHT = (0.5, 5.0)  # m, degrees
STRENGTH = 0.3  # of the winners' model: the smaller, the simpler
THRESHOLD = 0.9  # above it no left-out training pair is merged wrongly; at 0.85 storeys of one plan are


def error(pose: Sim3, pair: GridPair) -> list[float] | None:
    """Horizontal and vertical error in the middle of what both saw, m, and of yaw, degrees; None where no pose is right."""
    if pair.truth is None or pair.about["kind"] != "overlap":
        return None
    middle = pair.anchor[None]
    off = (pose.apply(middle) - pair.truth.apply(middle))[0]
    return [float(np.hypot(*off[:2])), float(off[2]), float(np.degrees(abs(wrapped(pose.yaw - pair.truth.yaw))))]


def right(err: Sequence[float] | None, sensors: Sequence[str], limits: tuple[float, float] = RIGHT) -> bool:
    """Is a pose right? A slice says nothing of its height."""
    if err is None:
        return False
    flat = "laser2d" in sensors
    return (err[0] if flat else float(np.hypot(err[0], err[1]))) < limits[0] and err[2] < limits[1]


def gather(folder: str = "cache/merge/train") -> None:
    """Judge the hypotheses of every pair that is not in `ROWS` yet."""
    rows = map(json.loads, ROWS.read_text().splitlines() if ROWS.exists() else [])
    done = {(row["name"], row["variant"]) for row in rows}
    for path, variant in product(sorted(Path(folder).glob("*.npz")), VARIANTS):
        if (path.stem, variant) in done:
            continue
        pair = load(path, VARIANTS[variant])
        a, b = ([View(p) for p in plans(g, f)] for g, f in ((pair.a, pair.free[0]), (pair.b, pair.free[1])))
        judge = Judge(a, b)
        judged = [(f, error(c.pose, pair)) for c, f, _ in rank(search(a, b), judge)]
        about = {k: pair.about[k] for k in ("sensors", "kind", "building", "source")}
        hypotheses = [{**f, "err": e} for f, e in judged[:KEPT]]
        row = {"name": pair.name, "variant": variant, "common": pair.common, **about, "hyps": hypotheses}
        with ROWS.open("a") as out:
            out.write(json.dumps(row) + "\n")


def fitted(x: Array, y: Array, strength: float) -> dict[str, Any]:
    """Standardised logistic regression as plain numbers."""
    mean, scale = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-6)
    found = LogisticRegression(C=strength, max_iter=2000).fit((x - mean) / scale, y)
    return {"mean": mean.tolist(), "scale": scale.tolist(), "weight": found.coef_[0].tolist(), "bias": float(found.intercept_[0])}


def logits(model: dict[str, Any], x: Array) -> Array:
    """(n,) log odds."""
    out: Array = (x - model["mean"]) / model["scale"] @ np.array(model["weight"]) + model["bias"]
    return out


def winners(scores: Array, x: Array, owner: Array, pose: dict[str, Any]) -> tuple[Array, Array, Array]:
    """Row of the best hypothesis of each pair, its vector with both leads, and its share of the odds."""
    best, stacked, share = [], [], []
    for i in range(int(owner.max()) + 1):
        rows = np.flatnonzero(owner == i)
        rows = rows[np.argsort(-scores[rows], kind="stable")]
        margin, ahead, part = lead(scores[rows], x[rows], np.array(pose["weight"]), np.array(pose["scale"]))
        best.append(rows[0])
        stacked.append(np.append(x[rows[0]], [margin, ahead]))
        share.append(part)
    return np.array(best), np.array(stacked), np.array(share)


def fit() -> None:
    """Both models, and what left-out pairs say about them. Maps with and without the middles of points share the coefficients:
    models of their own were no better."""
    rows = [row for row in map(json.loads, ROWS.read_text().splitlines()) if row["hyps"] and fair(row)]
    owner = np.concatenate([[i] * len(row["hyps"]) for i, row in enumerate(rows)])
    x = np.array([vector(h) for row in rows for h in row["hyps"]])
    y = np.array([right(h["err"], row["sensors"]) for row in rows for h in row["hyps"]])
    _, building = np.unique([row["building"] for row in rows], return_inverse=True)
    pose, held = fitted(x, y, 1.0), np.zeros(len(y))
    for train, test in GroupKFold(8).split(x, y, building[owner]):
        held[test] = logits(fitted(x[train], y[train], 1.0), x[test])
    best, stacked, share = winners(held, x, owner, pose)
    true, believed = y[best], np.zeros(len(rows))
    for train, test in GroupKFold(8).split(stacked, true, building):
        believed[test] = share[test] / (1 + np.exp(-logits(fitted(stacked[train], true[train], STRENGTH), stacked[test])))
    report(rows, believed, true, np.array([y[owner == i].any() for i in range(len(rows))]))
    winner = fitted(stacked, true, STRENGTH)
    names = [*VECTOR, "margin", "ahead"]
    print({n: round(w, 2) for n, w in zip(names, winner["weight"], strict=True)})
    result = {"names": names, "threshold": THRESHOLD, "pairs": len(rows), "pose": pose, "winner": winner}
    TARGET.write_text(json.dumps(_rounded(result), indent=1) + "\n")


def fair(row: dict[str, Any]) -> bool:
    """Pairs that anybody could tell: twin wings of set 0 were the same walls and ceilings with furniture moved about."""
    return not (row["kind"] == "twin-wing" and row["name"].startswith("0_"))


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 5)
    if isinstance(value, list):
        return [_rounded(v) for v in value]
    return {k: _rounded(v) for k, v in value.items()} if isinstance(value, dict) else value


def kind_of(row: dict[str, Any]) -> str:
    """Bin by the area in common."""
    if row["kind"] != "overlap" or row["common"] < 1:
        return f"none ({row['kind']})"
    return next(name for limit, name in ((40, "<40"), (80, "40-80"), (200, "80-200"), (np.inf, ">200")) if row["common"] < limit)


def report(rows: Sequence[dict[str, Any]], believed: Array, true: Array, found: Array) -> None:
    """What is accepted at several thresholds, by bin; all out of fold."""
    for threshold in (0.5, 0.7, 0.8, THRESHOLD, 0.9, 0.95):
        bins: dict[str, list[int]] = {}
        for row, p, t, f in zip(rows, believed, true, found, strict=True):
            tally = bins.setdefault(kind_of(row), [0, 0, 0, 0, 0])
            for k, hit in enumerate((True, f, t, p >= threshold and t, p >= threshold and not t)):
                tally[k] += int(hit)
        print(f"threshold {threshold}: bin: pairs, right among hypotheses, right first, merged right, merged wrong")
        print("  " + "  ".join(f"{k}: {v}" for k, v in sorted(bins.items())))
    for i in np.argsort(-np.where(true, -1, believed))[:12]:
        row = rows[i]
        print(f"wrong, p {believed[i]:.2f}: {row['name']} {row['kind']} {row['sensors']} {row['common']:.0f} m2")
    order = np.argsort(believed)
    for part in np.array_split(order, 8):
        print(f"believed {believed[part].mean():.2f}  right {true[part].mean():.2f}  ({len(part)})")


if __name__ == "__main__":
    {"gather": gather, "fit": fit}[sys.argv[1]](*sys.argv[2:])
