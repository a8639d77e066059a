"""Scanning a building: a sensor is carried along a walk, its rays are cast, and each point keeps its true room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation
from topomerge.datasets.core.building import SURFACES, Building
from topomerge.datasets.simulation.floor_truth import rasterize_floors
from topomerge.datasets.simulation.sensors import Sensor, get_sensor
from topomerge.datasets.simulation.walk import Walk, plan_walk

from topomerge.errors import InputError
from topomerge.types import Array, PointCloud, Sim3, TrueRoom


def simulate_sensor_poses(walk: Walk, sensor: Sensor, visited: Sequence[int], rng: np.random.Generator) -> tuple[Array, Array]:
    """Return (K, 4, 4) true poses of the sensor, in the order of the walk, and metres walked to each; only in the rooms asked
    for."""
    along = walk.along
    at = list(walk.stops) * sensor.turns
    turn = [k * 2 * np.pi * sensor.look / sensor.turns for k in range(sensor.turns) for _ in walk.stops]
    turn = [t + o for t, o in zip(turn, np.tile(rng.uniform(0, 2 * np.pi, len(walk.stops)), sensor.turns), strict=True)]
    heading = _compute_heading(walk.points)
    if sensor.step:
        marks = np.searchsorted(along, np.arange(0, along[-1], sensor.step))
        marks = marks[walk.free[marks] & (np.isin(walk.room[marks], list(visited)) | (walk.room[marks] < 0))]
        at += marks.tolist()
        sway = np.radians(sensor.swing) * 2 * np.sin(np.arange(len(marks)) * 0.9 + rng.uniform(0, 6))
        turn += (heading[marks] + sway).tolist()
    order = np.argsort(along[at], kind="stable")
    index, yaw = np.array(at)[order], np.array(turn)[order]
    count = len(index)
    pitch = -np.radians(sensor.pitch + sensor.swing * np.sin(np.arange(count) * 2.4 + rng.uniform(0, 6)))
    pitch = pitch if sensor.beams != 1 else np.zeros(count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    c, s, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    poses[:, :3, :3] = np.moveaxis(np.array([[c * cp, -s, c * sp], [s * cp, c, s * sp], [-sp, 0 * s, cp]]), 2, 0)
    poses[:, :3, 3] = walk.points[index] + [0, 0, sensor.height]
    if sensor.step and sensor.beams != 1:
        poses[:, 2, 3] += rng.normal(0, 0.03, count)
    return poses, along[index]


def _compute_heading(points: Array) -> Array:
    """Return the direction, rad, in which the walk goes at each point, looking 0.5 m ahead."""
    ahead = np.roll(points, -5, axis=0)[:, :2] - points[:, :2]
    ahead[-5:] = ahead[-6] if len(points) > 5 else (1.0, 0.0)
    return np.arctan2(ahead[:, 1], ahead[:, 0])


def add_drift(poses: Array, walk: Walk, along: Array, sensor: Sensor, rng: np.random.Generator) -> Array:
    """Return the poses as odometry has them: the heading wanders, and the way bends with it; gravity is a little off."""
    out = _add_jitter(poses, sensor, rng)
    if sensor.drift:
        total = walk.along[-1]
        knots = np.arange(0, total + 30.0, 15.0)
        error = np.interp(walk.along, knots, np.radians(sensor.drift) * rng.normal(size=len(knots)))
        climb = np.interp(walk.along, knots, 0.002 * sensor.drift * rng.normal(size=len(knots)))
        step = np.diff(walk.points, axis=0)
        c, s = np.cos(error[1:]), np.sin(error[1:])
        flat = np.hypot(step[:, 0], step[:, 1])
        bent = np.stack([c * step[:, 0] - s * step[:, 1], s * step[:, 0] + c * step[:, 1], step[:, 2] + climb[1:] * flat], axis=1)
        moved = np.concatenate([[walk.points[0]], walk.points[0] + np.cumsum(bent, axis=0)]) - walk.points
        at = np.searchsorted(walk.along, along)
        for k, i in enumerate(np.clip(at, 0, len(moved) - 1)):
            out[k, :3, :3] = Sim3(float(error[i])).matrix[:3, :3] @ out[k, :3, :3]
            out[k, :3, 3] += moved[i]
    if sensor.tilt:
        a, b = np.radians(sensor.tilt) * rng.normal(size=2)
        lean = np.array([[1, 0, b], [0, 1, -a], [-b, a, 1]])
        lean = np.linalg.qr(lean)[0] * np.sign(np.diag(np.linalg.qr(lean)[1]))
        centre = out[:, :3, 3].mean(axis=0)
        out[:, :3, 3] = (out[:, :3, 3] - centre) @ lean.T + centre
        out[:, :3, :3] = lean @ out[:, :3, :3]
    return out


def _add_jitter(poses: Array, sensor: Sensor, rng: np.random.Generator) -> Array:
    """Return the poses, each off by itself: what is left of the errors when a map has been put together."""
    out = poses.copy()
    shift, turn = rng.normal(0, sensor.jitter[0], (len(poses), 3)), np.radians(rng.normal(0, sensor.jitter[1], (len(poses), 3)))
    flat = sensor.beams == 1
    out[:, :3, 3] += shift * [1, 1, 0 if flat else 1]
    out[:, :3, :3] = Rotation.from_rotvec(turn * [not flat, not flat, 1]).as_matrix() @ out[:, :3, :3]
    return out


RAYS_AT_A_TIME = 2_000_000  # rays at a time


@dataclass(frozen=True, eq=False)
class RayHits:
    """Hits of rays, row by row.

    Args:
        pose: (n,) int64 from where.
        rays: (n, 3) float32 directions in the sensor's frame.
        ranges: (n,) float32, m.
        triangle: (n,) int64, of the building.
        cosine: (n,) float32, |cosine| of the angle of incidence.
        ghost: (n,) bool, seen in a pane as in a mirror.
    """

    pose: Array
    rays: Array
    ranges: Array
    triangle: Array
    cosine: Array
    ghost: Array

    def take(self, rows: Array) -> RayHits:
        """Select some of the rows."""
        return RayHits(*(getattr(self, f.name)[rows] for f in fields(self)))


def compute_hit_points(poses: Array, hits: RayHits, ranges: Array) -> Array:
    """Compute (n, 3) float64 points at the given ranges; hits stand in the order of their poses."""
    points = np.empty((len(ranges), 3))
    stops = np.searchsorted(hits.pose, np.arange(len(poses) + 1))
    seen = hits.rays * ranges[:, None].astype(np.float32)
    for k, pose in enumerate(poses):
        rows = slice(stops[k], stops[k + 1])
        points[rows] = seen[rows] @ pose[:3, :3].T + pose[:3, 3]
    return points


def _build_scene(vertices: Array, triangles: Array) -> Any:
    """Build Embree's search tree over some of the triangles."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(triangles, np.int32))
    return scene


