"""Fit the coefficients by which merges are believed: ``topomerge/fusion/calibration.json``.

``python -m benchmarks.training.calibrate_merge gather`` judges the hypotheses of the cached training pairs (`merge_pairs.py
train`, and
`merge_drawings.py train` of maps and floor plans; resumable), one line of JSON a pair; ``... fit`` fits both logistic models on
them, with cross-validation over buildings, and prints what is accepted at several thresholds. Only training buildings may be
gathered.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from benchmarks.merging.pairs import GridPair, load
from topomerge.fusion.judge import Judge
from topomerge.fusion.registration import registration_order as order
from topomerge.fusion.scale import search_scaled
from topomerge.fusion.search import search
from topomerge.fusion.storey_plan import plans
from topomerge.fusion.verify import LEAD_VECTOR, POSE_VECTOR, WINNER_VECTOR, lead, rank, vector, winner_vector
from topomerge.fusion.winner_features import winner_features
from topomerge.matching.plan_fields import PlanFields
from topomerge.matching.poses import wrapped
from topomerge.types import Array, Sim3

FOLDER, DRAWN, ROWS = Path("cache/merge/train"), Path("cache/merge/train_drawings"), Path("cache/merge/judged.jsonl")
TARGET = Path("topomerge/fusion/calibration.json")
TOLD = ("sensors", "kind", "building", "source", "overlap", "differs", "walls_differ", "scaled")
KEPT, LOOKED = 25, 2  # hypotheses of a pair, and how many of them are looked at closer
RIGHT = (0.5, 5.0)  # m, degrees
STRENGTH = 0.3  # of the second model: the smaller, the simpler
SAME_WALLS = 3.0  # m2 of walls by which two storeys differ at most that no drawing tells apart
ALIKE = 0.3  # m by which walls of twin wings differ at most, where both maps look: drift does as much
MANY = 15  # pairs that are printed
MISSED = 0.2  # weight of a pair whose right hypothesis is taken away
STRICT = 1.25  # weight of a wrong hypothesis where a slice or a drawing hides what tells storeys apart: rather refused than wrong
THRESHOLD = 0.8
SIGN = {
    "ratio": 1, "walls": 1, "conflict": -1, "worst": -1, "free": 1, "opposed": -1, "lift": 1, "met": 1, "missed": -1, "share": 1,
    "level": -1, "ceilings": -1, "margin": 1, "ahead": 1, "tall": -1, "crossing": 1, "worst_ratio": 1, "squares": 1,
    "bad_squares": -1, "in_place": 1, "out_of_place": -1, "kept": 1, "moved_walls": -1, "hanging": 1, "fallen": -1, "held": 1,
    "alone": 1,
}  # fmt: skip


def error(pose: Sim3, pair: GridPair) -> list[float] | None:
    """Horizontal and vertical error in the middle of what both saw, m, and of yaw, degrees; None where no pose is right."""
    if pair.truth is None or pair.about["kind"] != "overlap":
        return None
    middle = pair.anchor[None]
    off = (pose.apply(middle) - pair.truth.apply(middle))[0]
    return [float(np.hypot(*off[:2])), float(off[2]), float(np.degrees(abs(wrapped(pose.yaw - pair.truth.yaw))))]


def right(err: Sequence[float] | None, sensors: Sequence[str], limits: tuple[float, float] = RIGHT) -> bool:
    """Is a pose right? A slice or a drawing says nothing of its height."""
    if err is None:
        return False
    flat = "laser2d" in sensors or "drawing" in sensors
    return (err[0] if flat else float(np.hypot(err[0], err[1]))) < limits[0] and err[2] < limits[1]


def gather(pattern: str = "*", cross: str = "0") -> None:
    """Judge the hypotheses of every training pair that is not in `ROWS` yet, and of maps of different buildings put together.

    Args:
        pattern: of the pairs' names.
        cross: how many such pairs of strangers.
    """
    done = {json.loads(line)["name"] for line in ROWS.read_text().splitlines()} if ROWS.exists() else set()
    paths = sorted(FOLDER.glob(f"{pattern}.npz"), reverse=True)
    drawn = sorted(DRAWN.glob(f"{pattern}.npz"), reverse=True)
    todo: list[tuple[Path, ...]] = [(p,) for p in (*drawn, *paths)] + list(strangers(paths, int(cross)))
    for chosen in todo:
        name = "+".join(p.stem for p in chosen)
        if name in done:
            continue
        pair = load(chosen[0]) if len(chosen) == 1 else together(load(chosen[0]), load(chosen[1]))
        about = {k: pair.about[k] for k in TOLD if k in pair.about}
        row = {"name": pair.name, "common": pair.common, **about, "hyps": judged(pair)}
        with ROWS.open("a") as out:
            out.write(json.dumps(row) + "\n")


def strangers(paths: Sequence[Path], many: int) -> Iterator[tuple[Path, Path]]:
    """Pairs of cached pairs, drawn by chance: a of one and b of the other."""
    rng = np.random.default_rng(len(paths))
    for i, j in rng.integers(len(paths), size=(many, 2)):
        yield paths[i], paths[j]


def together(first: GridPair, second: GridPair) -> GridPair:
    """Map a of one pair and b of another one, of another building."""
    same = first.about["building"] == second.about["building"]
    sensors = [first.about["sensors"][0], second.about["sensors"][1]]  # type: ignore[index]
    buildings = f"{first.about['building']} + {second.about['building']}"
    about = {**first.about, "sensors": sensors, "building": buildings, "kind": "same" if same else "strangers", "overlap": 0.0}
    return GridPair(f"{first.name}+{second.name}", first.a, second.b, (first.free[0], second.free[1]), None, 0.0, about)


def judged(pair: GridPair) -> list[dict[str, Any]]:
    """Hypotheses with what they are judged by and their errors; the first ones with what only the best one is asked."""
    a, b = ([PlanFields(p) for p in plans(g, f)] for g, f in ((pair.a, pair.free[0]), (pair.b, pair.free[1])))
    find = search_scaled if pair.about.get("scaled") else search
    if order(pair.b) < order(pair.a):
        judge, turn = Judge(b, a), True
        candidates = find(b, a)
    else:
        judge, turn = Judge(a, b), False
        candidates = find(a, b)
    rows = []
    for k, h in enumerate(rank(candidates, judge)[:KEPT]):
        pose = h.transform.inverse() if turn else h.transform
        told = {**winner_features(judge, h.transform), "pose": h.transform.matrix.tolist()} if k < LOOKED else {}
        rows.append({**h.features, **told, "err": error(pose, pair)})
    return rows


def fitted(x: Array, y: Array, names: Sequence[str], strength: float, weight: Array | None = None) -> dict[str, Any]:
    """Standardised logistic regression as plain numbers, in which what speaks for a merge never counts against it (`SIGN`)."""
    mean, scale = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-6)
    z, sign = (x - mean) / scale, np.where(y, 1.0, -1.0)
    many = np.ones(len(y)) if weight is None else weight

    def loss(t: Array) -> tuple[float, Array]:
        margin = sign * (z @ t[:-1] + t[-1])
        slope = -many * sign / (1 + np.exp(margin))
        value = (many * np.logaddexp(0, -margin)).sum() + (t[:-1] ** 2).sum() / (2 * strength)
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
    return 1 if right(err, row["sensors"]) else -1 if right(err, row["sensors"], (1.5, 5.0)) else 0


@dataclass(frozen=True, eq=False)
class Table:
    """All hypotheses of all pairs: of which pair (`owner`), what the first model sees (`x`), right or not (`y`: `label`), what
    is known from looking closer (`near`; nan where nobody did), and the building of each pair."""

    rows: list[dict[str, Any]]
    owner: Array
    x: Array
    y: Array
    near: Array
    building: Array


def tabled(rows: list[dict[str, Any]]) -> Table:
    """Hypotheses as arrays."""
    every = [(i, h) for i, row in enumerate(rows) for h in row["hyps"]]
    near = [winner_vector(h) if "pieces" in h else np.full(len(WINNER_VECTOR), np.nan) for _, h in every]
    names = [row["building"].split(" + ")[0] for row in rows]
    y = np.array([label(h, rows[i]) for i, h in every])
    x = np.array([vector(h) for _, h in every])
    return Table(rows, np.array([i for i, _ in every]), x, y, np.array(near), np.unique(names, return_inverse=True)[1])


def best(t: Table, scores: Array, pose: dict[str, Any], i: int, wrong: bool = False) -> tuple[int, Array, float] | None:
    """Row of the best hypothesis of pair i (of the wrong ones only, as if no search had found a right one), what the
    second model sees of it, and its share of the odds."""
    rows = np.flatnonzero((t.owner == i) & ((t.y == 0) | (not wrong)))
    rows = rows[np.argsort(-scores[rows], kind="stable")]
    if not len(rows) or np.isnan(t.near[rows[0]]).any():
        return None
    leads = lead(scores[rows], t.x[rows], np.array(pose["weight"]), np.array(pose["scale"]))
    return int(rows[0]), np.concatenate([t.x[rows[0]], leads[:3], t.near[rows[0]]]), leads[3]


def folds(groups: Array, many: int = 8) -> Iterator[tuple[Array, Array]]:
    """Rows to train on and rows to test on; no group is in both."""
    of = np.random.default_rng(0).permutation(groups.max() + 1)[groups] % many
    for k in range(many):
        yield np.flatnonzero(of != k), np.flatnonzero(of == k)


def fit() -> None:
    """The models for pairs of maps with heights, from all pairs without drawings, and those for slices and drawings, from all
    pairs; what left-out pairs say about them is printed of the pairs that each is for."""
    found = {row["name"]: row for row in map(json.loads, ROWS.read_text().splitlines())}
    rows = [row for row in with_differs(list(found.values()), "train") if row["hyps"] and fair(row)]
    result: dict[str, Any] = {"names": [*POSE_VECTOR, *LEAD_VECTOR, *WINNER_VECTOR], "threshold": THRESHOLD}
    result["solid"] = fit_models([row for row in rows if "drawing" not in row["sensors"]], False)
    result["flat"] = fit_models(rows, True)
    TARGET.write_text(json.dumps(_rounded(result), indent=1) + "\n")


def fit_models(rows: list[dict[str, Any]], flat: bool) -> dict[str, Any]:
    """Both models of these pairs; told is what they say of those that are flat, or are not."""
    t = tabled(rows)
    sure = t.y >= 0
    pose, held = fitted(t.x[sure], t.y[sure] > 0, POSE_VECTOR, 1.0), np.zeros(len(t.y))
    for train, test in folds(t.building[t.owner]):
        train = train[sure[train]]
        held[test] = logits(fitted(t.x[train], t.y[train] > 0, POSE_VECTOR, 1.0), t.x[test])
    chosen = [(i, best(t, held, pose, i)) for i in range(len(t.rows))]
    chosen = [(i, c) for i, c in chosen if c is not None]
    others = [(i, best(t, held, pose, i, True)) for i, c in chosen if (t.y[t.owner == i] > 0).any()]
    others = [(i, c) for i, c in others if c is not None]
    x = np.array([c[1] for _, c in (*chosen, *others)])  # type: ignore[index]
    y = np.array([t.y[c[0]] for _, c in chosen] + [0] * len(others))  # type: ignore[index]
    share = np.array([c[2] for _, c in chosen])  # type: ignore[index]
    building = np.array([t.building[i] for i, _ in (*chosen, *others)])
    weight = np.where(np.arange(len(y)) < len(chosen), 1.0, MISSED) * np.where(flat & (y == 0), STRICT, 1.0)
    names, believed = [*POSE_VECTOR, *LEAD_VECTOR, *WINNER_VECTOR], np.zeros(len(y))
    for train, test in folds(building):
        train = train[y[train] >= 0]
        model = fitted(x[train], y[train] > 0, names, STRENGTH, weight[train])
        believed[test] = 1 / (1 + np.exp(-logits(model, x[test])))
    believed = np.minimum(believed[: len(chosen)], share)
    told = np.array([(not {"laser2d", "drawing"}.isdisjoint(t.rows[i]["sensors"])) == flat for i, _ in chosen])
    report([t.rows[i] for (i, _), mine in zip(chosen, told, strict=True) if mine], believed[told], y[: len(chosen)][told])
    kept = y >= 0
    winner = fitted(x[kept], y[kept] > 0, names, STRENGTH, weight[kept])
    print({n: round(w, 2) for n, w in zip(names, winner["weight"], strict=True)})
    return {"pairs": len(chosen), "pose": pose, "winner": winner}


def fair(row: dict[str, Any]) -> bool:
    """Pairs that anybody could tell: no twin wings that are the same where both maps look (those of set 0 are so throughout, if
    nobody measured it), and no drawings of a storey with the same walls. A drawing of a map's own building of which the map
    shows nothing has a wrong truth: the generator gave a twin's frame."""
    differs = row.get("differs")
    if differs is None and row["name"].startswith("0_"):
        differs = 0.0
    if row["kind"] == "overlap" and row["common"] < 1 and "drawing" in row["sensors"]:
        return False
    if row["kind"] == "same" or row.get("walls_differ", SAME_WALLS) < SAME_WALLS:
        return False
    return row["kind"] != "twin-wing" or differs is None or differs >= ALIKE


