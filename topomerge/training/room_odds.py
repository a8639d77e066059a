"""Task `room_odds`: is a room of a map one, whole, entered, outside (`extraction.room_odds`)?

Simulated scans are extracted with and without the sensor's places, robots' grids and scans of buildings with their surroundings
without; what is true about their rooms answers. Each scan counts alike per root of its rooms, so that hospitals do not outweigh
flats.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from scipy.optimize import minimize
from scipy.stats import rankdata

from topomerge import archive
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.buildings.layouts import BUILDING_KINDS
from topomerge.datasets.buildings.outdoors import DROP, add_outdoors, compute_footprint
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.builder import BuildRow, BuildSettings, make_item
from topomerge.datasets.core.building import Building, Plan
from topomerge.datasets.pairs.flat_maps import simulate_robot_grid
from topomerge.datasets.pairs.plan_examples import (
    LONGEST_SCAN,
    ROOMS_VISITED,
    VOXEL_SIZES,
    PlanItem,
    PlanRecipe,
    Plans,
    SimulatedScan,
    build_scans,
    draw_difficulty,
    draw_item,
    draw_source,
    simulate_item_scan,
)
from topomerge.datasets.simulation.floor_truth import build_truth, compute_room_truth, transform_truth
from topomerge.datasets.simulation.scanner import scan_building, scan_from_poses, transform_cloud
from topomerge.datasets.simulation.sensors import Sensor, get_sensor, remove_sensor_drift
from topomerge.datasets.simulation.walk import sample_part
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.extraction.room_odds import (
    ENTERED_BY_POSES,
    FAMILIES,
    GRID_FEATURES,
    POSE_FEATURES,
    ROOM_FEATURES,
    Family,
    build_model_inputs,
    compute_pose_features,
    compute_room_features,
    load_room_weights,
)
from topomerge.extraction.scan import read_scan
from topomerge.numpy_nn import sigmoid
from topomerge.training.closed_form import FitResult, compute_calibration_error, run_fit
from topomerge.training.packed_pairs import number_buildings, read_scan_building
from topomerge.training.scan_settings import RoomOdds
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn, PointCloud, Sim3

OPEN_SHARE = 0.85  # of the buildings that anything stands around
OPEN_SENSORS = {"tls": 0.4, "lidar": 0.3, "depth": 0.15, "tablet": 0.15}
LASER_HEIGHTS = (0.2, 1.2)  # m of robots' lasers; the higher ones look over sills
ROOMS_DRIVEN = (4, 16)  # at least, less than, that every second robot drives through: it maps most of a flat
LASER_REACH = 40.0  # m
CLEARED = (4.0, 25.0)  # m of their rays that robots believe
SPACING = 0.05  # m between points, at least
STEPPED_OUT = 0.5  # of the surveyors
STANDS = (2, 6)  # places outdoors, at least, less than
STAND_AWAY = (1.0, 5.0)  # m from the walls
OUTDOOR_RAYS = 60_000  # of a stand


def simulate_open_scan(item: PlanItem, plan: Plan | None) -> SimulatedScan:
    """Simulate the scan of an item in a building with its surroundings: a robot's grid where the item is flat.

    Args:
        plan: the real plan that it names; None: its building is procedural.
    """
    rng = np.random.default_rng(item.seed)
    difficulty = draw_difficulty(rng)
    source, _ = draw_source(rng, item.flat)
    if plan is not None:
        rng.integers(item.candidates)  # which plan: drawn already
        building = build_building([plan], difficulty, rng, f"{source}-{item.seed}")
    else:
        floors = 1 if item.flat else int(rng.choice([1, 1, 2]))
        building = make_building(str(rng.choice(BUILDING_KINDS)), item.seed, floors, difficulty)
    if rng.random() < OPEN_SHARE:
        building = add_outdoors(building, rng)
    visited = sample_part(
        building, int(rng.integers(*(ROOMS_DRIVEN if item.flat and item.seed % 2 == 0 else ROOMS_VISITED))), rng
    )
    frame = Sim3(float(rng.uniform(-np.pi, np.pi)) if rng.random() < 0.75 else 0.0)
    if item.flat:
        laser = replace(get_sensor("laser2d"), height=float(rng.uniform(*LASER_HEIGHTS)), reach=(0.1, LASER_REACH))
        cleared = float(np.exp(rng.uniform(*np.log(CLEARED))))
        cloud = replace(simulate_robot_grid(building, laser, visited, rng, Sim3(), cleared), rooms=(), labels=None)
        return SimulatedScan(building, "robot", visited, cloud, None, frame)
    sensor = remove_sensor_drift(get_sensor(str(rng.choice(list(OPEN_SENSORS), p=list(OPEN_SENSORS.values())))))
    cloud = replace(scan_building(building, sensor, visited, rng, max(sensor.spacing, SPACING)), rooms=(), labels=None)
    if rng.random() < STEPPED_OUT:
        cloud = _add_outdoor_scans(cloud, building, sensor, rng)
    return SimulatedScan(building, sensor.name, visited, cloud, None, frame)


def _add_outdoor_scans(cloud: PointCloud, building: Building, sensor: Sensor, rng: np.random.Generator) -> PointCloud:
    """Add to the cloud what the sensor sees from places around the building."""
    assert cloud.poses is not None and cloud.pose_of is not None
    ring = compute_footprint(building).buffer(float(rng.uniform(*STAND_AWAY))).boundary
    first, count = float(rng.random()), int(rng.integers(*STANDS))
    level = float(building.storeys["floor"][0]) - DROP[0] + sensor.height
    poses = []
    for k in range(count):
        at = shapely.line_interpolate_point(ring, (first + 0.07 * k) % 1, normalized=True)
        for turn in range(sensor.turns):
            poses.append(Sim3(2 * np.pi * turn / sensor.turns, (at.x, at.y, level)).matrix)
    points, pose = scan_from_poses(building, sensor, np.array(poses), OUTDOOR_RAYS // sensor.turns, rng)
    return replace(
        cloud,
        points=np.concatenate([cloud.points, (points - cloud.shift).astype(np.float32)]),
        poses=np.concatenate([cloud.poses, poses]),
        pose_of=np.concatenate([cloud.pose_of, pose + len(cloud.poses)]).astype(cloud.pose_of.dtype),
    )


ROOM_EXAMPLE_FORMAT = 6  # raise it when the same item gives other bytes: it is part of the files' names
ANSWERS = ("one", "whole", "entered", "outside")


@dataclass(frozen=True)
class RoomItem(PlanItem):
    """As of plans, and does the building stand in the open? What is made of it has a version of its own."""

    surroundings: bool = False

    @property
    def name(self) -> str:
        """A hash of the inputs and of the version of what is made from them."""
        return self.compute_name(ROOM_EXAMPLE_FORMAT)


def build_rooms(recipe: PlanRecipe, sharing: BuildSettings, log_line: LogFn = lambda text: None) -> list[Path]:
    """Build the files of a set, made where they are missing, in the order of the seeds."""
    draw = partial(draw_room_item, flat=recipe.flat, surroundings=recipe.surroundings)
    return build_scans(recipe, "rooms", draw, make_room_file, sharing, log_line)[0]


def draw_room_item(seed: int, plans: Plans, flat: bool = False, surroundings: bool = False) -> RoomItem:
    """Draw the item of a seed: that of `draw_item`."""
    return RoomItem(**asdict(draw_item(seed, plans, flat)), surroundings=surroundings)


def make_room_file(item: RoomItem, plan: Plan | None, folder: str) -> BuildRow:
    """Make an item's file."""
    return make_item(item.name, folder, lambda: build_room_rows(item, plan), LONGEST_SCAN)


