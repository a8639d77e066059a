"""Task `merge_belief`: the logistic models by which hypotheses are ranked and merges believed (`fusion.verify`).

Fitted to the hypotheses of pairs of grids (`belief_hypotheses`): one model sees each hypothesis by itself, a second one the best
of a pair. What is reported comes from cross-validation over buildings.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.datasets.pairs.evaluation_pair import sim3_of
from topomerge.errors import InputError
from topomerge.matching.poses import PoseHypothesis, distinct_hypotheses
from topomerge.registration.posterior import threshold_of
from topomerge.registration.verify import (
    BASIN,
    BELIEF_VECTOR,
    BENT_POSE_VECTOR,
    PLAN_VECTOR,
    POSE_VECTOR,
    Features,
    belief_vector,
    bent_pose_vector,
    lead,
    model,
    plan_odds,
    plan_vector,
    vector,
)
from topomerge.training.belief_floor import floor_rows
from topomerge.training.belief_hypotheses import belief_rows, fair, kind_of
from topomerge.training.belief_lookalikes import lookalike_rows, lookalike_scores
from topomerge.training.belief_models import (
    fitted,
    fitted_kinds,
    folds,
    is_same_plan,
    logits,
    plan_weights,
    prior_weights,
    risk_curve,
    what_it_is,
)
from topomerge.training.closed_form import Fitted, calibration_error, run_fit
from topomerge.training.loop import Say
from topomerge.training.splits import name_building
from topomerge.training.task_settings import MergeBelief
from topomerge.types import Array


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
    rows += floor_rows(settings, say)
    weights: dict[str, Any] = {"names": BELIEF_VECTOR}
    parts = {}
    for name, flat in (("solid", False), ("flat", True)):
        chosen = rows if flat else [row for row in rows if "drawing" not in row["sensors"]]
        weights[name], parts[name] = fit_models(chosen, flat, settings)
    rows_scored = [row for part in parts.values() for row in part[0]]
    believed, true = (np.concatenate([part[k] for part in parts.values()]) for k in (1, 2))
    weights["risk"] = left_out_risk(rows_scored, believed, true)
    least = weights["risk"][-1][1]
    weights["threshold"] = threshold = threshold_of(max(settings.risk, least, 1e-9), weights["risk"])
    metrics = {
        f"{key}_{name}": v for name, part in parts.items() for key, v in belief_scores(*ordinary(*part), threshold).items()
    }
    metrics |= belief_scores(*ordinary(rows_scored, believed, true), threshold)
    metrics |= lookalike_scores(rows_scored, believed, true, threshold)
    say(believed_by_kind(rows_scored, believed, true, threshold))
    trained = sum(not row.get("judged_only") for row in rows)
    origin = {"set": settings.data.name, "split": settings.data.split, "pairs": trained, "lookalikes": settings.lookalikes}
    return Fitted(weights=_rounded(weights), metrics=metrics | {"threshold": threshold}, origin=origin)


def left_out_risk(rows: Sequence[dict[str, Any]], believed: Array, true: Array) -> list[list[float]]:
    """`risk_curve` of pairs that were left out, but for what nobody can tell apart, what trains nothing, and the floor."""
    no = [row.get("tellable") is False or row.get("judged_only") or row.get("real") for row in rows]
    chosen = ~np.array(no, bool)
    truth = np.array([what_it_is(row, int(t)) for row, t in zip(rows, true, strict=True)])
    weight = np.array([row.get("weight", 1.0) for row in rows])
    return risk_curve(believed[chosen], true[chosen], truth[chosen], weight[chosen])


@dataclass(frozen=True, eq=False)
class Table:
    """Hypotheses of pairs: of which pair (`owner`), what the model of rigid poses sees (`x`), right or not (`y`: `label_of`);
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
    def looked(self) -> Array:
        """(n,) bool: was it looked at closely?"""
        return ~np.isnan(self.bent[:, 0])


