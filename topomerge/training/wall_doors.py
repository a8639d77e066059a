"""Task `wall_doors`: how much what plans and what walls show says of a door (`extraction.elevations.wall_doors`).

The extraction's candidates in scans that did not train the networks of walls, which ship, those of doors without frames among
them, and in slices and grid maps; a candidate is a door where a true one lies near. There is a logistic model for each source.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.linear_model import LogisticRegression

from topomerge.archive import read_weights_json
from topomerge.datasets.pairs.plan_examples import PlanRecipe
from topomerge.datasets.pairs.wall_examples import build_walls, load_walls
from topomerge.errors import InputError
from topomerge.extraction.attributes import LEVEL_KINDS, find_rooms_at
from topomerge.extraction.elevations.doorways import StoreyWalls, classify_places, compute_door_probabilities
from topomerge.extraction.elevations.elevation import Elevations
from topomerge.extraction.elevations.wall_doors import (
    SOURCES,
    WALL_DOOR_FEATURES,
    WALL_DOORS_FILE,
    DoorCandidates,
    build_door_candidates,
    compute_door_probability,
)
from topomerge.extraction.plans.storey_plan import ClassifiedStorey
from topomerge.extraction.walls import find_doorways
from topomerge.metrics import match_places
from topomerge.training.closed_form import FitResult, compute_calibration_error, run_fit
from topomerge.training.packed_pairs import number_buildings, read_scan_building
from topomerge.training.scan_settings import WallDoors
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn, TopometricMap

FEWEST_DOORS = 5  # among the candidates of a source
NEAR_DOOR = 0.7  # m: of a door that lies farther off than the metrics allow (0.5 m) the rooms that it joins may still be right
Candidates = tuple[DoorCandidates, Array]  # of a scan, and (n,) which are doors


def fit(settings: WallDoors, log_line: LogFn) -> dict[str, float]:
    """Fit the models; the scores of left-out scans."""
    return run_fit(settings, fit_doors, log_line)


def fit_doors(settings: WallDoors, log_line: LogFn) -> FitResult:
    """Fit the weights of the models from all scans; return them with the scores of those that were fitted without each
    building."""
    recipes = (settings.data, settings.frameless, settings.flat)
    named = [scan for recipe in recipes for scan in build_candidates(recipe, settings, log_line)]
    scans, fold = [scan for _, scan in named], number_buildings([name for name, _ in named]) % settings.folds
    parts = [[scan for scan, at in zip(scans, fold, strict=True) if at == k] for k in range(settings.folds)]
    left_out = []
    for k, part in enumerate(parts):
        weights = fit_doors_model([scan for j, other in enumerate(parts) if j != k for scan in other], settings.l2)
        left_out += [(compute_door_probability(c, weights), y) for c, y in part]
    origin = {"set": settings.data.name, "split": settings.data.split, "scans": len(scans)}
    return FitResult(fit_doors_model(scans, settings.l2), score_doors(left_out), origin)


def build_candidates(recipe: PlanRecipe, settings: WallDoors, log_line: LogFn) -> list[tuple[str, Candidates]]:
    """Return the building of each scan of a set, and its candidates, by the network of elevations that ships.

    Raises:
        InputError: too few scans.
    """
    paths, _ = build_walls(recipe, settings, log_line)
    scans = []
    for path in paths:
        example = load_walls(path)
        candidates = find_candidates_of_map(example.map, example.storeys, example.elevations)
        right = np.zeros(len(candidates.edges), bool)
        right[match_places(example.doors, candidates.edges["centre"], NEAR_DOOR)[:, 1]] = True
        scans.append((read_scan_building(path), (candidates, right)))
    if len(scans) < settings.folds:
        raise InputError(f"data.scans={recipe.scans}: too few scans for {settings.folds} folds")
    return scans


def find_candidates_of_map(
    map: TopometricMap, storeys: Sequence[ClassifiedStorey], elevations: Elevations | None, classes: Array | None = None
) -> DoorCandidates:
    """Return the candidates of a map, by the network of elevations that ships.

    Args:
        storeys: what probably stands in the columns of its plans.
        elevations: its walls; None: it shows none at heights.
        classes: (n / 2, 7) of its walls; None: as the network has it.
    """
    walls = None
    if elevations is not None:
        classes = classify_places(elevations) if classes is None else classes
        doors = compute_door_probabilities(elevations, classes)
        walls = StoreyWalls(elevations, classes, doors, find_doorways(elevations, doors, partial(find_rooms_at, map)))
    level = map.edges[np.isin(map.edges["kind"], LEVEL_KINDS)]
    return build_door_candidates(level, map.rooms["completeness"], storeys, walls)


def fit_doors_model(scans: Sequence[Candidates], l2: float) -> dict[str, list[float]]:
    """Fit for each of `SOURCES` a constant and `WALL_DOOR_FEATURES` weights; where hardly any candidate is a door, those that
    ship stay: a constant of two doors would be chance."""
    x = np.concatenate([c.features for c, _ in scans])
    y, source = np.concatenate([y for _, y in scans]), np.concatenate([c.source for c, _ in scans])
    weights = dict(read_weights_json("topomerge.extraction.elevations", WALL_DOORS_FILE))
    for k, name in enumerate(SOURCES):
        own = source == k
        if 0 < y[own].sum() < FEWEST_DOORS:
            continue
        share = float(np.clip(y[own].mean(), 0.01, 0.99)) if own.any() else 0.5
        row = [float(np.log(share / (1 - share))), *[0.0] * len(WALL_DOOR_FEATURES)]
        if 0 < y[own].sum() < own.sum():
            model = LogisticRegression(C=1 / l2, max_iter=5000).fit(x[own], y[own])
            row = [float(model.intercept_[0]), *model.coef_[0].tolist()]
        weights[name] = np.round(row, 3).tolist()
    return weights


def score_doors(scans: Sequence[tuple[Array, Array]]) -> dict[str, float]:
    """Compute calibration error, precision and recall of the candidates at .5."""
    p, y = (np.concatenate(arrays) for arrays in zip(*scans, strict=True))
    predicted = p >= 0.5
    return {
        "calibration_error": compute_calibration_error(p, y),
        "precision": float(y[predicted].mean()) if predicted.any() else 0.0,
        "recall": float(predicted[y].mean()) if y.any() else 0.0,
        "candidates": float(len(y)),
    }


def judge(settings: WallDoors, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Return scores of weights on scans of buildings that trained nothing."""
    weights = json.loads(file.read_text(encoding="utf-8"))
    recipes = (settings.heldout, settings.heldout_frameless, settings.heldout_flat)
    scans = [scan for recipe in recipes for _, scan in build_candidates(recipe, settings, log_line)]
    return score_doors([(compute_door_probability(c, weights), y) for c, y in scans])


TASK = Task(WallDoors, fit, ("precision", "recall"), judge, "topomerge.extraction.elevations", "wall_doors.json", hours=0.2)