def build_room_rows(item: RoomItem, plan: Plan | None) -> Mapping[str, Array]:
    """Build the features and answers of the rooms of a scan: `x` and answers without poses; `posed.x`, `posed.p` and answers with
    them. `x` are `GRID_FEATURES` of robots' grids of buildings that stand in the open."""
    scan = simulate_open_scan(item, plan) if item.surroundings else simulate_item_scan(item, plan)
    features = GRID_FEATURES if item.surroundings and item.flat else ROOM_FEATURES
    visited = np.isin(np.arange(len(scan.building.rooms)), scan.visited)
    anchors, drift = scan.shift or (None, None)
    points = scan.cloud.points.astype(np.float64) + scan.cloud.shift
    truth = transform_truth(build_truth(scan.building, visited, points, anchors, drift), scan.frame)
    cloud, voxel = transform_cloud(scan.cloud, scan.frame), VOXEL_SIZES[item.seed % len(VOXEL_SIZES)]
    arrays: dict[str, Array] = {}
    for prefix, source in (("", replace(cloud, poses=None, pose_of=None)), ("posed.", cloud)):
        if prefix and (source.poses is None or item.surroundings):
            continue
        map = extract(source, voxel_size=voxel, carve=False)
        answers = compute_room_truth(map, truth, scan.building.rooms)
        rows = answers.judged
        arrays |= {f"{prefix}{name}": getattr(answers, name)[rows] for name in ANSWERS}
        arrays[f"{prefix}x"] = compute_room_features(map, features)[rows]
        if prefix:
            poses = compute_pose_features(map, read_scan(cloud, voxel).rays)
            arrays["posed.p"] = (np.full((len(rows), len(POSE_FEATURES)), np.nan) if poses is None else poses)[rows]
    about = {"file": f"{item.name}.npz", **asdict(item), "sensor": scan.sensor}
    return {**arrays, "about": np.frombuffer(json.dumps(about, sort_keys=True).encode(), np.uint8)}


