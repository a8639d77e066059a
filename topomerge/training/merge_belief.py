"""Task `merge_belief`: the logistic models by which hypotheses are ranked and accepted."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from topomerge.datasets.pairs.evaluation_pair import convert_to_sim3
from topomerge.errors import InputError
from topomerge.matching.poses import PoseHypothesis, select_distinct_hypotheses
from topomerge.numpy_nn import softmax
from topomerge.registration.posterior import KINDS, PRIORS, SAME_PLAN, WRONG, find_threshold
from topomerge.registration.verify import (
    BASIN,
    BELIEF_VECTOR,
    BENT_POSE_VECTOR,
    PLAN_VECTOR,
    POSE_VECTOR,
    Features,
    compute_belief_vector,
    compute_bent_pose_vector,
    compute_lead,
    compute_plan_odds,
    compute_plan_vector,
    compute_pose_vector,
    load_model,
)
from topomerge.training.belief_hypotheses import (
    build_belief_rows,
    build_floor_rows,
    build_lookalike_rows,
    classify_pair,
    is_distinguishable,
    score_lookalikes,
)
from topomerge.training.closed_form import FitResult, compute_calibration_error, run_fit
from topomerge.training.packed_pairs import name_building
from topomerge.training.task_settings import MergeBelief
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn

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


def compute_spread(x: Array) -> Array:
    """Compute (k,) standard deviation of each column of (n, k); 1 of one that is the same throughout."""
    deviation: Array = x.std(axis=0)
    return np.where(deviation > LEAST_SPREAD, deviation, 1.0)


def fit_logistic(x: Array, y: Array, names: Sequence[str], strength: float, weight: Array | None = None) -> dict[str, Any]:
    """Fit a standardised logistic regression, as plain numbers, in which what speaks for a merge never counts against it
    (`SIGN`)."""
    mean, scale = x.mean(axis=0), compute_spread(x)
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


def compute_logits(model: dict[str, Any], x: Array) -> Array:
    """Compute (n,) log odds."""
    out: Array = (x - model["mean"]) / model["scale"] @ np.array(model["weight"]) + model["bias"]
    return out


def classify_truth(row: dict[str, Any], label: int) -> str:
    """Classify the truth of a pair as one of `POSTERIOR`, by whether its best hypothesis is right (label 1) or not."""
    if label == 1:
        return "here"
    if row.get("lookalike"):
        return SAME_PLAN_KINDS.get(row["lookalike"], "wing")
    if row["kind"] == "overlap":
        return "outside" if classify_pair(row).startswith("none") else "elsewhere"
    return {"other-storey": "storey", "twin-wing": "wing"}.get(row["kind"], "building")


def is_same_plan(row: dict[str, Any]) -> bool:
    """Return whether the pair shows two places that were made of one plan."""
    return SAME_PLAN_KINDS.get(row.get("lookalike", ""), "") in SAME_PLAN


def weight_by_plan(alike: Array, weight: Array) -> Array:
    """Return (n,) weights of pairs that are of one place and of those that are alike by plan (n,) bool, as frequent as `PRIORS`
    state; their sum is that of `weight`."""
    out = np.zeros(len(alike))
    for mine, prior in ((alike, sum(PRIORS[name] for name in SAME_PLAN)), (~alike, PRIORS["here"])):
        if weight[mine].sum() > 0:
            out[mine] = prior * weight[mine] / weight[mine].sum()
    scaled: Array = out * weight.sum() / max(out.sum(), 1e-9)
    return scaled


def weight_by_prior(truth: Array, weight: Array) -> Array:
    """Return (n,) weights under which the kinds of pairs are as frequent as `PRIORS` state; kinds that are missing are left out.
    Their sum is that of `weight`."""
    out = np.zeros(len(truth))
    for kind, prior in PRIORS.items():
        mine = truth == kind
        if weight[mine].sum() > 0:
            out[mine] = prior * weight[mine] / weight[mine].sum()
    scaled: Array = out * weight.sum() / max(out.sum(), 1e-9)
    return scaled


def compute_risk_curve(accepted: Array, true: Array, truth: Array, weight: Array) -> list[list[float]]:
    """Compute (threshold, false merges in a thousand pairs) for rising thresholds: of pairs drawn by `PRIORS`, by what left-out
    pairs show; kinds of which there are none count nothing.

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
                false += 1000 * PRIORS[kind] * float(np.average(accepted[mine] >= threshold, weights=weight[mine]))
        false = max(false, least)  # less than one pair of a kind was not measured
        curve.append([threshold, min(false, curve[-1][1]) if curve else false])
    return curve


