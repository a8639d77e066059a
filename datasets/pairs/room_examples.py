"""Rooms of simulated scans with what is true about them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import shapely
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

from topomerge import archive
from topomerge.extraction.extract import extract
from topomerge.extraction.room_odds import (
    GRID_FEATURES,
    POSE_FEATURES,
    ROOM_FEATURES,
    compute_pose_features,
    compute_room_features,
)
from topomerge.extraction.scan import read_scan
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
    """The cloud with what the sensor sees from places around the building."""
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


def is_outdoor_pose(cloud: PointCloud, building: Building) -> Array:
    """Return (k,) bool, which poses of a cloud in the building's frame are outside of its rooms."""
    assert cloud.poses is not None
    return ~shapely.contains_xy(compute_footprint(building), cloud.poses[:, :2, 3])


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
    """Draw the item of a seed: that of `scan_items`."""
    return RoomItem(**asdict(draw_item(seed, plans, flat)), surroundings=surroundings)


def make_room_file(item: RoomItem, plan: Plan | None, folder: str) -> BuildRow:
    """Make an item's file."""
    return make_item(item.name, folder, lambda: build_room_rows(item, plan), LONGEST_SCAN)


def build_room_rows(item: RoomItem, plan: Plan | None) -> Mapping[str, Array]:
    """Features and answers of the rooms of a scan: `x` and answers without poses; `posed.x`, `posed.p` and answers with them. `x`
    are `GRID_FEATURES` of robots' grids of buildings that stand in the open."""
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