def read_room_rows(path: Path) -> dict[str, Array]:
    """Read the arrays of a file, and its sensor.

    Raises:
        InputError: it is damaged.
    """
    arrays = archive.read(path, "cached rooms")
    arrays["sensor"] = np.array(json.loads(arrays.pop("about").tobytes())["sensor"])
    return arrays


CLIPPED = (0.005, 0.995)  # quantiles that features are clipped to
ANSWER_OF = {"confidence": "one", "whole": "whole", "entered": "entered", "outside": "outside", ENTERED_BY_POSES: "posed.entered"}
Rows = Mapping[str, Array]  # of one scan, as `build_room_rows` makes them


def fit(settings: RoomOdds, log_line: LogFn) -> dict[str, float]:
    """Fit all models; the scores of left-out scans."""
    return run_fit(settings, fit_room_odds, log_line)


def fit_room_odds(settings: RoomOdds, log_line: LogFn) -> FitResult:
    """Fit weights from all scans, and scores of those that were fitted without each fold of them.

    Raises:
        InputError: `fit` names no family, or no scan could be made.
    """
    if not settings.fit or set(settings.fit) - set(FAMILIES):
        raise InputError(f"fit must be some of {', '.join(FAMILIES)}, not {settings.fit}")
    weights: dict[str, Any] = {} if set(settings.fit) == set(FAMILIES) else load_room_weights()
    scores: dict[str, float] = {}
    origin: dict[str, Any] = {"split": list_recipes(settings, heldout=False)[settings.fit[0]][0].split}
    for key in settings.fit:
        family, sets = FAMILIES[key], list_recipes(settings, heldout=False)[key]
        scans = [scan for recipe in sets for scan in build_room_scans(recipe, settings, log_line)]
        origin[key] = {"sets": [recipe.name for recipe in sets], "scans": len(scans)}
        scores |= _score_left_out(family, scans, settings)
        weights = merge_family_weights(weights, family, fit_family_weights(family, scans, settings.l2))
    return FitResult(weights, scores, origin)


def list_recipes(settings: RoomOdds, heldout: bool) -> dict[str, list[PlanRecipe]]:
    """Return the sets of scans of each of `FAMILIES`, to fit to or to judge on. What lies outside is told in ordinary scans,
    too."""
    if heldout:
        return {
            "scans": [settings.heldout],
            "open": [settings.heldout_open, settings.heldout],
            "grids": [settings.heldout_grids],
        }
    return {"scans": [settings.data], "open": [settings.open, settings.closed], "grids": [settings.grids]}


def merge_family_weights(weights: dict[str, Any], family: Family, fitted: dict[str, Any]) -> dict[str, Any]:
    """Return the weights with those of a family in place of its earlier ones."""
    return {**weights, family.key: fitted} if family.key else {**weights, **fitted}


def _score_left_out(family: Family, scans: Sequence[Rows], settings: RoomOdds) -> dict[str, float]:
    """Return the scores of a family's models on buildings that were left out of the fit, a fold at a time."""
    fold = number_buildings([str(scan["building"]) for scan in scans]) % settings.folds
    guesses: dict[str, list[Array]] = {name: [] for name in family.lengths}
    for k in range(settings.folds):
        rest = [scan for scan, at in zip(scans, fold, strict=True) if at != k]
        if len(rest) < len(scans):
            weights = fit_family_weights(family, rest, settings.l2)
            _append_predictions(weights, family, [scan for scan, at in zip(scans, fold, strict=True) if at == k], guesses)
    return _score_family(family, guesses)


def build_room_scans(recipe: PlanRecipe, settings: RoomOdds, log_line: LogFn) -> list[Rows]:
    """Build the rooms of each scan of a set that has any, cached.

    Raises:
        InputError: no scan could be made.
    """
    paths = build_rooms(recipe, settings, log_line)
    scans: list[Rows] = [{**read_room_rows(path), "building": np.array(read_scan_building(path))} for path in paths]
    scans = [scan for scan in scans if len(scan["x"])]
    if not scans:
        raise InputError(f"{recipe.name}: no scan could be made; see the reasons above")
    return scans