def with_differs(rows: list[dict[str, Any]], split: str) -> list[dict[str, Any]]:
    """Rows of cached pairs, those of twin wings with what ``merge_drawings.py SPLIT differs`` found about them."""
    path = Path("cache/merge") / f"differs_{split}.json"
    known = json.loads(path.read_text()) if path.exists() else {}
    return [{**r, "differs": known[r["name"]]} if r.get("differs") is None and r["name"] in known else r for r in rows]


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 5)
    if isinstance(value, list):
        return [_rounded(v) for v in value]
    return {k: _rounded(v) for k, v in value.items()} if isinstance(value, dict) else value


def kind_of(row: dict[str, Any]) -> str:
    """Bin by the area in common."""
    if row["kind"] != "overlap" or row["common"] < 1 or row.get("overlap") == 0:
        return f"none ({row['kind']})"
    return next(name for limit, name in ((40, "<40"), (80, "40-80"), (200, "80-200"), (np.inf, ">200")) if row["common"] < limit)


def report(rows: Sequence[dict[str, Any]], believed: Array, true: Array) -> None:
    """What is believed at several thresholds, by bin; all out of fold."""
    wrong = np.sort(believed[true == 0])[::-1]
    for threshold in (0.5, 0.7, THRESHOLD, *(float(w) + 1e-6 for w in wrong[[4, 2, 1, 0]])):
        bins: dict[str, list[int]] = {}
        for row, p, t in zip(rows, believed, true, strict=True):
            tally = bins.setdefault(kind_of(row), [0, 0, 0, 0])
            for k, hit in enumerate((True, t == 1, p >= threshold and t == 1, p >= threshold and t == 0)):
                tally[k] += int(hit)
        print(f"threshold {threshold:.3f}: bin: pairs, right first, merged right, merged wrong")
        print("  " + "  ".join(f"{k}: {v}" for k, v in sorted(bins.items())))
    for i in np.argsort(np.where((true == 1) & (np.array([r["common"] for r in rows]) >= 80), believed, 2))[:MANY]:
        print(f"right, p {believed[i]:.2f}: {rows[i]['name']} {rows[i]['sensors']} {rows[i]['common']:.0f} m2")
    for i in np.argsort(-np.where(true == 0, believed, -1))[:MANY]:
        row = rows[i]
        where = f"{row['kind']} {row['sensors']} {row['common']:.0f} m2 {row['hyps'][0]['err']}"
        print(f"wrong, p {believed[i]:.2f}: {row['name']} {where}")
    sure = np.flatnonzero(true >= 0)
    for part in np.array_split(sure[np.argsort(believed[sure])], 8):
        print(f"believed {believed[part].mean():.2f}  right {true[part].mean():.2f}  ({len(part)})")


if __name__ == "__main__":
    {"gather": gather, "fit": fit}[sys.argv[1]](*sys.argv[2:])
