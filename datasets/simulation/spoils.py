"""What is done to the points of a simulated scan: thinned, noisy, cut off above or below; and what undoes a drift."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
from topomerge.datasets.core.building import Building
from topomerge.datasets.simulation.sensors import Sensor, get_sensor

from topomerge.types import Array, PointCloud

DRIFT_SPACING = 0.5  # m between places whose drift is kept


def exact_sensor(sensor: Sensor) -> Sensor:
    """The same sensor, whose poses are known exactly."""
    exact: dict[str, Any] = {"drift": 0.0, "tilt": 0.0, "jitter": (0.0, 0.0)}
    return replace(sensor, **{f.name: exact[f.name] for f in fields(sensor) if f.name in exact})


def drifting(sensor: Sensor | str, factor: float) -> Sensor:
    """The sensor with a multiple of its drift."""
    usual = get_sensor(sensor)
    return replace(usual, drift=factor * usual.drift, tilt=min(factor, 1.0) * usual.tilt)


def drift_between(cloud: PointCloud, straight: PointCloud) -> tuple[Array, Array]:
    """Places of the cloud, one a cube of `DRIFT_SPACING`, and what undoes the drift there."""
    assert straight.poses is not None and cloud.poses is not None and cloud.pose_of is not None
    back = straight.poses @ np.linalg.inv(cloud.poses)
    points = cloud.points.astype(np.float64)
    undone = np.einsum("nij,nj->ni", back[cloud.pose_of, :3, :3], points) + back[cloud.pose_of, :3, 3]
    cells = np.floor(points / DRIFT_SPACING).astype(np.int64)
    cell, of, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    of = of.ravel()

    def mean(values: Array) -> Array:
        return np.stack([np.bincount(of, values[:, k], len(cell)) for k in range(3)], axis=1) / count[:, None]

    return mean(points), mean(undone - points)


def spoilt(cloud: PointCloud, building: Building, spoil: str, rng: np.random.Generator) -> PointCloud:
    """The cloud after what is done to its points."""
    points, chosen = cloud.points, np.ones(len(cloud), bool)
    if spoil == "sparse":
        chosen = rng.random(len(points)) < 0.05
    elif spoil == "below2":
        floor = building.storeys["floor"]
        storey = np.clip(np.searchsorted(floor - 0.3, points[:, 2]) - 1, 0, None)
        chosen = points[:, 2] < floor[storey] + 2.0
    elif spoil == "noise":
        points = points + rng.normal(0, 0.04, points.shape).astype(np.float32)
    pose_of = None if cloud.pose_of is None else cloud.pose_of[chosen]
    return replace(cloud, points=points[chosen], labels=None, pose_of=pose_of)


def upper_half(cloud: PointCloud, building: Building, rng: np.random.Generator) -> PointCloud:
    """The upper half of rooms, as somebody with a tablet captures it; no point lies in the joints of the ceiling's panels."""
    floor = building.storeys["floor"]
    storey = np.clip(np.searchsorted(floor - 0.3, cloud.points[:, 2]) - 1, 0, None)
    height = cloud.points[:, 2] - floor[storey]
    panel, joint = rng.choice([0.6, 0.625, 1.2, 2.4], 2), rng.uniform(0.0, 0.12)
    gap = (np.mod(cloud.points[:, :2] - rng.uniform(0, 1, 2), panel) < joint).any(axis=1) & (height > 2.2)
    chosen = (height > rng.uniform(0.9, 1.6)) & ~gap
    pose_of = None if cloud.pose_of is None else cloud.pose_of[chosen]
    return replace(cloud, points=cloud.points[chosen], labels=None, pose_of=pose_of)