def fit_multinomial(x: Array, truth: Array, weight: Array, strength: float) -> dict[str, Any]:
    """Fit standardised multinomial logistic regression: what it is (`KINDS`) where the best hypothesis is wrong."""
    mean, scale = x.mean(axis=0), compute_spread(x)
    z = np.column_stack([(x - mean) / scale, np.ones(len(x))])
    one = (truth[:, None] == np.array(KINDS)).astype(float)

    def loss(flat: Array) -> tuple[float, Array]:
        w = flat.reshape(len(KINDS), -1)
        probability = softmax(z @ w.T)
        penalty = np.pad(w[:, :-1], ((0, 0), (0, 1))) / strength
        value = -(weight * np.log(np.maximum((probability * one).sum(axis=1), 1e-12))).sum() + (w[:, :-1] ** 2).sum() / (
            2 * strength
        )
        return float(value), ((weight[:, None] * (probability - one)).T @ z + penalty).ravel()

    w = minimize(loss, np.zeros(len(KINDS) * z.shape[1]), jac=True, method="L-BFGS-B").x.reshape(len(KINDS), -1)
    return {"mean": mean.tolist(), "scale": scale.tolist(), "weight": w[:, :-1].tolist(), "bias": w[:, -1].tolist()}


def iter_folds(groups: Array, count: int, ordinary: int) -> Iterator[tuple[Array, Array]]:
    """Yield rows to train on and rows to test on; no group is in both. Groups from `ordinary` on (of look-alikes) are dealt in
    turn, so that the folds of the others are the same without them."""
    first = int(groups[groups < ordinary].max(initial=-1)) + 1
    of = np.append(np.random.default_rng(0).permutation(first), np.arange(first, groups.max() + 1))[groups] % count
    for k in range(count):
        yield np.flatnonzero(of != k), np.flatnonzero(of == k)


def fit(settings: MergeBelief, log_line: LogFn) -> dict[str, float]:
    """Fit both pairs of models; the scores of the cross-validation.

    Raises:
        InputError: too few pairs.
    """
    return run_fit(settings, fit_belief, log_line)


def fit_belief(settings: MergeBelief, log_line: LogFn) -> FitResult:
    """Fit the models for pairs of maps with heights, from all pairs without drawings, and those for slices and drawings, from all
    pairs; what left-out pairs say about them is reported of the pairs that each is for."""
    rows = [row for row in build_belief_rows(settings.data, settings, log_line) if row["hyps"] and is_distinguishable(row)]
    rows += [row for row in build_lookalike_rows(settings.alike, settings, log_line) if row["hyps"]]
    rows += build_floor_rows(settings, log_line)
    weights: dict[str, Any] = {"names": BELIEF_VECTOR}
    parts = {}
    for name, flat in (("solid", False), ("flat", True)):
        chosen = rows if flat else [row for row in rows if "drawing" not in row["sensors"]]
        weights[name], parts[name] = fit_models(chosen, flat, settings)
    rows_scored = [row for part in parts.values() for row in part[0]]
    accepted, true = (np.concatenate([part[k] for part in parts.values()]) for k in (1, 2))
    weights["risk"] = compute_left_out_risk(rows_scored, accepted, true)
    least = weights["risk"][-1][1]
    weights["threshold"] = threshold = find_threshold(max(settings.risk, least, 1e-9), weights["risk"])
    metrics = {
        f"{key}_{name}": v
        for name, part in parts.items()
        for key, v in score_beliefs(*select_scored_rows(*part), threshold).items()
    }
    metrics |= score_beliefs(*select_scored_rows(rows_scored, accepted, true), threshold)
    metrics |= score_lookalikes(rows_scored, accepted, true, threshold)
    log_line(format_beliefs_by_kind(rows_scored, accepted, true, threshold))
    trained = sum(not row.get("judged_only") for row in rows)
    origin = {"set": settings.data.name, "split": settings.data.split, "pairs": trained, "lookalikes": settings.lookalikes}
    return FitResult(weights=_round_values(weights), metrics=metrics | {"threshold": threshold}, origin=origin)


