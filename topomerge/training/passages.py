"""Task `passages`: how much all evidence together says of a door between two segments (`extraction.plans.passages`).

A logistic model for scans that show walls, pulled towards the plan's own answer: what evidence adds must show in the scans.
Slices have none: on them the plan alone was better.

A passage of the scans of `plan_examples` is an example where most of both segments lies in true rooms. Segments of one true room
are then merged, as a perfect score would, and what remains gives more examples.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from topomerge import archive
from topomerge.datasets.core.builder import BuildRow, BuildSettings, make_item
from topomerge.datasets.core.building import Plan
from topomerge.datasets.pairs.drawing import compute_plan_truth
from topomerge.datasets.pairs.plan_examples import LONGEST_SCAN, PlanItem, PlanRecipe, build_scans, draw_item, simulate_item_scan
from topomerge.datasets.simulation.scanner import transform_cloud
from topomerge.errors import InputError
from topomerge.extraction.extract import KINDS, SCORE_INPUTS, compute_inputs, gather_evidence, read_navigable
from topomerge.extraction.parameters import PRESETS, DefaultParameters
from topomerge.extraction.plans.passages import DOOR_FEATURES, compute_door_features
from topomerge.extraction.segment import GrowingRooms, SegmentedStorey, log_odds, score_by_plan
from topomerge.numpy_nn import sigmoid
from topomerge.progress import Stopwatch
from topomerge.training.closed_form import FitResult, compute_calibration_error, run_fit
from topomerge.training.packed_pairs import number_buildings, read_scan_building
from topomerge.training.scan_settings import Passages
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn

PASSAGE_FORMAT = 3  # raise it when the same item gives other bytes: it is part of the files' names
MAP_CELL = 0.1  # m
PURE = 0.7  # share of a segment in its true room; segments between rooms are no example


@dataclass(frozen=True)
class PassageItem(PlanItem):
    """As of plans: all that the bytes of one file depend on."""

    @property
    def name(self) -> str:
        """A hash of the inputs and of the version of what is made from them."""
        return self.compute_name(PASSAGE_FORMAT)


@dataclass(frozen=True, eq=False)
class PassageExamples:
    """The passages of a scan.

    Args:
        features: (n, 17) `DOOR_FEATURES`.
        plan: (n,) log odds of a door by the plan alone.
        shown: (n,) log odds of a door by the walls.
        parted: (n,) bool, do they part two true rooms?
        kind: "walls", or "" of a scan that shows none at heights (`passages.choose_scorer`).
        building: the physical one, where that is known.
    """

    features: Array
    plan: Array
    shown: Array
    parted: Array
    kind: str
    building: str = ""


def build_passages(recipe: PlanRecipe, sharing: BuildSettings, log_line: LogFn = lambda text: None) -> list[Path]:
    """Return the files of a set, made where they are missing, in the order of the seeds."""
    return build_scans(recipe, "passages", partial(_draw, flat=recipe.flat), make_passage_file, sharing, log_line)[0]


def make_passage_file(item: PlanItem, plan: Plan | None, folder: str) -> BuildRow:
    """Make an item's file."""
    return make_item(item.name, folder, lambda: _arrays(item, make_passages(item, plan)), LONGEST_SCAN)


def load_passages(path: Path) -> PassageExamples:
    """Return the passages of a file.

    Raises:
        InputError: it is damaged.
    """
    arrays = archive.read(path, "cached passages")
    values: dict[str, Any] = {name: arrays[name] for name in ("features", "plan", "shown", "parted")}
    return PassageExamples(**values, kind=str(arrays["kind"]))


