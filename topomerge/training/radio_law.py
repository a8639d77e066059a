"""Task `radio_law`: how alike readings of radio are at a distance and through floors (`landmarks.radio`).

Counts of pairs of scans of two sets of walks of one storey, and of storeys that lie above each other in one frame, of one mall.
Each storey is scored by the law of the others. So are poses that are found from radio alone: of them the odds are fitted that a
pose is right, by how many places testify (logistic regression).
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.optimize import minimize

from topomerge import archive
from topomerge.datasets.real.wifi_malls import ALIGNED, WIFI_STOREYS, WifiStorey, read_wifi_storey, split_walks
from topomerge.errors import InputError
from topomerge.landmarks.radio import (
    APART,
    DISTANCE_EDGES,
    LIKENESS_EDGES,
    RADIO_LAW_FILE,
    RadioLaw,
    RadioScans,
    classify_likeness,
    collect_radio_scans,
    compare_scans,
    convert_law,
    measure_apart,
    score_scans,
)
from topomerge.landmarks.radio_search import RIGHT, compute_pose_features, propose_scan_poses
from topomerge.training.closed_form import FitResult, run_fit
from topomerge.training.task_settings import RadioLawFit
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn, Sim3

SPLITS = ((0, 1), (8, 8))  # walks of each map (0: half of all) and how often they are drawn: dense maps and sparse ones
SMOOTHING = 20.0  # pairs that each class of likeness has at least, spread as over all distances
PAIRS_A_STOREY = 1e5  # that its splits of one kind count as
DIGITS = 2
FIT_SEED, JUDGE_SEED = 500, 900  # first of the splits of small maps


Counts = Mapping[tuple[str, str], Array]


def count_pairs(storeys: Mapping[str, WifiStorey]) -> Counts:
    """Count the pairs of scans of each storey and of each two that lie above each other: (D, K) by distance and likeness."""
    counts: dict[tuple[str, str], Array] = {}
    for name, storey in storeys.items():
        total = np.zeros((len(DISTANCE_EDGES), len(LIKENESS_EDGES) + 1))
        for walks, many in SPLITS:
            some = sum((_count_split(storey, walks, seed) for seed in range(many)), np.zeros(total.shape))
            total += some * (PAIRS_A_STOREY / some.sum())
        counts[name, name] = total
    scans = {name: collect_radio_scans(storeys[name].landmarks) for name in ALIGNED if name in storeys}
    for lower, upper in combinations(scans, 2):
        distance, _ = measure_apart(scans[lower].position, scans[upper].position)
        counts[lower, upper] = _count(distance, compare_scans(scans[lower], scans[upper]).compute())
    return counts


def sum_counts(counts: Counts, names: Sequence[str]) -> Array:
    """Sum the counts of some storeys by (storeys apart, distance, likeness)."""
    total = np.zeros((APART, len(DISTANCE_EDGES), len(LIKENESS_EDGES) + 1))
    for (lower, upper), some in counts.items():
        if lower in names and upper in names:
            apart = 0 if lower == upper else min(ALIGNED.index(upper) - ALIGNED.index(lower), APART - 1)
            total[apart] += some
    return total


def _count_split(storey: WifiStorey, walks: int, seed: int) -> Array:
    a, b, truth = split_walks(storey, seed, walks)
    scans = collect_radio_scans(a.landmarks), collect_radio_scans(b.landmarks)
    return _count(measure_apart(scans[0].position, truth.apply(scans[1].position))[0], compare_scans(*scans).compute())


def _count(distance: Array, likeness: Array) -> Array:
    classes = len(LIKENESS_EDGES) + 1
    step = np.digitize(distance, DISTANCE_EDGES[1:])
    counted = np.bincount((step * classes + classify_likeness(likeness)).ravel(), minlength=len(DISTANCE_EDGES) * classes)
    return counted.reshape(-1, classes)


def build_law(counts: Array, discount: float = 1.0, pose_discount: float = 1.0, blur: float = 0.5) -> RadioLaw:
    """Build the law of counts of pairs, smoothed over classes of likeness and distance."""
    smooth = counts / np.maximum(counts.sum(axis=2, keepdims=True), 1)
    smooth = ndimage.gaussian_filter1d(smooth, 0.7, axis=2, mode="nearest")
    usual = smooth.mean(axis=1, keepdims=True)
    total = counts.sum(axis=2, keepdims=True)
    share = (smooth * total + SMOOTHING * usual + 1.0) / (total + SMOOTHING + counts.shape[2])
    share /= share.sum(axis=2, keepdims=True)
    return RadioLaw(np.log(share), discount, pose_discount, blur)


DISCOUNTS = (0.5, 1.0, 2.0)  # that are tried
FEW_WALKS = (4, 10)  # of each map, by which the discount is chosen
DRAWN = 4  # pairs of maps of each storey and number of walks
SHIFT = 30.0  # m, of poses that are wrong
SURE_OF = 1e-3  # probabilities are that far from 0 and 1 at least


@dataclass(frozen=True, eq=False)
class RadioCase:
    """Scans of two small maps, a pose T_ab, and whether the alternative is right (the pose is wrong)."""

    a: RadioScans
    b: RadioScans
    pose: Sim3
    alternative: str
    right: bool


def draw_cases(storeys: Mapping[str, WifiStorey], names: Sequence[str], seed: int) -> list[RadioCase]:
    """Draw right poses of small maps of some storeys, poses that are 30 m off, and maps of two storeys."""
    cases = []
    for name, walks, k in product(names, FEW_WALKS, range(DRAWN)):
        a, b, truth = split_walks(storeys[name], seed + k, walks)
        first, second = collect_radio_scans(a.landmarks), collect_radio_scans(b.landmarks)
        angle = np.random.default_rng([seed, k]).uniform(-np.pi, np.pi)
        off = Sim3(0.0, (float(SHIFT * np.cos(angle)), float(SHIFT * np.sin(angle)), 0.0)) @ truth
        cases += [RadioCase(first, second, truth, "elsewhere", False), RadioCase(first, second, off, "elsewhere", True)]
        above = [n for n in ALIGNED if n in storeys and name in ALIGNED and abs(ALIGNED.index(n) - ALIGNED.index(name)) == 1]
        if above:
            _, other, pose = split_walks(storeys[above[k % len(above)]], seed + k, walks)
            upper = collect_radio_scans(other.landmarks)
            cases += [RadioCase(first, second, truth, "storey", False), RadioCase(first, upper, pose, "storey", True)]
    return cases


def score_cases(cases: Sequence[RadioCase], law: RadioLaw) -> dict[str, Array]:
    """Score cases: alternative -> (n, 2), its log likelihood ratio against "here", and is it right?"""
    rows: dict[str, list[tuple[float, bool]]] = {"elsewhere": [], "storey": []}
    for case in cases:
        rows[case.alternative].append((score_scans(case.a, case.b, case.pose, law)[case.alternative], case.right))
    return {key: np.array(values, float).reshape(-1, 2) for key, values in rows.items()}


def measure_log_loss(verdicts: Mapping[str, Array]) -> float:
    """Measure the mean log loss of verdicts, right and wrong poses alike likely before."""
    rows = np.concatenate(list(verdicts.values()))
    p = np.clip(1 / (1 + np.exp(-rows[:, 0])), SURE_OF, 1 - SURE_OF)
    return float(-np.mean(np.where(rows[:, 1] > 0, np.log(p), np.log1p(-p))))


def fit_left_out(counts: Counts, discount: float = 1.0) -> dict[str, RadioLaw]:
    """Fit for each storey the law of the others."""
    return {name: build_law(sum_counts(counts, [n for n in WIFI_STOREYS if n != name]), discount) for name in WIFI_STOREYS}


ODDS_WALKS, ODDS_DRAWN, ODDS_SEED = (5, 8, 12, 15, 25, 40), 8, 3000  # walks of a map, trials of each storey, first seed
ROWS_VERSION = 1  # of the trials that are kept: raise it where poses are searched otherwise
SHRINK = 1e-3  # of squared weights of standardised features


def build_trials(storeys: Mapping[str, WifiStorey], counts: Counts, folder: Path, log_line: LogFn) -> dict[str, Array]:
    """Search poses of small maps of each storey by the law of the others: storey -> (n, 5) features of the likeliest one, and how
    far off it is, m; kept in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    found = {}
    for name, law in fit_left_out(counts).items():
        key = hashlib.sha256(law.log_density.round(6).tobytes()).hexdigest()[:12]
        path = folder / f"poses_{ROWS_VERSION}_{ODDS_DRAWN}_{name}_{key}.npz"
        if not path.exists():
            seeds = range(ODDS_SEED, ODDS_SEED + ODDS_DRAWN)
            rows = [search_trial(storeys[name], law, walks, seed) for walks, seed in product(ODDS_WALKS, seeds)]
            archive.write({"trials": np.array([row for row in rows if row is not None])}, path)
            log_line(f"{name}: poses of {len(rows)} pairs of maps")
        found[name] = archive.read(path)["trials"]
    return found