def compute_left_out_risk(rows: Sequence[dict[str, Any]], accepted: Array, true: Array) -> list[list[float]]:
    """Return `compute_risk_curve` of pairs that were left out, but for what nobody can tell apart, what trains nothing, and the
    floor."""
    no = [row.get("tellable") is False or row.get("judged_only") or row.get("real") for row in rows]
    chosen = ~np.array(no, bool)
    truth = np.array([classify_truth(row, int(t)) for row, t in zip(rows, true, strict=True)])
    weight = np.array([row.get("weight", 1.0) for row in rows])
    return compute_risk_curve(accepted[chosen], true[chosen], truth[chosen], weight[chosen])


@dataclass(frozen=True, eq=False)
class Table:
    """Hypotheses of pairs: of which pair (`owner`), what the model of rigid poses sees (`x`), right or not (`y`: `label_error`);
    what the model of bent maps sees (`bent`; nan where nobody looked closely), further features (`closely`), where it lies then
    (`poses`), and does registration look at it closely (`rival`)? Of each pair its building, and whether it trains; the first
    `ordinary` buildings are those of ordinary pairs."""

    rows: list[dict[str, Any]]
    owner: Array
    x: Array
    y: Array
    bent: Array
    closely: list[Features]
    poses: Array
    rival: Array
    building: Array
    trains: Array
    ordinary: int

    @property
    def is_inspected(self) -> Array:
        """(n,) bool: was it looked at closely?"""
        return ~np.isnan(self.bent[:, 0])


def build_hypothesis_table(rows: list[dict[str, Any]]) -> Table:
    """Build hypotheses as arrays."""
    owner = np.array([i for i, row in enumerate(rows) for _ in row["hyps"]])
    hyps = [h for row in rows for h in row["hyps"]]
    nothing = np.full(len(BENT_POSE_VECTOR), np.nan)
    poses = np.array([h.get("bent_pose", np.full((4, 4), np.nan)) for h in hyps], float)
    names = [f"{int('lookalike' in row)}{name_building(row)}" for row in rows]  # ordinary ones first
    return Table(
        rows, owner, np.array([compute_pose_vector(h) for h in hyps]), np.array([h["label"] for h in hyps]),
        np.array([compute_bent_pose_vector(h["bent"]) if "bent" in h else nothing for h in hyps]), [h.get("bent",
        {}) for h in hyps],
        poses, np.array([bool(h.get("rival")) for h in hyps]), np.unique(names, return_inverse=True)[1],
        np.array([not row.get("judged_only") for row in rows], bool), len({name for name in names if name[0] == "0"}),
    )  # fmt: skip


def find_best_hypothesis(
    t: Table, scores: Array, bent: dict[str, Any], i: int, wrong: bool = False
) -> tuple[int, Array, float, Array] | None:
    """Return the row of the best hypothesis of pair i (of the wrong ones only, as if no search had found a right one), what the
    second model sees of it, its share of the odds, and what the model of places of one plan sees of it."""
    rows = np.flatnonzero((t.owner == i) & t.is_inspected & ((t.y == 0) if wrong else t.rival))
    rows = rows[np.argsort(-scores[rows], kind="stable")]
    if not len(rows):
        return None
    rows = rows[_find_distinct_poses(t.poses[rows], np.array(t.rows[i]["middle"]))]
    leads = compute_lead(scores[rows], t.bent[rows], np.array(bent["weight"]), np.array(bent["scale"]))
    first = int(rows[0])
    return (
        first,
        compute_belief_vector(t.bent[first], leads[:3], t.closely[first]),
        leads[3],
        compute_plan_vector(t.closely[first]),
    )


