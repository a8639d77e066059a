"""Task `locate_odds`: the odds of a pose of a single scan against other poses and against "nowhere" (`fusion.atlas.locate`).

Single scans of known places, and of buildings without a map, are looked for in an atlas. The weights of what is seen of a pose
are the most likely ones of a choice among all poses that were judged and "nowhere" (conditional logit, McFadden 1974). The odds
of "nowhere" go by the mean ones of the poses: what a scan that shows so much reaches at wrong places.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from topomerge import archive
from topomerge.code_digest import compute_code_digest
from topomerge.datasets.core.builder import limit_threads
from topomerge.datasets.pairs.localisation import MORE_SCANS, SCANS, load_located_map, make_located_map, make_located_scan
from topomerge.errors import InputError
from topomerge.fusion.atlas.locate import LOCATE, find_places, measure_chance, prepare_query
from topomerge.fusion.atlas.place_index import FEATURES, PlaceIndex
from topomerge.io.maps import load_map
from topomerge.matching.poses import wrap_yaw
from topomerge.training.closed_form import FitResult, run_fit
from topomerge.training.task_settings import LocateOdds
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn

KINDS = (*SCANS, *MORE_SCANS)
RIGHT = (0.5, np.radians(6.0))  # m and rad: a pose that is learned as right
FOLDS = 6
MAKERS = ("topomerge.fusion.atlas.place_index", "topomerge.datasets.pairs.localisation")  # of features and scans
SHRINK = 1e-3  # of squared weights of standardised features
DIGITS = 4


class LocateRows(NamedTuple):
    """A scan: number of its building, (n, 11) features of its poses and (n,) which are right."""

    building: int
    x: Array
    y: Array


class LocateWeights(NamedTuple):
    """(11,) weights of the features; of the odds of "nowhere" the constant, the share of chance, and what chance usually is."""

    weight: Array
    nowhere: float
    chance: float
    usual: float


def build_rows(split: str, count: int, folder: Path, log_line: LogFn) -> list[LocateRows]:
    """Make an atlas of so many maps, and judge poses of scans of each building and of as many without a map; rows are cached."""
    folder.mkdir(parents=True, exist_ok=True)
    key = f"{compute_code_digest(*MAKERS)}_{count}x{len(KINDS)}"
    with limit_threads():
        maps = [load_located_map(make_located_map(split, k, folder)) for k in range(count)]
        index, rows = None, []
        for k in range(count):
            path = folder / f"rows_{key}_{k:03d}.npz"
            if not path.exists():
                index = index or PlaceIndex.from_maps({m.path.stem: load_map(m.path) for m in maps})
                own = [build_row(index, maps[k], split, k, kind, negative) for kind, negative in list_scans(k)]
                of = {f"{n}.{name}": v for n, row in enumerate(filter(None, own)) for name, v in (("x", row.x), ("y", row.y))}
                archive.write(of, path)
                log_line(f"{k + 1} of {count} buildings")
            found = archive.read(path)
            rows += [LocateRows(k, found[f"{n}.x"], found[f"{n}.y"]) for n in range(len(found) // 2)]
    return rows


def list_scans(building: int) -> list[tuple[str, bool]]:
    """List the kinds of scans of a building, and whether each is of one without a map: every third kind also is."""
    return [(kind, no) for n, kind in enumerate(KINDS) for no in ((False, True) if (building + n) % 3 == 0 else (False,))]


def build_row(index: PlaceIndex, own: Any, split: str, number: int, kind: str, negative: bool) -> LocateRows | None:
    """Judge the poses of one scan; None where it shows no walls."""
    scan = make_located_scan(split, number, kind, negative)
    try:
        query = prepare_query(scan.cloud)
    except InputError:
        return None
    pose, moved = own.place_scan(scan)
    at = query.place[None]
    placed = (pose.apply(at) + moved)[0, :2]
    judged = find_places(index, query, LOCATE)
    right = [
        not negative
        and index.storeys[j.storey].map == number
        and float(np.hypot(*(j.pose.apply(at)[0, :2] - placed))) < RIGHT[0]
        and abs(wrap_yaw(j.pose.yaw - pose.yaw)) < RIGHT[1]
        for j in judged
    ]
    return LocateRows(number, np.array([j.features for j in judged]), np.array(right)) if judged else None


def fit_choice(rows: Sequence[LocateRows]) -> LocateWeights:
    """Fit the weights of a choice."""
    size = np.concatenate([r.x for r in rows]).std(axis=0) + 1e-9
    count = len(size)

    def loss(w: Array) -> tuple[float, Array]:
        total, slope = 0.0, np.zeros_like(w)
        for r in rows:
            x, true = r.x / size, np.append(r.y, not r.y.any())
            own = x @ w[:count]
            mean_score = own.mean()
            z = np.append(own, w[count] + w[-1] * mean_score)
            total += float(np.logaddexp.reduce(z) - np.logaddexp.reduce(z[true]))
            gap = np.exp(z - np.logaddexp.reduce(z))
            gap[true] -= np.exp(z[true] - np.logaddexp.reduce(z[true]))
            slope += [*(gap[:-1] @ x + gap[-1] * w[-1] * x.mean(axis=0)), gap[-1], gap[-1] * mean_score]
        slope /= len(rows)
        slope[:count] += 2 * SHRINK * w[:count]
        return total / len(rows) + SHRINK * float(w[:count] @ w[:count]), slope

    fitted: Array = minimize(loss, np.zeros(count + 2), jac=True, method="L-BFGS-B").x
    weight = fitted[:count] / size
    usual = float(np.mean([(r.x @ weight).mean() for r in rows]))
    return LocateWeights(weight, float(fitted[count]), float(fitted[-1]), usual)


def score_choices(rows: Sequence[LocateRows], found: LocateWeights) -> dict[str, float]:
    """Score a fit: mean log loss of the choice; shares of scans that are believed and right, and believed and wrong."""
    losses, right, wrong = [], 0, 0
    for r in rows:
        own = r.x @ found.weight
        z = np.append(own, found.nowhere + found.chance * measure_chance(own, found.usual))
        p = np.exp(z - np.logaddexp.reduce(z))
        losses.append(-np.log(max(float(p[:-1][r.y].sum() if r.y.any() else p[-1]), 1e-9)))
        best = int(p[:-1].argmax())
        sure = p[best] >= LOCATE.sure
        right, wrong = right + int(sure and r.y[best]), wrong + int(sure and not r.y[best])
    return {"log_loss": float(np.mean(losses)), "right": right / len(rows), "wrong": wrong / len(rows)}


def fit_locate(settings: LocateOdds, log_line: LogFn) -> FitResult:
    """Fit on all buildings, and score each by those that were fitted without it."""
    folder = Path(settings.cache) / "locate" / settings.split
    rows = build_rows(settings.split, settings.maps, folder, log_line)
    scores = []
    for fold in range(FOLDS):
        own = [r for r in rows if r.building % FOLDS == fold]
        if own:
            scores += [(len(own), score_choices(own, fit_choice([r for r in rows if r.building % FOLDS != fold])))]
    metrics = {name: sum(n * s[name] for n, s in scores) / len(rows) for name in ("log_loss", "right", "wrong")}
    weights = fit_choice(rows)
    numbers = {name: round(value, DIGITS) for name, value in weights._asdict().items() if name != "weight"}
    found = {"names": list(FEATURES), "weight": np.round(weights.weight, DIGITS).tolist(), **numbers}
    return FitResult(found, metrics, {"split": settings.split, "maps": settings.maps, "scans": len(rows)})


def fit(settings: LocateOdds, log_line: LogFn) -> dict[str, float]:
    """Fit the odds; the scores of buildings that were left out."""
    return run_fit(settings, fit_locate, log_line)


def judge(settings: LocateOdds, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Score weights on another split."""
    held = json.loads(file.read_text(encoding="utf-8"))
    rows = build_rows("test", settings.maps, Path(settings.cache) / "locate" / "test", log_line)
    return score_choices(rows, LocateWeights(np.array(held["weight"]), held["nowhere"], held["chance"], held["usual"]))


TASK = Task(LocateOdds, fit, ("log_loss",), judge, "topomerge.fusion.atlas", "locate_odds.json", hours=0.2, lower=("log_loss",))
