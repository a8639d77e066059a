"""Task `merge_belief`: the logistic models by which hypotheses are ranked and merges believed (`fusion.verify`).

Fitted to the hypotheses of pairs of grids (`belief_hypotheses`): one model sees each hypothesis by itself, a second one the best
of a pair. What is reported comes from cross-validation over buildings.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from topomerge.errors import InputError
from topomerge.fusion.verify import (
    BEND_VECTOR,
    LEAD_VECTOR,
    POSE_VECTOR,
    WINNER_VECTOR,
    bend_vector,
    lead,
    model,
    vector,
    winner_vector,
)
from topomerge.training.belief_hypotheses import belief_rows, fair, kind_of, right
from topomerge.training.belief_lookalikes import lookalike_rows, lookalike_scores
from topomerge.training.closed_form import Fitted, calibration_error, run_fit
from topomerge.training.loop import Say
from topomerge.training.task_settings import MergeBelief
from topomerge.types import Array

BENT = (1.5, 5.0)  # m, degrees: a map that is bent by drift fits in no one pose; neither right nor wrong
BENDING_STRENGTH = 10.0  # of four numbers: next to free
BENT_FEATURES = (*POSE_VECTOR, *WINNER_VECTOR, *BEND_VECTOR)  # of the best hypothesis, once the maps are bent
BELIEF_FEATURES = [*POSE_VECTOR, *LEAD_VECTOR, *WINNER_VECTOR, *BEND_VECTOR]
SIGN = {
    "ratio": 1, "walls": 1, "conflict": -1, "worst": -1, "free": 1, "opposed": -1, "lift": 1, "met": 1, "missed": -1, "share": 1,
    "level": -1, "ceilings": -1, "margin": 1, "ahead": 1, "tall": -1, "crossing": 1, "worst_ratio": 1, "squares": 1,
    "bad_squares": -1, "in_place": 1, "out_of_place": -1, "kept": 1, "moved_walls": -1, "hanging": 1, "fallen": -1, "held": 1,
    "alone": 1, "odds": 1, "strain": -1, "doubted": -1,
}  # fmt: skip


def fit(settings: MergeBelief, say: Say) -> dict[str, float]:
    """Fit both pairs of models; the scores of the cross-validation.

    Raises:
        InputError: too few pairs.
    """
    return run_fit(settings, fit_belief, say)


def fit_belief(settings: MergeBelief, say: Say) -> Fitted:
    """The models for pairs of maps with heights, from all pairs without drawings, and those for slices and drawings, from all
    pairs; what left-out pairs say about them is reported of the pairs that each is for."""
    rows = [row for row in belief_rows(settings.data, settings, say) if row["hyps"] and fair(row)]
    rows += [row for row in lookalike_rows(settings.alike, settings, say) if row["hyps"]]
    weights: dict[str, Any] = {"names": BELIEF_FEATURES, "threshold": settings.threshold}
    metrics: dict[str, float] = {}
    parts = []
    for name, flat in (("solid", False), ("flat", True)):
        chosen = rows if flat else [row for row in rows if "drawing" not in row["sensors"]]
        weights[name], scored = fit_models(chosen, flat, settings)
        parts.append(scored)
        metrics |= {f"{key}_{name}": value for key, value in belief_scores(*ordinary(*scored), settings.threshold).items()}
    rows_scored = [row for part in parts for row in part[0]]
    believed, true = (np.concatenate([part[k] for part in parts]) for k in (1, 2))
    metrics |= belief_scores(*ordinary(rows_scored, believed, true), settings.threshold)
    metrics |= lookalike_scores(rows_scored, believed, true, settings.threshold)
    say(believed_by_kind(rows_scored, believed, true, settings.threshold))
    trained = sum(not row.get("judged_only") for row in rows)
    origin = {"set": settings.data.name, "split": settings.data.split, "pairs": trained, "lookalikes": settings.lookalikes}
    return Fitted(weights=_rounded(weights), metrics=metrics, origin=origin)


def fitted(x: Array, y: Array, names: Sequence[str], strength: float, weight: Array | None = None) -> dict[str, Any]:
    """Standardised logistic regression as plain numbers, in which what speaks for a merge never counts against it (`SIGN`)."""
    mean, scale = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-6)
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


def label(hypothesis: dict[str, Any], row: dict[str, Any]) -> int:
    """1 right, 0 wrong, -1 neither: a map that is bent by drift fits in no one pose."""
    err = hypothesis["err"]
    return 1 if right(err, row["sensors"]) else -1 if right(err, row["sensors"], BENT) else 0


@dataclass(frozen=True, eq=False)
class Table:
    """All hypotheses of all pairs: of which pair (`owner`), what the first model sees (`x`), right or not (`y`: `label`), what
    is known from looking closer (`near`; nan where nobody did). Of each pair its building, and whether it trains; the first
    `ordinary` buildings are those of ordinary pairs."""

    rows: list[dict[str, Any]]
    owner: Array
    x: Array
    y: Array
    near: Array
    building: Array
    trains: Array
    ordinary: int


def tabled(rows: list[dict[str, Any]]) -> Table:
    """Hypotheses as arrays."""
    hypotheses = [(i, h) for i, row in enumerate(rows) for h in row["hyps"]]
    near = [_closely(h["bent"]) if "bent" in h else np.full(len(BENT_FEATURES), np.nan) for _, h in hypotheses]
    names = [f"{int('lookalike' in row)}{row['building'].split(' + ')[0]}" for row in rows]  # ordinary ones first
    y = np.array([label(h, rows[i]) for i, h in hypotheses])
    x = np.array([vector(h) for _, h in hypotheses])
    trains = np.array([not row.get("judged_only") for row in rows], bool)
    owner, building = np.array([i for i, _ in hypotheses]), np.unique(names, return_inverse=True)[1]
    return Table(rows, owner, x, y, np.array(near), building, trains, len({name for name in names if name[0] == "0"}))


def _closely(bent: dict[str, float]) -> Array:
    """What the second model sees of a hypothesis, but for how far it is ahead."""
    return np.concatenate([vector(bent), winner_vector(bent), bend_vector(bent)])


def best(t: Table, scores: Array, pose: dict[str, Any], i: int, wrong: bool = False) -> tuple[int, Array, float] | None:
    """Row of the best hypothesis of pair i (of the wrong ones only, as if no search had found a right one), what the
    second model sees of it, and its share of the odds."""
    rows = np.flatnonzero((t.owner == i) & ((t.y == 0) | (not wrong)))
    rows = rows[np.argsort(-scores[rows], kind="stable")]
    if not len(rows) or np.isnan(t.near[rows[0]]).any():
        return None
    leads = lead(scores[rows], t.x[rows], np.array(pose["weight"]), np.array(pose["scale"]))
    near, whole = t.near[rows[0]], len(POSE_VECTOR)
    return int(rows[0]), np.concatenate([near[:whole], leads[:3], near[whole:]]), leads[3]


def folds(groups: Array, count: int, ordinary: int) -> Iterator[tuple[Array, Array]]:
    """Rows to train on and rows to test on; no group is in both. Groups from `ordinary` on (of look-alikes) are dealt in turn, so
    that the folds of the others are the same without them."""
    first = int(groups[groups < ordinary].max(initial=-1)) + 1
    of = np.append(np.random.default_rng(0).permutation(first), np.arange(first, groups.max() + 1))[groups] % count
    for k in range(count):
        yield np.flatnonzero(of != k), np.flatnonzero(of == k)


def fit_models(rows: list[dict[str, Any]], flat: bool, settings: MergeBelief) -> tuple[dict[str, Any], tuple[Any, Array, Array]]:
    """Both models of these pairs; and of those that are flat, or are not: the rows, what left-out buildings' models believe of
    their best hypothesis, and its label.

    Raises:
        InputError: too few pairs or buildings.
    """
    t = tabled(rows)
    sure = (t.y >= 0) & t.trains[t.owner]
    if len(np.unique(t.building)) < 2 or len(np.unique(t.y[sure] > 0)) < 2:
        raise InputError("data.sets: too few pairs: right and wrong hypotheses of two buildings are needed")
    pose, scores = fitted(t.x[sure], t.y[sure] > 0, POSE_VECTOR, settings.pose_strength), np.zeros(len(t.y))
    if settings.refit == "bending":
        pose = model()["flat" if flat else "solid"]["pose"]
        scores = logits(pose, t.x)
    for train, test in folds(t.building[t.owner], settings.folds, t.ordinary) if settings.refit == "all" else ():
        train = train[sure[train]]
        scores[test] = logits(fitted(t.x[train], t.y[train] > 0, POSE_VECTOR, settings.pose_strength), t.x[test])
    first = [(i, b) for i in range(len(t.rows)) if (b := best(t, scores, pose, i)) is not None]
    others = [(i, best(t, scores, pose, i, True)) for i, _ in first if (t.y[t.owner == i] > 0).any()]
    both = [*first, *((i, b) for i, b in others if b is not None)]
    x = np.array([b[1] for _, b in both])
    y = np.array([t.y[b[0]] for _, b in first] + [0] * (len(both) - len(first)))
    share = np.array([b[2] for _, b in first])
    building = np.array([t.building[i] for i, _ in both])
    certain = (y >= 0) & np.array([t.trains[i] for i, _ in both])
    missed = np.where(np.arange(len(y)) < len(first), 1.0, settings.missed)
    weight = missed * np.where(flat & (y == 0), settings.strict, 1.0)
    believed = np.zeros(len(y))
    for train, test in folds(building, settings.folds, t.ordinary):
        train = train[certain[train]]
        left_out = _winner(x[train], y[train] > 0, weight[train], flat, settings)
        believed[test] = 1 / (1 + np.exp(-logits(left_out, x[test])))
    winner = _winner(x[certain], y[certain] > 0, weight[certain], flat, settings)
    same_kind = np.array([is_flat(t.rows[i]) == flat for i, _ in first], bool)
    scored = [t.rows[i] for (i, _), so in zip(first, same_kind, strict=True) if so]
    fit_of = {"pairs": int(sum(t.trains[i] for i, _ in first)), "pose": pose, "winner": winner}
    return fit_of, (scored, np.minimum(believed[: len(first)], share)[same_kind], y[: len(first)][same_kind])


def _winner(x: Array, y: Array, weight: Array, flat: bool, settings: MergeBelief) -> dict[str, Any]:
    """The model of the best hypothesis: all of it, or (`refit` "bending") the one that is there, with what bending adds and a new
    scale of its log odds: four numbers, for which a few hundred pairs are enough."""
    if settings.refit == "all":
        return fitted(x, y, BELIEF_FEATURES, settings.winner_strength, weight)
    whole = len(BELIEF_FEATURES) - len(BEND_VECTOR)
    before = model()["flat" if flat else "solid"]["winner"]
    before = {**before, **{k: before[k][:whole] for k in ("mean", "scale", "weight")}}
    odds = logits(before, x[:, :whole])
    added = fitted(np.column_stack([odds, x[:, whole:]]), y, ["odds", *BEND_VECTOR], BENDING_STRENGTH, weight)
    slope = added["weight"][0] / added["scale"][0]
    return {
        "mean": [*before["mean"], *added["mean"][1:]],
        "scale": [*before["scale"], *added["scale"][1:]],
        "weight": [*(slope * np.array(before["weight"])).tolist(), *added["weight"][1:]],
        "bias": float(slope * (before["bias"] - added["mean"][0]) + added["bias"]),
    }


def belief_scores(rows: Sequence[dict[str, Any]], believed: Array, true: Array, threshold: float) -> dict[str, float]:
    """Of pairs: log loss and calibration error of the belief, the shares that are right first, right and believed, and wrong and
    believed. Pairs that fit in no one pose (`label` -1) count as neither right nor wrong."""
    sure = true >= 0
    p, y = np.clip(believed[sure], 1e-6, 1 - 1e-6), true[sure] == 1
    if not len(y):
        return {}
    return {
        "log_loss": float(-np.mean(np.log(np.where(y, p, 1 - p)))),
        "calibration_error": calibration_error(p, y),
        "right_first": float(y.mean()),
        "right_believed": float((y & (p >= threshold)).mean()),
        "wrong_believed": float((~y & (p >= threshold)).mean()),
        "pairs": float(len(rows)),
    }


def ordinary(rows: Sequence[dict[str, Any]], believed: Array, true: Array) -> tuple[list[dict[str, Any]], Array, Array]:
    """What is scored, without look-alikes: they would change the shares of all others."""
    chosen = np.array(["lookalike" not in row for row in rows], bool)
    return [row for row, so in zip(rows, chosen, strict=True) if so], np.asarray(believed)[chosen], np.asarray(true)[chosen]


def believed_by_kind(rows: Sequence[dict[str, Any]], believed: Array, true: Array, threshold: float) -> str:
    """A line: of each bin of area in common how many pairs there are, are right first, rightly and falsely believed."""
    bins: dict[str, list[int]] = {}
    for row, p, t in zip(rows, believed, true, strict=True):
        tally = bins.setdefault(kind_of(row), [0, 0, 0, 0])
        for k, hit in enumerate((True, t == 1, p >= threshold and t == 1, p >= threshold and t == 0)):
            tally[k] += int(hit)
    counts = "; ".join(f"{kind} {tally}" for kind, tally in sorted(bins.items()))
    return f"pairs, right first, merged right, merged wrong: {counts}"


def judge(settings: MergeBelief, file: Path, say: Say) -> dict[str, Any]:
    """Scores of weights on pairs of buildings that trained nothing."""
    weights = json.loads(file.read_text(encoding="utf-8"))
    rows = [row for row in belief_rows(settings.heldout, settings, say) if row["hyps"] and fair(row)]
    rows += [row for row in lookalike_rows(settings.alike_heldout, settings, say) if row["hyps"]]
    scored_rows, believed, true = [], [], []
    for name, flat in (("solid", False), ("flat", True)):
        of = [row for row in rows if is_flat(row) == flat]
        if not of:
            continue
        t, models = tabled(of), weights[name]
        scores = logits(models["pose"], t.x)
        for i, row in enumerate(of):
            if (first := best(t, scores, models["pose"], i)) is not None:
                odds = float(logits(models["winner"], first[1][None])[0])
                scored_rows.append(row)
                believed.append(min(1 / (1 + np.exp(-odds)), first[2]))
                true.append(t.y[first[0]])
    if not scored_rows:
        raise InputError(f"{settings.heldout.name}: no pair has a hypothesis that can be judged")
    threshold = float(weights["threshold"])
    say(believed_by_kind(scored_rows, np.array(believed), np.array(true), threshold))
    judged = belief_scores(*ordinary(scored_rows, np.array(believed), np.array(true)), threshold)
    return judged | lookalike_scores(scored_rows, np.array(believed), np.array(true), threshold)


def is_flat(row: dict[str, Any]) -> bool:
    """Is a map of the pair a slice or a drawing?"""
    return not {"laser2d", "drawing"}.isdisjoint(row["sensors"])


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 5)
    if isinstance(value, list):
        return [_rounded(v) for v in value]
    return {k: _rounded(v) for k, v in value.items()} if isinstance(value, dict) else value