def fit_family_weights(family: Family, scans: Sequence[Rows], l2: float) -> dict[str, Any]:
    """Fit the weights of a family in `room_odds.json`."""
    x = np.concatenate([scan["x"] for scan in scans])
    low, high = np.quantile(x, CLIPPED, axis=0)
    clipped = np.clip(x, low, high)
    standard = {"low": low, "high": high, "mean": clipped.mean(axis=0), "scale": clipped.std(axis=0) + 1e-3}
    weights: dict[str, Any] = {"features": list(family.features)}
    weights |= {name: np.round(values, 4).tolist() for name, values in standard.items()}
    for name in family.lengths:
        tables = [table for scan in scans if len(table := _build_table(weights, family, scan, name)[0])]
        answers = [answer for scan in scans if len(answer := _build_table(weights, family, scan, name)[1])]
        if not tables:
            raise InputError("data.scans: too few scans: none has poses")
        weights[name] = np.round(_fit_logistic(tables, answers, l2), 4).tolist()
    return weights


def _build_table(weights: dict[str, Any], family: Family, scan: Rows, name: str) -> tuple[Array, Array]:
    """Return the inputs of a model and answers, of the rooms of a scan; none where the model needs poses and the scan has
    none."""
    if name != ENTERED_BY_POSES:
        return build_model_inputs(weights, family, scan["x"]), scan[ANSWER_OF[name]]
    if "posed.x" not in scan or not np.isfinite(scan["posed.p"]).all():
        return np.zeros((0, family.lengths[name])), np.zeros(0, bool)
    return build_model_inputs(weights, family, scan["posed.x"], scan["posed.p"]), scan[ANSWER_OF[name]]


def _fit_logistic(tables: Sequence[Array], answers: Sequence[Array], l2: float) -> Array:
    """Return the weights of the most likely logistic model, pulled to 0 but for the constant."""
    x, y = np.concatenate(tables), np.concatenate(answers)
    share = np.concatenate([np.full(len(table), 1 / np.sqrt(len(table))) for table in tables])
    share *= len(share) / share.sum()
    sign = np.where(y, -1.0, 1.0)

    def loss(w: Array) -> tuple[float, Array]:
        odds = sign * (x @ w)
        slope = x.T @ (share * sign * sigmoid(np.clip(odds, -50, 50)))
        slope[1:] += 2 * l2 * w[1:]
        return float(share @ np.logaddexp(0, odds)) + l2 * float(w[1:] @ w[1:]), slope

    weights: Array = minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B").x
    return weights


def _append_predictions(weights: dict[str, Any], family: Family, scans: Sequence[Rows], guesses: dict[str, list[Array]]) -> None:
    """Add to each model's guesses (n, 2): probability and whether it is so."""
    for name in family.lengths:
        for scan in scans:
            table, answer = _build_table(weights, family, scan, name)
            p = sigmoid(np.clip(table @ np.array(weights[name]), -30, 30))
            guesses[name].append(np.column_stack([p, answer]))


def _score_family(family: Family, guesses: Mapping[str, Sequence[Array]]) -> dict[str, float]:
    scores: dict[str, float] = {}
    for name, parts in guesses.items():
        rows = np.concatenate([np.zeros((0, 2)), *parts])
        if len(rows):
            title = f"{family.key}_{name}" if family.key else name
            scores |= {f"{title}_{score}": value for score, value in score_predictions(rows[:, 0], rows[:, 1] > 0).items()}
    return scores


def score_predictions(p: Array, y: Array) -> dict[str, float]:
    """Return the area under the ROC curve (a half where all answers are alike), calibration error, log loss and share of answers
    that are yes, of probabilities (n,) and answers (n,) bool."""
    yes, no = int(y.sum()), int((~y).sum())
    above = (rankdata(p)[y].sum() - yes * (yes + 1) / 2) / (yes * no) if yes and no else 0.5
    p = np.clip(p, 1e-6, 1 - 1e-6)
    loss = -np.mean(np.log(np.where(y, p, 1 - p)))
    return {
        "auc": float(above),
        "calibration_error": compute_calibration_error(p, y),
        "log_loss": float(loss),
        "share": yes / len(y),
    }


def judge(settings: RoomOdds, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Return scores of weights on scans of buildings that trained nothing."""
    weights = json.loads(file.read_text(encoding="utf-8"))
    scores: dict[str, Any] = {}
    for key, sets in list_recipes(settings, heldout=True).items():
        family = FAMILIES[key]
        scans = [scan for recipe in sets for scan in build_room_scans(recipe, settings, log_line)]
        guesses: dict[str, list[Array]] = {name: [] for name in family.lengths}
        _append_predictions(weights[family.key] if family.key else weights, family, scans, guesses)
        scores |= _score_family(family, guesses)
    return scores


TASK = Task(
    RoomOdds, fit, ("entered_auc", "whole_auc", "confidence_auc"), judge, "topomerge.extraction", "room_odds.json", hours=0.5
)