def cast(building: Building, sensor: Sensor, poses: Array, number: int, rng: np.random.Generator) -> RayHits:
    """Cast the rays of all poses; mixed pixels are made here, while the rays still stand in images."""
    rays, (rows, columns) = sensor.build_rays(number)
    rays = rays.astype(np.float32)
    reach = sensor.reach[1]
    low, high = poses[:, 2, 3].min() - reach, poses[:, 2, 3].max() + reach
    z = building.vertices[building.triangles, 2]
    near = np.flatnonzero((z.max(axis=1) > low) & (z.min(axis=1) < high))
    scene, clear = _build_scene(building.vertices, building.triangles[near]), None
    glass = building.labels[near] == SURFACES.index("glass")
    out = []
    step = max(RAYS_AT_A_TIME // len(rays), 1)
    for first in range(0, len(poses), step):
        these = poses[first : first + step]
        spun = rays
        if sensor.azimuth == 360:  # the raster of a spinning sensor starts anywhere
            turn = rng.uniform(0, 2 * np.pi / columns)
            spun = rays @ Sim3(turn).matrix[:3, :3].T.astype(np.float32)
        packed = np.empty((len(these), len(rays), 6), np.float32)
        packed[..., :3] = these[:, None, :3, 3]
        packed[..., 3:] = np.matmul(spun, these[:, :3, :3].astype(np.float32).transpose(0, 2, 1))
        flat = packed.reshape(-1, 6)
        ranges, triangle, cosine, normal = _shoot(scene, flat)
        probability = rng.random(len(triangle))
        pane = (triangle >= 0) & glass[triangle] & (probability >= sensor.glass)
        ghost = pane & (probability >= 1 - sensor.ghost)
        through = pane & ~ghost
        if through.any():
            clear = clear or _build_scene(building.vertices, building.triangles[near[~glass]])
            beyond = _shoot(clear, flat[through])
            ranges[through], cosine[through] = beyond[0], beyond[2]
            triangle[through] = np.where(beyond[1] >= 0, np.flatnonzero(~glass)[beyond[1]], -1)
        if ghost.any():
            mirrored = _reflect_rays(flat[ghost], ranges[ghost], normal[ghost])
            beyond = _shoot(scene, mirrored)
            ranges[ghost], triangle[ghost], cosine[ghost] = ranges[ghost] + beyond[0], beyond[1], beyond[2]
        image = ranges.reshape(-1, rows, columns)
        ranges = _mix_edge_ranges(image, sensor.mixed, rng).ravel()
        seen = np.flatnonzero((triangle >= 0) & (ranges > sensor.reach[0]) & (ranges < reach))
        pose = first + seen // len(rays)
        out.append((pose, spun[seen % len(rays)], ranges[seen], near[triangle[seen]], cosine[seen], ghost[seen]))
    return RayHits(*(np.concatenate(column) for column in zip(*out, strict=True)))


def _reflect_rays(rays: Array, ranges: Array, normal: Array) -> Array:
    """Return rays (n, 6) as panes with these normals throw them back."""
    way = rays[:, 3:]
    back = way - 2 * np.einsum("ni,ni->n", way, normal)[:, None] * normal
    return np.hstack([rays[:, :3] + way * (ranges[:, None] - 0.001), back]).astype(np.float32)


def _shoot(scene: Any, rays: Array) -> tuple[Array, Array, Array, Array]:
    """Return the range (inf: none), triangle (-1: none), |cosine| of incidence and unit normals (n, 3) of rays (n, 6) of unit
    length."""
    answer = scene.run(np.ascontiguousarray(rays[:, :3]), np.ascontiguousarray(rays[:, 3:]), output=True)
    triangle = answer["primID"].astype(np.int64)
    ranges = np.where(triangle >= 0, answer["tfar"], np.float32(np.inf)).astype(np.float32)
    normal = answer["Ng"] / np.maximum(np.linalg.norm(answer["Ng"], axis=1), 1e-12)[:, None]
    return ranges, triangle, np.abs(np.einsum("ni,ni->n", normal, rays[:, 3:])), normal


def _mix_edge_ranges(image: Array, share: float, rng: np.random.Generator) -> Array:
    """Return ranges between the two surfaces at some of the depth edges along a row."""
    out = image.copy()
    if image.shape[2] < 2 or not share:
        return out
    finite = np.where(np.isfinite(image), image, 1e6)
    step = finite[:, :, 1:] - finite[:, :, :-1]
    edge = (np.abs(step) > 0.15) & (np.abs(step) < 1e5)
    where = np.nonzero(edge)
    chosen = rng.random(len(where[0])) < share
    k, i, j = (w[chosen] for w in where)
    out[k, i, j] += step[k, i, j] * rng.beta(0.5, 0.5, len(k)) * 0.9
    return out


LABEL_CELL = 0.05  # m
OVERLAP = 1.4  # rays for each point that is kept
LINE = 540  # rays of a pose of a sensor that sees a line only
PLAIN = [SURFACES.index(s) for s in ("wall", "floor", "ceiling", "facade")]


def scan_building(
    building: Building,
    sensor: Sensor | str = "tls",
    rooms: Sequence[int] | Array | None = None,
    seed: int | np.random.Generator = 0,
    spacing: float | None = None,
    budget: int | None = None,
    frame: Sim3 | None = None,
    unfinished: float = 0.35,
) -> PointCloud:
    """Return a partial map of a building.

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
    poses, along = simulate_sensor_poses(walk, kind, visited, rng)
    number = budget or (LINE * len(poses) if kind.beams == 1 else _count_rays(building, visited, spacing))
    hits = cast(building, kind, poses, max(number // len(poses), 8), rng)
    hits = _corrupt_hits(building, poses, hits, kind, rng)
    if not len(hits.pose):
        raise InputError(f"{building.name}: the {kind.name} sensor saw nothing; is its reach of {kind.reach} m right?")
    estimated = add_drift(poses, walk, along, kind, rng)
    points = compute_hit_points(estimated, hits, hits.ranges)
    if not budget:
        rows = _thin(points, spacing)
        points, hits = points[rows], hits.take(rows)
    cloud = PointCloud(
        points.astype(np.float32),
        labels=_find_hit_rooms(building, poses, hits),
        poses=estimated,
        pose_of=hits.pose.astype(np.int32),
        rooms=building.rooms,
        source=f"{building.name}:{kind.name}",
        upright=True,
    )
    return transform_cloud(cloud, frame) if frame else cloud


def scan_from_poses(
    building: Building, sensor: Sensor, poses: Array, number: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return (n, 3) points that a sensor sees from poses (K, 4, 4), wherever these are, and (n,) from which.

    Args:
        number: of rays a pose.
    """
    hits = _corrupt_hits(building, poses, cast(building, sensor, poses, number, rng), sensor, rng)
    return compute_hit_points(poses, hits, hits.ranges), hits.pose


def transform_cloud(cloud: PointCloud, frame: Sim3) -> PointCloud:
    """Return the same cloud in another frame: points, poses and rooms."""
    poses = None
    if cloud.poses is not None:
        poses = cloud.poses.copy()
        poses[:, :3, 3] = frame.apply(poses[:, :3, 3])
        poses[:, :3, :3] = Sim3(frame.yaw).matrix[:3, :3] @ poses[:, :3, :3]
    points = frame.apply(cloud.points.astype(np.float64) + cloud.shift).astype(np.float32)
    rooms = tuple(_transform_room(room, frame) for room in cloud.rooms)
    return replace(cloud, points=points, shift=np.zeros(3), poses=poses, rooms=rooms)


def _transform_room(room: TrueRoom, frame: Sim3) -> TrueRoom:
    corners = frame.apply(np.column_stack([room.polygon, np.full(len(room.polygon), room.floor)]))
    top = frame.scale * room.ceiling + frame.translation[2]
    return replace(room, polygon=corners[:, :2], floor=float(corners[0, 2]), ceiling=float(top))


def _count_rays(building: Building, visited: Sequence[int], spacing: float) -> int:
    """Count the rays that cover floor, ceiling and walls of the rooms at a spacing."""
    surface = 0.0
    for room in (building.rooms[i] for i in visited):
        x, y = room.polygon.T
        area = abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2
        around = float(np.hypot(*(np.roll(room.polygon, -1, axis=0) - room.polygon).T).sum())
        surface += 2 * area + around * (room.ceiling - room.floor)
    return int(OVERLAP * surface / spacing**2)


def _corrupt_hits(building: Building, poses: Array, hits: RayHits, sensor: Sensor, rng: np.random.Generator) -> RayHits:
    """Lose what returns badly, and add noise to the ranges."""
    count = len(hits.ranges)
    thing = building.thing_of[hits.triangle]
    faint = rng.random(len(building.things) + 1) < sensor.dark
    probability = np.full(count, 1 - sensor.lost)
    probability[faint[thing] & (thing >= 0)] *= 0.15
    probability[hits.cosine < np.sin(np.radians(sensor.grazing))] *= 0.1
    probability[np.isin(building.labels[hits.triangle], PLAIN)] *= sensor.plain
    returned = rng.random(count) < probability
    if sensor.lowest > 0:
        returned &= compute_hit_points(poses, hits, hits.ranges)[:, 2] - poses[hits.pose, 2, 3] + sensor.height > sensor.lowest
    sigma = sensor.noise[0] + sensor.noise[1] * hits.ranges + sensor.quadratic * hits.ranges**2
    ranges = np.clip(hits.ranges + rng.normal(size=count) * sigma, 0.01, sensor.reach[1])
    return replace(hits, ranges=ranges.astype(np.float32)).take(returned)


def _find_hit_rooms(building: Building, poses: Array, hits: RayHits) -> Array:
    """Return (n,) int32 true room of each point: the room on the sensor's side of the surface; -1: outdoors, or seen in a
    pane."""
    floors = rasterize_floors(building, LABEL_CELL)
    near = [ndimage.distance_transform_edt(r < 0, return_distances=True, return_indices=True) for r in floors.room]
    filled = np.stack([np.where(d * LABEL_CELL < 0.3, r[i[0], i[1]], -1) for r, (d, i) in zip(floors.room, near, strict=True)])
    points = compute_hit_points(poses, hits, hits.ranges - 0.08)
    storey = np.clip(np.searchsorted(building.storeys["floor"], points[:, 2] + 0.02, side="right") - 1, 0, None)
    ij = floors.compute_cells(points)
    return np.where(hits.ghost, -1, filled[storey, ij[:, 0], ij[:, 1]]).astype(np.int32)


def _thin(points: Array, spacing: float) -> Array:
    """Keep the rows of one point a cube."""
    cells = np.floor((points - points.min(axis=0)) / spacing).astype(np.int64)
    size = cells.max(axis=0) + 1
    key = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    return np.sort(np.unique(key, return_index=True)[1])