def make_passages(item: PlanItem, plan: Plan | None) -> PassageExamples:
    """Return the passages of one scan."""
    simulated, p, watch = simulate_item_scan(item, plan), PRESETS["default"], Stopwatch()
    assert isinstance(p, DefaultParameters)
    scan, navigable = read_navigable(transform_cloud(simulated.cloud, simulated.frame), MAP_CELL, p, watch)
    found = gather_evidence(scan, navigable, p, watch)
    visited = set(simulated.visited.tolist())
    rows: list[tuple[Array, float, float, bool]] = []
    for storey in found.storeys:
        columns = np.stack(np.meshgrid(*(np.arange(n) for n in storey.segment.shape), indexing="ij"), axis=-1)
        flat = storey.plan.origin + (columns + 0.5) * storey.plan.edge
        places = np.concatenate([flat, storey.plan.floor[..., None]], axis=-1)
        rows += collect_storey_passages(
            storey, compute_plan_truth(simulated.building, storey.plan, places, simulated.frame, simulated.shift)[0], visited
        )
    count, kind = len(rows), "walls" if found.walls is not None else ""
    features, odds, shown, parted = zip(*rows, strict=True) if rows else ((), (), (), ())
    return PassageExamples(
        np.array(features, float).reshape(count, len(DOOR_FEATURES)),
        np.array(odds, float),
        np.array(shown, float),
        np.array(parted, bool),
        kind,
    )


def collect_storey_passages(storey: SegmentedStorey, truth: Array, visited: set[int]) -> list[tuple[Array, float, float, bool]]:
    """Collect the features, log odds by the plan and by the walls, and the answer of the passages of a storey.

    They are collected before and while segments of one true room are merged.

    Args:
        truth: (nx, ny) true room of each column, -1 none.
        visited: rooms that the surveyor was in; passages between others are no examples.
    """
    inside = storey.segment >= 0
    votes = np.zeros((storey.count, int(truth.max(initial=-1)) + 2))  # the last column: of no room
    np.add.at(votes, (storey.segment[inside], truth[inside]), 1)
    room = np.where(votes.max(axis=1, initial=0) >= PURE * votes.sum(axis=1), votes.argmax(axis=1), -1)
    room[room == votes.shape[1] - 1] = -1
    growing = GrowingRooms(storey.segment, storey.clearance, storey.passages, storey.plan.edge, score_by_plan)
    rows: list[tuple[Array, float, float, bool]] = []

    def add(pairs: list[tuple[int, int]]) -> None:
        for a, b in pairs:
            if room[a] >= 0 and room[b] >= 0 and (room[a] in visited or room[b] in visited):
                passage, odds = growing.passages[a, b], float(log_odds(np.array(growing.door_probability[a, b])))
                features = compute_door_features(passage, growing.peak[[a, b]], growing.area[[a, b]])
                rows.append((features, odds, passage.shown, bool(room[a] != room[b])))

    add(list(growing.passages))
    while same := [pair for pair in growing.passages if room[pair[0]] >= 0 and room[pair[0]] == room[pair[1]]]:
        weakest = min(same, key=lambda pair: (growing.door_probability[pair], pair))
        growing.merge(weakest)
        add([pair for pair in growing.passages if weakest[0] in pair])
    return rows


def _draw(seed: int, plans: Any, flat: bool) -> PassageItem:
    return PassageItem(**asdict(draw_item(seed, plans, flat)))


def _arrays(item: PlanItem, examples: PassageExamples) -> dict[str, Array]:
    """Return the arrays of a file."""
    about = {"file": f"{item.name}.npz", **asdict(item)}
    values = {name: getattr(examples, name) for name in ("features", "plan", "shown", "parted")}
    return {**values, "kind": np.array(examples.kind), "about": np.frombuffer(json.dumps(about).encode(), np.uint8)}


PRIOR = np.array([float(name == "plan") for name in SCORE_INPUTS])  # weights are pulled to the plan alone
STIFF = np.array([1.0 if name == "constant" else 4.0 for name in SCORE_INPUTS])  # of each pull


def fit(settings: Passages, log_line: LogFn) -> dict[str, float]:
    """Fit the models; the scores of left-out scans."""
    return run_fit(settings, fit_passages, log_line)


