"""Scans of buildings that stand in the open, through whose windows and doors a sensor sees what nobody entered.

Robots' grids hold fans of rays there, which end at the laser's range or behind a pane. Scans hold gardens, streets and facades;
some surveyors stepped out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
from topomerge.datasets.buildings.erect import erect
from topomerge.datasets.buildings.outdoors import DROP, footprint_of, with_outdoors
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.buildings.profiles import BUILDING_KINDS
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.plan import Plan
from topomerge.datasets.pairs.robot_grid import robot_grid
from topomerge.datasets.pairs.scan_items import ROOMS_VISITED, PlanItem, SimulatedScan, draw_difficulty, draw_source
from topomerge.datasets.simulation.scanner import scan, seen_from_poses
from topomerge.datasets.simulation.sensors import Sensor, get_sensor
from topomerge.datasets.simulation.spoils import exact_sensor
from topomerge.datasets.simulation.walk import part

from topomerge.types import Array, PointCloud, Sim3

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


def open_scan(item: PlanItem, plan: Plan | None) -> SimulatedScan:
    """Simulate the scan of an item in a building with its surroundings: a robot's grid where the item is flat.

    Args:
        plan: the real plan that it names; None: its building is procedural.
    """
    rng = np.random.default_rng(item.seed)
    difficulty = draw_difficulty(rng)
    source, _ = draw_source(rng, item.flat)
    if plan is not None:
        rng.integers(item.candidates)  # which plan: drawn already
        building = erect([plan], difficulty, rng, f"{source}-{item.seed}")
    else:
        floors = 1 if item.flat else int(rng.choice([1, 1, 2]))
        building = make_building(str(rng.choice(BUILDING_KINDS)), item.seed, floors, difficulty)
    if rng.random() < OPEN_SHARE:
        building = with_outdoors(building, rng)
    visited = part(building, int(rng.integers(*(ROOMS_DRIVEN if item.flat and item.seed % 2 == 0 else ROOMS_VISITED))), rng)
    frame = Sim3(float(rng.uniform(-np.pi, np.pi)) if rng.random() < 0.75 else 0.0)
    if item.flat:
        laser = replace(get_sensor("laser2d"), height=float(rng.uniform(*LASER_HEIGHTS)), reach=(0.1, LASER_REACH))
        cleared = float(np.exp(rng.uniform(*np.log(CLEARED))))
        cloud = replace(robot_grid(building, laser, visited, rng, Sim3(), cleared), rooms=(), labels=None)
        return SimulatedScan(building, "robot", visited, cloud, None, frame)
    sensor = exact_sensor(get_sensor(str(rng.choice(list(OPEN_SENSORS), p=list(OPEN_SENSORS.values())))))
    cloud = replace(scan(building, sensor, visited, rng, max(sensor.spacing, SPACING)), rooms=(), labels=None)
    if rng.random() < STEPPED_OUT:
        cloud = _with_stands(cloud, building, sensor, rng)
    return SimulatedScan(building, sensor.name, visited, cloud, None, frame)


def _with_stands(cloud: PointCloud, building: Building, sensor: Sensor, rng: np.random.Generator) -> PointCloud:
    """The cloud with what the sensor sees from places around the building."""
    assert cloud.poses is not None and cloud.pose_of is not None
    ring = footprint_of(building).buffer(float(rng.uniform(*STAND_AWAY))).boundary
    first, count = float(rng.random()), int(rng.integers(*STANDS))
    level = float(building.storeys["floor"][0]) - DROP[0] + sensor.height
    poses = []
    for k in range(count):
        at = shapely.line_interpolate_point(ring, (first + 0.07 * k) % 1, normalized=True)
        for turn in range(sensor.turns):
            poses.append(Sim3(2 * np.pi * turn / sensor.turns, (at.x, at.y, level)).matrix)
    points, pose = seen_from_poses(building, sensor, np.array(poses), OUTDOOR_RAYS // sensor.turns, rng)
    return replace(
        cloud,
        points=np.concatenate([cloud.points, (points - cloud.shift).astype(np.float32)]),
        poses=np.concatenate([cloud.poses, poses]),
        pose_of=np.concatenate([cloud.pose_of, pose + len(cloud.poses)]).astype(cloud.pose_of.dtype),
    )


def stood_outdoors(cloud: PointCloud, building: Building) -> Array:
    """(k,) bool: which poses of a cloud in the building's frame are outside of its rooms."""
    assert cloud.poses is not None
    return ~shapely.contains_xy(footprint_of(building), cloud.poses[:, :2, 3])