def search_trial(storey: WifiStorey, law: RadioLaw, walks: int, seed: int) -> Array | None:
    """Search the pose of two small maps: (5,) its features and its error, m; None where nothing is proposed."""
    a, b, truth = split_walks(storey, seed, walks)
    first, second = collect_radio_scans(a.landmarks), collect_radio_scans(b.landmarks)
    poses = propose_scan_poses(first, second, 5, law)
    if not poses:
        return None
    off = poses[0].pose.apply(second.position) - truth.apply(second.position)
    return np.append(compute_pose_features(poses), np.hypot(off[:, 0], off[:, 1]).mean())


def fit_pose_odds(trials: Array) -> tuple[float, ...]:
    """Fit the weights of the log odds that a pose is right to (n, 5) trials."""
    right = trials[:, -1] <= RIGHT
    size = np.append(1.0, trials[:, 1:-1].std(axis=0) + 1e-9)
    x = trials[:, :-1] / size

    def loss(w: Array) -> tuple[float, Array]:
        z, kept = x @ w, np.append(0.0, w[1:])
        slope = x.T @ (1 / (1 + np.exp(-z)) - right) / len(x) + 2 * SHRINK * kept
        return float(np.mean(np.logaddexp(0.0, z) - right * z) + SHRINK * kept @ kept), slope

    fitted = minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B").x / size
    return tuple(float(weight) for weight in fitted)