def _find_distinct_poses(poses: Array, middle: Array) -> list[int]:
    """Return which of ranked poses (n, 4, 4) end in no better one's place (as `matching.poses.select_distinct_hypotheses`)."""
    hypotheses = [PoseHypothesis(convert_to_sim3(pose)) for pose in poses]  # type: ignore[arg-type]
    single = {id(h) for h in select_distinct_hypotheses(hypotheses, middle, BASIN)}
    return [k for k, h in enumerate(hypotheses) if id(h) in single]


def fit_models(rows: list[dict[str, Any]], flat: bool, settings: MergeBelief) -> tuple[dict[str, Any], tuple[Any, Array, Array]]:
    """Fit the models of these pairs; return them, and of those that are flat, or are not: the rows, what left-out buildings'
    models believe of their best hypothesis, and its label.

    Raises:
        InputError: too few pairs or buildings.
    """
    t = build_hypothesis_table(rows)
    ranking, scores = fit_ranking(t, flat, settings)
    w = collect_best_hypotheses(t, scores, ranking["bent"], settings)
    verdict, accepted = fit_verdict(w, flat, t.ordinary, settings)
    mine = w.first & np.array([is_flat(row) == flat for row in w.rows], bool)
    scored = [row for row, so in zip(w.rows, mine, strict=True) if so]
    pairs = int(sum(t.trains[i] for i in np.unique(t.owner[t.is_inspected])))
    return {"pairs": pairs, **ranking, **verdict}, (scored, np.minimum(accepted, w.share)[mine], w.y[mine])


def fit_ranking(t: Table, flat: bool, settings: MergeBelief) -> tuple[dict[str, Any], Array]:
    """Fit the models by which hypotheses are ranked, before (``pose``) and after the maps are bent (``bent``); return also (n,)
    the log odds of each that was looked at, by models of other buildings.

    Raises:
        InputError: too few pairs or buildings.
    """
    sure = (t.y >= 0) & t.trains[t.owner]
    closely = sure & t.is_inspected
    if len(np.unique(t.building)) < 2 or len(np.unique(t.y[closely] > 0)) < 2:
        raise InputError("data.sets: too few pairs: right and wrong hypotheses of two buildings are needed")
    shipped, strength = load_model()["flat" if flat else "solid"], settings.pose_strength
    pose = fit_logistic(t.x[sure], t.y[sure] > 0, POSE_VECTOR, strength) if settings.refit == "all" else shipped["pose"]
    scores = np.full(len(t.y), -np.inf)
    if settings.refit == "plan":
        scores[t.is_inspected] = compute_logits(shipped["bent"], t.bent[t.is_inspected])
        return {"pose": pose, "bent": shipped["bent"]}, scores
    for train, test in iter_folds(t.building[t.owner], settings.folds, t.ordinary):
        train, test = train[closely[train]], test[t.is_inspected[test]]
        scores[test] = compute_logits(fit_logistic(t.bent[train], t.y[train] > 0, BENT_POSE_VECTOR, strength), t.bent[test])
    return {"pose": pose, "bent": fit_logistic(t.bent[closely], t.y[closely] > 0, BENT_POSE_VECTOR, strength)}, scores


@dataclass(frozen=True, eq=False)
class BestHypotheses:
    """The best hypothesis of each pair and, as if no search had found a right one, the best wrong one of those that have one: the
    row of its pair, is it the best at all (``first``), its label ``y``, what the models see of it (``x``, ``plan``), its share of
    the odds, its building, how much it counts (``weight``), and does it train?"""

    rows: list[dict[str, Any]]
    first: Array
    y: Array
    x: Array
    plan: Array
    share: Array
    building: Array
    weight: Array
    trains: Array