def tabled(rows: list[dict[str, Any]]) -> Table:
    """Hypotheses as arrays."""
    owner = np.array([i for i, row in enumerate(rows) for _ in row["hyps"]])
    hyps = [h for row in rows for h in row["hyps"]]
    nothing = np.full(len(BENT_POSE_VECTOR), np.nan)
    poses = np.array([h.get("bent_pose", np.full((4, 4), np.nan)) for h in hyps], float)
    names = [f"{int('lookalike' in row)}{name_building(row)}" for row in rows]  # ordinary ones first
    return Table(
        rows, owner, np.array([vector(h) for h in hyps]), np.array([h["label"] for h in hyps]),
        np.array([bent_pose_vector(h["bent"]) if "bent" in h else nothing for h in hyps]), [h.get("bent", {}) for h in hyps],
        poses, np.array([bool(h.get("rival")) for h in hyps]), np.unique(names, return_inverse=True)[1],
        np.array([not row.get("judged_only") for row in rows], bool), len({name for name in names if name[0] == "0"}),
    )  # fmt: skip


def best(t: Table, scores: Array, bent: dict[str, Any], i: int, wrong: bool = False) -> tuple[int, Array, float, Array] | None:
    """Row of the best hypothesis of pair i (of the wrong ones only, as if no search had found a right one), what the
    second model sees of it, its share of the odds, and what the model of places of one plan sees of it."""
    rows = np.flatnonzero((t.owner == i) & t.looked & ((t.y == 0) if wrong else t.rival))
    rows = rows[np.argsort(-scores[rows], kind="stable")]
    if not len(rows):
        return None
    rows = rows[_distinct(t.poses[rows], np.array(t.rows[i]["middle"]))]
    leads = lead(scores[rows], t.bent[rows], np.array(bent["weight"]), np.array(bent["scale"]))
    first = int(rows[0])
    return first, belief_vector(t.bent[first], leads[:3], t.closely[first]), leads[3], plan_vector(t.closely[first])


def _distinct(poses: Array, middle: Array) -> list[int]:
    """Which of ranked poses (n, 4, 4) end in no better one's place (as `fusion.candidates`)."""
    hypotheses = [PoseHypothesis(sim3_of(pose)) for pose in poses]  # type: ignore[arg-type]
    single = {id(h) for h in distinct_hypotheses(hypotheses, middle, BASIN)}
    return [k for k, h in enumerate(hypotheses) if id(h) in single]


def fit_models(rows: list[dict[str, Any]], flat: bool, settings: MergeBelief) -> tuple[dict[str, Any], tuple[Any, Array, Array]]:
    """The models of these pairs; and of those that are flat, or are not: the rows, what left-out buildings' models believe of
    their best hypothesis, and its label.

    Raises:
        InputError: too few pairs or buildings.
    """
    t = tabled(rows)
    ranking, scores = fit_ranking(t, flat, settings)
    w = collect_winners(t, scores, ranking["bent"], settings)
    verdict, believed = fit_verdict(w, flat, t.ordinary, settings)
    mine = w.first & np.array([is_flat(row) == flat for row in w.rows], bool)
    scored = [row for row, so in zip(w.rows, mine, strict=True) if so]
    pairs = int(sum(t.trains[i] for i in np.unique(t.owner[t.looked])))
    return {"pairs": pairs, **ranking, **verdict}, (scored, np.minimum(believed, w.share)[mine], w.y[mine])


def fit_ranking(t: Table, flat: bool, settings: MergeBelief) -> tuple[dict[str, Any], Array]:
    """The models by which hypotheses are ranked, before (``pose``) and after the maps are bent (``bent``), and (n,) the log odds
    of each that was looked at, by models of other buildings.

    Raises:
        InputError: too few pairs or buildings.
    """
    sure = (t.y >= 0) & t.trains[t.owner]
    closely = sure & t.looked
    if len(np.unique(t.building)) < 2 or len(np.unique(t.y[closely] > 0)) < 2:
        raise InputError("data.sets: too few pairs: right and wrong hypotheses of two buildings are needed")
    shipped, strength = model()["flat" if flat else "solid"], settings.pose_strength
    pose = fitted(t.x[sure], t.y[sure] > 0, POSE_VECTOR, strength) if settings.refit == "all" else shipped["pose"]
    scores = np.full(len(t.y), -np.inf)
    if settings.refit == "plan":
        scores[t.looked] = logits(shipped["bent"], t.bent[t.looked])
        return {"pose": pose, "bent": shipped["bent"]}, scores
    for train, test in folds(t.building[t.owner], settings.folds, t.ordinary):
        train, test = train[closely[train]], test[t.looked[test]]
        scores[test] = logits(fitted(t.bent[train], t.y[train] > 0, BENT_POSE_VECTOR, strength), t.bent[test])
    return {"pose": pose, "bent": fitted(t.bent[closely], t.y[closely] > 0, BENT_POSE_VECTOR, strength)}, scores