def fit_left_out_odds(trials: Mapping[str, Array]) -> dict[str, tuple[float, ...]]:
    """Fit for each storey the odds of poses on the others."""
    return {name: fit_pose_odds(np.concatenate([rows for n, rows in trials.items() if n != name])) for name in trials}


def measure_pose_loss(trials: Mapping[str, Array]) -> float:
    """Measure the mean log loss of poses being right, of each storey by the odds of the others."""
    odds = fit_left_out_odds(trials)
    verdicts = {n: np.column_stack([rows[:, :-1] @ odds[n], rows[:, -1] <= RIGHT]) for n, rows in trials.items()}
    return measure_log_loss(verdicts)


def read_storeys() -> dict[str, WifiStorey]:
    """Read all storeys.

    Raises:
        InputError: TOPOMERGE_DATA names no folder with them.
    """
    folder = os.environ.get("TOPOMERGE_DATA", "")
    if not folder:
        raise InputError("TOPOMERGE_DATA must name the folder of the real data (it is not set)")
    return {name: read_wifi_storey(Path(folder), name) for name in WIFI_STOREYS}


def fit_radio(settings: RadioLawFit, log_line: LogFn) -> FitResult:
    """Return the law of all storeys, and the log loss of each storey by the law of the others."""
    storeys = read_storeys()
    counts = count_pairs(storeys)
    cases = {name: draw_cases(storeys, [name], settings.seed + FIT_SEED) for name in WIFI_STOREYS}
    losses = {}
    for discount in DISCOUNTS:
        laws = fit_left_out(counts, discount)
        losses[discount] = float(np.mean([measure_log_loss(score_cases(cases[name], laws[name])) for name in WIFI_STOREYS]))
        log_line(f"discount {discount:g}: log loss of storeys that were left out {losses[discount]:.3f}")
    discount = min(losses, key=lambda d: losses[d])
    law = build_law(sum_counts(counts, WIFI_STOREYS), discount)
    trials = build_trials(storeys, counts, Path(settings.cache) / "radio", log_line)
    weights = {
        "discount": law.discount,
        "pose_discount": law.pose_discount,
        "blur": law.blur,
        "pose_odds": np.round(fit_pose_odds(np.concatenate(list(trials.values()))), 4).tolist(),
        "log_density": np.round(law.log_density, DIGITS).tolist(),
    }
    scores = {"log_loss": losses[discount], "pose_log_loss": measure_pose_loss(trials)}
    return FitResult(weights, scores, {"set": "wifi_malls", "storeys": list(WIFI_STOREYS)})


def fit(settings: RadioLawFit, log_line: LogFn) -> dict[str, float]:
    """Fit the law; the log loss of storeys that were left out."""
    return run_fit(settings, fit_radio, log_line)


def judge(settings: RadioLawFit, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Log loss of a law on other draws of all storeys; those that it was fitted on stand in its card."""
    law = convert_law(json.loads(file.read_text(encoding="utf-8")))
    cases = draw_cases(read_storeys(), WIFI_STOREYS, settings.seed + JUDGE_SEED)
    return {"log_loss": measure_log_loss(score_cases(cases, law))}


TASK = Task(RadioLawFit, fit, ("log_loss",), judge, "topomerge.landmarks", RADIO_LAW_FILE, hours=0.5, lower=("log_loss",))