def collect_best_hypotheses(t: Table, scores: Array, bent: dict[str, Any], settings: MergeBelief) -> BestHypotheses:
    """Collect the best hypotheses of the pairs of a table by the scores of its rows."""
    first = [(i, b) for i in range(len(t.rows)) if (b := find_best_hypothesis(t, scores, bent, i)) is not None]
    others = [(i, find_best_hypothesis(t, scores, bent, i, True)) for i, _ in first if (t.y[t.owner == i] > 0).any()]
    both = [*first, *((i, b) for i, b in others if b is not None)]
    y = np.array([t.y[b[0]] for _, b in first] + [0] * (len(both) - len(first)))
    is_first = np.arange(len(both)) < len(first)
    weight = np.where(is_first, 1.0, settings.missed) * [t.rows[i].get("weight", 1.0) for i, _ in both]
    trains = (y >= 0) & np.array([t.trains[i] for i, _ in both])
    x, share, plan = (np.array([b[k] for _, b in both]) for k in (1, 2, 3))
    building = np.array([t.building[i] for i, _ in both])
    return BestHypotheses([t.rows[i] for i, _ in both], is_first, y, x, plan, share, building, weight, trains)


def fit_verdict(w: BestHypotheses, flat: bool, ordinary: int, settings: MergeBelief) -> tuple[dict[str, Any], Array]:
    """Return the models of the verdict, and (n,) what those of other buildings believe.

    Places of one plan (`is_same_plan`) train the model that tells them by furniture (``plan``) and no other one: they are an
    alternative with a likelihood of its own, and how much walls agree is no evidence against it.
    """
    alike = np.array([is_same_plan(row) for row in w.rows]) & (w.y == 0)
    of_plan, other = w.trains & (alike | (w.y == 1)), w.trains & ~alike
    truth = np.array([classify_truth(row, int(label)) for row, label in zip(w.rows, w.y, strict=True)])
    weight = weight_by_prior(truth, w.weight * other) * np.where(flat & (w.y == 0), settings.strict, 1.0)
    balance = weight_by_plan(alike, w.weight * of_plan) * np.where(alike, settings.plan_strict, 1.0)
    shipped = load_model()["flat" if flat else "solid"] if settings.refit == "plan" else {}

    def fit_place(rows: Array) -> dict[str, Any]:
        rows = rows[other[rows]]
        fresh = None if shipped else fit_logistic(w.x[rows], w.y[rows] > 0, BELIEF_VECTOR, settings.winner_strength, weight[rows])
        return fresh or dict(shipped["winner"])

    def fit_plan(rows: Array) -> dict[str, Any]:
        rows = rows[of_plan[rows]]
        if not alike[rows].any() or alike[rows].all():  # nothing to learn it from
            return dict(load_model()["flat" if flat else "solid"]["plan"])
        return fit_logistic(w.plan[rows], w.y[rows] > 0, PLAN_VECTOR, settings.plan_strength, balance[rows])

    accepted = np.zeros(len(w.y))
    for train, test in iter_folds(w.building, settings.folds, ordinary):
        against = np.exp(-compute_logits(fit_place(train), w.x[test])) + compute_plan_odds(fit_plan(train), w.plan[test])
        accepted[test] = 1 / (1 + against)
    every, wrong = np.arange(len(w.y)), other & (w.y == 0)
    kinds = shipped.get("kinds") or fit_multinomial(w.x[wrong], truth[wrong], weight[wrong], settings.kinds_strength)
    return {"winner": fit_place(every), "kinds": kinds, "plan": fit_plan(every)}, accepted


