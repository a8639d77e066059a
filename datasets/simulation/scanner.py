"""Scanning a building: a sensor is carried along a walk, its rays are cast, and each point keeps its true room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage
from topomerge.datasets.core.building import SURFACES, Building
from topomerge.datasets.simulation.floors import draw_floors
from topomerge.datasets.simulation.rays import Hits, cast, placed
from topomerge.datasets.simulation.sensors import Sensor, get_sensor
from topomerge.datasets.simulation.trajectory import drifted, sensor_poses
from topomerge.datasets.simulation.walk import plan_walk

from topomerge.errors import InputError
from topomerge.types import Array, PointCloud, Sim3, TrueRoom

LABEL_CELL = 0.05  # m
OVERLAP = 1.4  # rays for each point that is kept
LINE = 540  # rays of a pose of a sensor that sees a line only
PLAIN = [SURFACES.index(s) for s in ("wall", "floor", "ceiling", "facade")]


def scan(
    building: Building,
    sensor: Sensor | str = "tls",
    rooms: Sequence[int] | Array | None = None,
    seed: int | np.random.Generator = 0,
    spacing: float | None = None,
    budget: int | None = None,
    frame: Sim3 | None = None,
    unfinished: float = 0.35,
) -> PointCloud:
    """A partial map of a building.

    Args:
        sensor: one of `sensors.SENSORS` or its name.
        rooms: rooms to visit; None: all but the lifts. Doors and windows show parts of others, too.
        seed: of the walk, the noise and the drift.
        spacing: m between points (one point a cube of that size); None: the sensor's. It sets the number of rays.
        budget: number of rays, where it shall not follow from the spacing.
        frame: the cloud is given in this frame (it maps the building's coordinates into the cloud's); None: the building's own.
        unfinished: share of the long rooms that are left half-way (`plan_walk`).

    Returns:
        points with `labels` (index into `rooms`: all of the building's, in the cloud's frame), estimated `poses` and `pose_of`,
        and `colors` where the sensor tells any.

    Raises:
        InputError: unknown sensor or room, a spacing out of range, a room that cannot be reached, a sensor that saw nothing.
    """
    kind, rng = get_sensor(sensor), np.random.default_rng(seed)
    if spacing is not None and not 0.005 <= spacing <= 1.0:
        raise InputError(f"spacing must be 0.005 to 1 m, not {spacing}")
    spacing = spacing or kind.spacing
    visited = [i for i, r in enumerate(building.rooms) if r.kind != "lift"] if rooms is None else [int(r) for r in rooms]
    walk = plan_walk(building, visited, rng, unfinished)
    poses, along = sensor_poses(walk, kind, visited, rng)
    number = budget or (LINE * len(poses) if kind.beams == 1 else _rays_for(building, visited, spacing))
    hits = cast(building, kind, poses, max(number // len(poses), 8), rng)
    hits = _degrade(building, poses, hits, kind, rng)
    if not len(hits.pose):
        raise InputError(f"{building.name}: the {kind.name} sensor saw nothing; is its reach of {kind.reach} m right?")
    estimated = drifted(poses, walk, along, kind, rng)
    points = placed(estimated, hits, hits.ranges)
    if not budget:
        rows = _thin(points, spacing)
        points, hits = points[rows], hits.take(rows)
    cloud = PointCloud(
        points.astype(np.float32),
        labels=_rooms_of(building, poses, hits),
        poses=estimated,
        pose_of=hits.pose.astype(np.int32),
        rooms=building.rooms,
        source=f"{building.name}:{kind.name}",
        upright=True,
    )
    return moved(cloud, frame) if frame else cloud


def seen_from_poses(
    building: Building, sensor: Sensor, poses: Array, number: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """(n, 3) points that a sensor sees from poses (K, 4, 4), wherever these are, and (n,) from which.

    Args:
        number: of rays a pose.
    """
    hits = _degrade(building, poses, cast(building, sensor, poses, number, rng), sensor, rng)
    return placed(poses, hits, hits.ranges), hits.pose


def moved(cloud: PointCloud, frame: Sim3) -> PointCloud:
    """The same cloud in another frame: points, poses and rooms."""
    poses = None
    if cloud.poses is not None:
        poses = cloud.poses.copy()
        poses[:, :3, 3] = frame.apply(poses[:, :3, 3])
        poses[:, :3, :3] = Sim3(frame.yaw).matrix[:3, :3] @ poses[:, :3, :3]
    points = frame.apply(cloud.points.astype(np.float64) + cloud.shift).astype(np.float32)
    rooms = tuple(_moved(room, frame) for room in cloud.rooms)
    return replace(cloud, points=points, shift=np.zeros(3), poses=poses, rooms=rooms)


def _moved(room: TrueRoom, frame: Sim3) -> TrueRoom:
    corners = frame.apply(np.column_stack([room.polygon, np.full(len(room.polygon), room.floor)]))
    top = frame.scale * room.ceiling + frame.translation[2]
    return replace(room, polygon=corners[:, :2], floor=float(corners[0, 2]), ceiling=float(top))


def _rays_for(building: Building, visited: Sequence[int], spacing: float) -> int:
    """Rays that cover floor, ceiling and walls of the rooms at a spacing."""
    surface = 0.0
    for room in (building.rooms[i] for i in visited):
        x, y = room.polygon.T
        area = abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2
        around = float(np.hypot(*(np.roll(room.polygon, -1, axis=0) - room.polygon).T).sum())
        surface += 2 * area + around * (room.ceiling - room.floor)
    return int(OVERLAP * surface / spacing**2)


def _degrade(building: Building, poses: Array, hits: Hits, sensor: Sensor, rng: np.random.Generator) -> Hits:
    """Lose what returns badly, and add noise to the ranges."""
    count = len(hits.ranges)
    thing = building.thing_of[hits.triangle]
    faint = rng.random(len(building.things) + 1) < sensor.dark
    chance = np.full(count, 1 - sensor.lost)
    chance[faint[thing] & (thing >= 0)] *= 0.15
    chance[hits.cosine < np.sin(np.radians(sensor.grazing))] *= 0.1
    chance[np.isin(building.labels[hits.triangle], PLAIN)] *= sensor.plain
    returned = rng.random(count) < chance
    if sensor.lowest > 0:
        returned &= placed(poses, hits, hits.ranges)[:, 2] - poses[hits.pose, 2, 3] + sensor.height > sensor.lowest
    sigma = sensor.noise[0] + sensor.noise[1] * hits.ranges + sensor.quadratic * hits.ranges**2
    ranges = np.clip(hits.ranges + rng.normal(size=count) * sigma, 0.01, sensor.reach[1])
    return replace(hits, ranges=ranges.astype(np.float32)).take(returned)


def _rooms_of(building: Building, poses: Array, hits: Hits) -> Array:
    """(n,) int32 true room of each point: the room on the sensor's side of the surface; -1: outdoors, or seen in a pane."""
    floors = draw_floors(building, LABEL_CELL)
    near = [ndimage.distance_transform_edt(r < 0, return_distances=True, return_indices=True) for r in floors.room]
    filled = np.stack([np.where(d * LABEL_CELL < 0.3, r[i[0], i[1]], -1) for r, (d, i) in zip(floors.room, near, strict=True)])
    points = placed(poses, hits, hits.ranges - 0.08)
    storey = np.clip(np.searchsorted(building.storeys["floor"], points[:, 2] + 0.02, side="right") - 1, 0, None)
    ij = floors.cells(points)
    return np.where(hits.ghost, -1, filled[storey, ij[:, 0], ij[:, 1]]).astype(np.int32)


def _thin(points: Array, spacing: float) -> Array:
    """Rows of one point a cube."""
    cells = np.floor((points - points.min(axis=0)) / spacing).astype(np.int64)
    size = cells.max(axis=0) + 1
    key = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    return np.sort(np.unique(key, return_index=True)[1])
