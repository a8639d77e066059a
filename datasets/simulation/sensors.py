"""The sensors: what each sees, how often, how well."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from topomerge.datasets.core.building import Building

from topomerge.errors import InputError
from topomerge.types import Array, PointCloud


@dataclass(frozen=True)
class Sensor:
    """A range sensor and the way it is carried. Angles are in degrees, lengths in metres.

    Args:
        reach: nearest and farthest range.
        azimuth: horizontal field of view; 360 spins.
        elevation: lowest and highest ray.
        beams: rays above one another; 0: as many as make square pixels.
        height: above the floor; carried sensors sway by 5 cm.
        step: metres between poses; 0: only where the surveyor stops.
        turns: poses at a stop, spread over `look` of a full turn.
        pitch: of the sensor; mobile cameras swing by `swing` about it, and to both sides.
        spacing: the distance between points that is aimed at.
        noise: standard deviation of a range at 0 m, and what each metre (laser) adds.
        quadratic: what each m2 of range adds (triangulating cameras).
        grazing: rays that meet a surface at less than this angle mostly do not return.
        dark: share of the things that hardly return anything.
        lost: share of all rays that return nothing.
        glass: share of the rays that a pane returns; the others go through.
        mixed: share of the rays at depth edges that return a range between.
        drift: degrees by which the heading goes astray (standard deviation), over about 15 m.
        tilt: degrees by which gravity is misjudged.
        jitter: m and degrees by which each pose is off by itself (standard deviation): walls become thick where views overlap.
        ghost: share of the rays that a pane neither returns nor lets through but mirrors: they make points behind the glass.
        plain: share of the points on floors, ceilings and walls that are kept (cameras need texture).
        lowest: points lower than this above the floor are missing.
        metric: the scale of its maps is known.
    """

    name: str
    reach: tuple[float, float]
    azimuth: float
    elevation: tuple[float, float]
    beams: int = 0
    height: float = 1.6
    step: float = 0.0
    turns: int = 1
    look: float = 1.0
    pitch: float = 0.0
    swing: float = 0.0
    spacing: float = 0.04
    noise: tuple[float, float] = (0.002, 0.0001)
    quadratic: float = 0.0
    grazing: float = 5.0
    dark: float = 0.03
    lost: float = 0.005
    jitter: tuple[float, float] = (0.0, 0.0)
    drift: float = 0.0
    tilt: float = 0.0
    glass: float = 0.1
    ghost: float = 0.05
    metric: bool = True
    mixed: float = 0.3
    plain: float = 1.0
    lowest: float = -1.0

    def build_rays(self, number: int) -> tuple[Array, tuple[int, int]]:
        """Build about `number` directions (rows * columns, 3), x ahead, z up, as an image; and its rows and columns."""
        low, high = np.radians(self.elevation)
        wide = np.radians(self.azimuth)
        rows = self.beams or max(round(float(np.sqrt(number * (high - low) / wide))), 2)
        columns = max(number // rows, 8)
        up = np.linspace(high, low, rows) if rows > 1 else np.zeros(1)
        round_about = (np.arange(columns) + 0.5) / columns * wide - wide / 2
        a, e = np.meshgrid(round_about, up)
        rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
        return rays.reshape(-1, 3), (rows, columns)


SENSORS = {
    s.name: s
    for s in (
        Sensor("tls", (0.4, 40), 360, (-62, 88), height=1.7, grazing=3.0, jitter=(0.003, 0.01)),
        Sensor(
            "lidar", (0.5, 30), 360, (-45, 45), 32, height=1.4, step=0.4, swing=12, spacing=0.05, noise=(0.012, 0.0004),
            drift=0.3, tilt=0.2, jitter=(0.01, 0.1),
        ),
        Sensor(
            "depth", (0.4, 5.0), 72, (-28, 28), height=1.45, step=0.35, turns=10, pitch=-4, swing=24, spacing=0.05,
            noise=(0.003, 0.0), quadratic=0.0025, grazing=12, dark=0.08, lost=0.03, glass=0.02, mixed=0.5, drift=0.5, tilt=0.4,
            jitter=(0.015, 0.4), ghost=0.02,
        ),
        Sensor(
            "mono", (0.6, 8.0), 80, (-30, 30), height=1.5, step=0.5, turns=8, pitch=-4, swing=20, spacing=0.12,
            noise=(0.01, 0.005), quadratic=0.004, grazing=10, dark=0.1, lost=0.2, glass=0.2, mixed=0.6, drift=0.8, tilt=0.6,
            plain=0.3, metric=False, jitter=(0.02, 0.3), ghost=0.0,
        ),
        Sensor(
            "laser2d", (0.1, 20), 270, (0, 0), 1, height=0.3, step=0.35, turns=2, spacing=0.03, noise=(0.01, 0.0005), drift=0.3,
            jitter=(0.01, 0.1),
        ),
        Sensor(
            "tablet", (0.3, 5.0), 62, (-24, 24), height=1.4, step=0.4, turns=4, look=0.5, pitch=34, swing=12,
            spacing=0.05, noise=(0.010, 0.003), quadratic=0.001, grazing=10, dark=0.05, lost=0.02, glass=0.05, mixed=0.5,
            drift=0.5, tilt=0.3, lowest=1.0, jitter=(0.012, 0.3), ghost=0.02,
        ),
    )
}  # fmt: skip


def get_sensor(sensor: Sensor | str) -> Sensor:
    """Return the sensor of that name, or the given one.

    Raises:
        InputError: an unknown name.
    """
    if isinstance(sensor, Sensor):
        return sensor
    if sensor not in SENSORS:
        raise InputError(f"sensor {sensor!r}: {', '.join(SENSORS)} are possible")
    return SENSORS[sensor]


DRIFT_SPACING = 0.5  # m between places whose drift is kept


def remove_sensor_drift(sensor: Sensor) -> Sensor:
    """Return the same sensor, whose poses are known exactly."""
    exact: dict[str, Any] = {"drift": 0.0, "tilt": 0.0, "jitter": (0.0, 0.0)}
    return replace(sensor, **{f.name: exact[f.name] for f in fields(sensor) if f.name in exact})


def scale_sensor_drift(sensor: Sensor | str, factor: float) -> Sensor:
    """Return the sensor with a multiple of its drift."""
    usual = get_sensor(sensor)
    return replace(usual, drift=factor * usual.drift, tilt=min(factor, 1.0) * usual.tilt)


def measure_drift(cloud: PointCloud, straight: PointCloud) -> tuple[Array, Array]:
    """Measure places of the cloud, one a cube of `DRIFT_SPACING`, and what undoes the drift there."""
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


def corrupt_cloud(cloud: PointCloud, building: Building, spoil: str, rng: np.random.Generator) -> PointCloud:
    """Return the cloud after the named corruption of its points."""
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


def cut_upper_half(cloud: PointCloud, building: Building, rng: np.random.Generator) -> PointCloud:
    """Return the upper half of rooms, as somebody with a tablet captures it; no point lies in the joints of the ceiling's
    panels."""
    floor = building.storeys["floor"]
    storey = np.clip(np.searchsorted(floor - 0.3, cloud.points[:, 2]) - 1, 0, None)
    height = cloud.points[:, 2] - floor[storey]
    panel, joint = rng.choice([0.6, 0.625, 1.2, 2.4], 2), rng.uniform(0.0, 0.12)
    gap = (np.mod(cloud.points[:, :2] - rng.uniform(0, 1, 2), panel) < joint).any(axis=1) & (height > 2.2)
    chosen = (height > rng.uniform(0.9, 1.6)) & ~gap
    pose_of = None if cloud.pose_of is None else cloud.pose_of[chosen]
    return replace(cloud, points=cloud.points[chosen], labels=None, pose_of=pose_of)