def score_beliefs(rows: Sequence[dict[str, Any]], accepted: Array, true: Array, threshold: float) -> dict[str, float]:
    """Score pairs: log loss, calibration error of the belief, shares right first, right and believed, and wrong and
    believed. Pairs that fit in no one pose (`label` -1) count as neither right nor wrong."""
    sure = true >= 0
    p, y = np.clip(accepted[sure], 1e-6, 1 - 1e-6), true[sure] == 1
    if not len(y):
        return {}
    return {
        "log_loss": float(-np.mean(np.log(np.where(y, p, 1 - p)))),
        "calibration_error": compute_calibration_error(p, y),
        "right_first": float(y.mean()),
        "right_believed": float((y & (p >= threshold)).mean()),
        "wrong_believed": float((~y & (p >= threshold)).mean()),
        "pairs": float(len(rows)),
    }


def select_scored_rows(rows: Sequence[dict[str, Any]], accepted: Array, true: Array) -> tuple[list[dict[str, Any]], Array, Array]:
    """Select the scored rows, without look-alikes and the development floor, which would change the shares of all others."""
    chosen = np.array(["lookalike" not in row and not row.get("real") for row in rows], bool)
    return [row for row, so in zip(rows, chosen, strict=True) if so], np.asarray(accepted)[chosen], np.asarray(true)[chosen]


def format_beliefs_by_kind(rows: Sequence[dict[str, Any]], accepted: Array, true: Array, threshold: float) -> str:
    """Return a line: of each bin of area in common how many pairs there are, are right first, rightly and falsely believed."""
    bins: dict[str, list[int]] = {}
    for row, p, t in zip(rows, accepted, true, strict=True):
        tally = bins.setdefault(classify_pair(row), [0, 0, 0, 0])
        for k, hit in enumerate((True, t == 1, p >= threshold and t == 1, p >= threshold and t == 0)):
            tally[k] += int(hit)
    counts = "; ".join(f"{kind} {tally}" for kind, tally in sorted(bins.items()))
    return f"pairs, right first, merged right, merged wrong: {counts}"


def judge(settings: MergeBelief, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Return scores of weights on pairs of buildings that trained nothing."""
    weights = json.loads(file.read_text(encoding="utf-8"))
    rows = [row for row in build_belief_rows(settings.heldout, settings, log_line) if row["hyps"] and is_distinguishable(row)]
    rows += [row for row in build_lookalike_rows(settings.alike_heldout, settings, log_line) if row["hyps"]]
    scored_rows, accepted, true = [], [], []
    for name, flat in (("solid", False), ("flat", True)):
        of = [row for row in rows if is_flat(row) == flat]
        if not of:
            continue
        t, models = build_hypothesis_table(of), weights[name]
        scores = np.where(t.is_inspected, compute_logits(models["bent"], np.nan_to_num(t.bent)), -np.inf)
        for i, row in enumerate(of):
            if (first := find_best_hypothesis(t, scores, models["bent"], i)) is not None:
                odds = float(compute_logits(models["winner"], first[1][None])[0])
                by_plan = float(compute_plan_odds(models["plan"], first[3][None])[0])
                scored_rows.append(row)
                accepted.append(min(1 / (1 + np.exp(-odds) + by_plan), first[2]))
                true.append(t.y[first[0]])
    if not scored_rows:
        raise InputError(f"{settings.heldout.name}: no pair has a hypothesis that can be judged")
    threshold = float(weights["threshold"])
    log_line(format_beliefs_by_kind(scored_rows, np.array(accepted), np.array(true), threshold))
    judged = score_beliefs(*select_scored_rows(scored_rows, np.array(accepted), np.array(true)), threshold)
    return judged | score_lookalikes(scored_rows, np.array(accepted), np.array(true), threshold)


def is_flat(row: dict[str, Any]) -> bool:
    """Return whether a map of the pair is a slice or a drawing."""
    return not {"laser2d", "drawing"}.isdisjoint(row["sensors"])


def _round_values(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 5)
    if isinstance(value, list):
        return [_round_values(v) for v in value]
    return {k: _round_values(v) for k, v in value.items()} if isinstance(value, dict) else value


TASK = Task(MergeBelief, fit, ("right_believed", "right_first"), judge, "topomerge.registration", "calibration.json", hours=4.0)