@dataclass(frozen=True, eq=False)
class Winners:
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


def collect_winners(t: Table, scores: Array, bent: dict[str, Any], settings: MergeBelief) -> Winners:
    """The best hypotheses of the pairs of a table by the scores of its rows."""
    first = [(i, b) for i in range(len(t.rows)) if (b := best(t, scores, bent, i)) is not None]
    others = [(i, best(t, scores, bent, i, True)) for i, _ in first if (t.y[t.owner == i] > 0).any()]
    both = [*first, *((i, b) for i, b in others if b is not None)]
    y = np.array([t.y[b[0]] for _, b in first] + [0] * (len(both) - len(first)))
    is_first = np.arange(len(both)) < len(first)
    weight = np.where(is_first, 1.0, settings.missed) * [t.rows[i].get("weight", 1.0) for i, _ in both]
    trains = (y >= 0) & np.array([t.trains[i] for i, _ in both])
    x, share, plan = (np.array([b[k] for _, b in both]) for k in (1, 2, 3))
    building = np.array([t.building[i] for i, _ in both])
    return Winners([t.rows[i] for i, _ in both], is_first, y, x, plan, share, building, weight, trains)


def fit_verdict(w: Winners, flat: bool, ordinary: int, settings: MergeBelief) -> tuple[dict[str, Any], Array]:
    """The models of the verdict, and (n,) what those of other buildings believe.

    Places of one plan (`is_same_plan`) train the model that tells them by furniture (``plan``) and no other one: they are an
    alternative with a likelihood of its own, and how much walls agree is no evidence against it.
    """
    alike = np.array([is_same_plan(row) for row in w.rows]) & (w.y == 0)
    of_plan, other = w.trains & (alike | (w.y == 1)), w.trains & ~alike
    truth = np.array([what_it_is(row, int(label)) for row, label in zip(w.rows, w.y, strict=True)])
    weight = prior_weights(truth, w.weight * other) * np.where(flat & (w.y == 0), settings.strict, 1.0)
    balance = plan_weights(alike, w.weight * of_plan) * np.where(alike, settings.plan_strict, 1.0)
    shipped = model()["flat" if flat else "solid"] if settings.refit == "plan" else {}

    def fit_place(rows: Array) -> dict[str, Any]:
        rows = rows[other[rows]]
        fresh = None if shipped else fitted(w.x[rows], w.y[rows] > 0, BELIEF_VECTOR, settings.winner_strength, weight[rows])
        return fresh or dict(shipped["winner"])

    def fit_plan(rows: Array) -> dict[str, Any]:
        rows = rows[of_plan[rows]]
        if not alike[rows].any() or alike[rows].all():  # nothing to learn it from
            return dict(model()["flat" if flat else "solid"]["plan"])
        return fitted(w.plan[rows], w.y[rows] > 0, PLAN_VECTOR, settings.plan_strength, balance[rows])

    believed = np.zeros(len(w.y))
    for train, test in folds(w.building, settings.folds, ordinary):
        against = np.exp(-logits(fit_place(train), w.x[test])) + plan_odds(fit_plan(train), w.plan[test])
        believed[test] = 1 / (1 + against)
    every, wrong = np.arange(len(w.y)), other & (w.y == 0)
    kinds = shipped.get("kinds") or fitted_kinds(w.x[wrong], truth[wrong], weight[wrong], settings.kinds_strength)
    return {"winner": fit_place(every), "kinds": kinds, "plan": fit_plan(every)}, believed


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
    """What is scored, without look-alikes and the development floor: they would change the shares of all others."""
    chosen = np.array(["lookalike" not in row and not row.get("real") for row in rows], bool)
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
        scores = np.where(t.looked, logits(models["bent"], np.nan_to_num(t.bent)), -np.inf)
        for i, row in enumerate(of):
            if (first := best(t, scores, models["bent"], i)) is not None:
                odds = float(logits(models["winner"], first[1][None])[0])
                by_plan = float(plan_odds(models["plan"], first[3][None])[0])
                scored_rows.append(row)
                believed.append(min(1 / (1 + np.exp(-odds) + by_plan), first[2]))
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