def fit_passages(settings: Passages, log_line: LogFn) -> FitResult:
    """Fit the weights of the models from all scans; return them with the scores of those that were fitted without each
    building."""
    scans = read_scans(settings.data, settings, log_line)
    fold = number_buildings([scan.building for scan in scans]) % settings.folds
    parts = [[scan for scan, at in zip(scans, fold, strict=True) if at == k] for k in range(settings.folds)]
    left_out = []
    for k, part in enumerate(parts):
        weights = fit_models([scan for j, other in enumerate(parts) if j != k for scan in other], settings.l2)
        left_out += [score(scan, weights) for scan in part]
    origin = {"set": settings.data.name, "split": settings.data.split, "scans": len(scans)}
    return FitResult(fit_models(scans, settings.l2), compute_figures(left_out), origin)


def read_scans(recipe: PlanRecipe, settings: Passages, log_line: LogFn) -> list[PassageExamples]:
    """Return the passages of each scan of a set that shows any.

    Raises:
        InputError: too few scans.
    """
    paths = build_passages(recipe, settings, log_line)
    scans = [replace(load_passages(path), building=read_scan_building(path)) for path in paths]
    scans = [scan for scan in scans if scan.kind and len(scan.parted)]
    if len(scans) < settings.folds:
        raise InputError(f"data.scans={recipe.scans}: too few scans for {settings.folds} folds")
    return scans


def fit_models(scans: Sequence[PassageExamples], l2: float) -> dict[str, list[float]]:
    """Fit, of each of `KINDS`, the weights of `SCORE_INPUTS`; scans with many passages count less than proportionally."""
    models = {}
    for kind in KINDS:
        own = [scan for scan in scans if scan.kind == kind]
        weights = PRIOR
        if own:
            x = np.concatenate([compute_inputs(scan.plan, scan.shown) for scan in own])
            y = np.concatenate([scan.parted for scan in own])
            count = np.concatenate([np.full(len(scan.parted), 1 / np.sqrt(len(scan.parted))) for scan in own])
            weights = minimize(_loss, PRIOR, (x, y, count / count.mean(), l2), jac=True, method="BFGS").x
        models[kind] = np.round(weights, 3).tolist()
    return models


def _loss(weights: Array, x: Array, y: Array, count: Array, l2: float) -> tuple[float, Array]:
    """Return the negative log likelihood with what pulls the weights to `PRIOR`, and its gradient."""
    z, off = x @ weights, weights - PRIOR
    loss = float((count * np.logaddexp(0, np.where(y, -z, z))).sum() + l2 * (STIFF * off**2).sum() / 2)
    return loss, x.T @ (count * (sigmoid(z) - y)) + l2 * STIFF * off


def score(scan: PassageExamples, weights: dict[str, list[float]]) -> tuple[Array, Array, Array]:
    """Return (n,) probability of a door in each passage, of the plan alone, and are they doors?"""
    inputs = compute_inputs(scan.plan, scan.shown)
    return sigmoid(inputs @ np.array(weights[scan.kind])), sigmoid(scan.plan), scan.parted


def compute_figures(scans: Sequence[tuple[Array, Array, Array]]) -> dict[str, float]:
    """Log loss of all evidence and of the plan alone, calibration error, share of right answers at .5."""
    p, plan, y = (np.concatenate(arrays) for arrays in zip(*scans, strict=True))
    loss = {name: -np.mean(np.log(np.clip(np.where(y, q, 1 - q), 1e-6, 1))) for name, q in (("all", p), ("plan", plan))}
    return {
        "log_loss": float(loss["all"]),
        "log_loss_of_plan": float(loss["plan"]),
        "calibration_error": compute_calibration_error(p, y),
        "accuracy": float(((p > 0.5) == y).mean()),
        "accuracy_of_plan": float(((plan > 0.5) == y).mean()),
        "passages": float(len(y)),
    }


def judge(settings: Passages, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Return the scores of weights on scans of buildings that trained nothing."""
    weights = json.loads(file.read_text(encoding="utf-8"))
    return compute_figures([score(scan, weights) for scan in read_scans(settings.heldout, settings, log_line)])


TASK = Task(
    Passages, fit, ("log_loss", "accuracy"), judge, "topomerge.extraction", "passages.json", hours=0.2, lower=("log_loss",)
)
