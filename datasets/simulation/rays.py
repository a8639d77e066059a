"""Rays that are cast into a building from a sensor's poses, and what they meet: surfaces, panes, mixed pixels."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from topomerge.datasets.core.building import SURFACES, Building
from topomerge.datasets.simulation.sensors import Sensor

from topomerge.types import Array, Sim3

RAYS_AT_A_TIME = 2_000_000  # rays at a time


@dataclass(frozen=True, eq=False)
class Hits:
    """What rays met, row by row.

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

    def take(self, rows: Array) -> Hits:
        """Some of the rows."""
        return Hits(*(getattr(self, f.name)[rows] for f in fields(self)))


def placed(poses: Array, hits: Hits, ranges: Array) -> Array:
    """(n, 3) float64 points at the given ranges; hits stand in the order of their poses."""
    points = np.empty((len(ranges), 3))
    stops = np.searchsorted(hits.pose, np.arange(len(poses) + 1))
    seen = hits.rays * ranges[:, None].astype(np.float32)
    for k, pose in enumerate(poses):
        rows = slice(stops[k], stops[k + 1])
        points[rows] = seen[rows] @ pose[:3, :3].T + pose[:3, 3]
    return points


def _scene(vertices: Array, triangles: Array) -> Any:
    """Embree's search tree over some of the triangles."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(triangles, np.int32))
    return scene


def cast(building: Building, sensor: Sensor, poses: Array, number: int, rng: np.random.Generator) -> Hits:
    """Cast the rays of all poses; mixed pixels are made here, while the rays still stand in images."""
    rays, (rows, columns) = sensor.rays(number)
    rays = rays.astype(np.float32)
    reach = sensor.reach[1]
    low, high = poses[:, 2, 3].min() - reach, poses[:, 2, 3].max() + reach
    z = building.vertices[building.triangles, 2]
    near = np.flatnonzero((z.max(axis=1) > low) & (z.min(axis=1) < high))
    scene, clear = _scene(building.vertices, building.triangles[near]), None
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
        chance = rng.random(len(triangle))
        pane = (triangle >= 0) & glass[triangle] & (chance >= sensor.glass)
        ghost = pane & (chance >= 1 - sensor.ghost)
        through = pane & ~ghost
        if through.any():
            clear = clear or _scene(building.vertices, building.triangles[near[~glass]])
            beyond = _shoot(clear, flat[through])
            ranges[through], cosine[through] = beyond[0], beyond[2]
            triangle[through] = np.where(beyond[1] >= 0, np.flatnonzero(~glass)[beyond[1]], -1)
        if ghost.any():
            mirrored = _mirrored(flat[ghost], ranges[ghost], normal[ghost])
            beyond = _shoot(scene, mirrored)
            ranges[ghost], triangle[ghost], cosine[ghost] = ranges[ghost] + beyond[0], beyond[1], beyond[2]
        image = ranges.reshape(-1, rows, columns)
        ranges = _mix(image, sensor.mixed, rng).ravel()
        seen = np.flatnonzero((triangle >= 0) & (ranges > sensor.reach[0]) & (ranges < reach))
        pose = first + seen // len(rays)
        out.append((pose, spun[seen % len(rays)], ranges[seen], near[triangle[seen]], cosine[seen], ghost[seen]))
    return Hits(*(np.concatenate(column) for column in zip(*out, strict=True)))


def _mirrored(rays: Array, ranges: Array, normal: Array) -> Array:
    """Rays (n, 6) as panes with these normals throw them back."""
    way = rays[:, 3:]
    back = way - 2 * np.einsum("ni,ni->n", way, normal)[:, None] * normal
    return np.hstack([rays[:, :3] + way * (ranges[:, None] - 0.001), back]).astype(np.float32)


def _shoot(scene: Any, rays: Array) -> tuple[Array, Array, Array, Array]:
    """Range (inf: none), triangle (-1: none), |cosine| of incidence and unit normals (n, 3) of rays (n, 6) of unit length."""
    answer = scene.run(np.ascontiguousarray(rays[:, :3]), np.ascontiguousarray(rays[:, 3:]), output=True)
    triangle = answer["primID"].astype(np.int64)
    ranges = np.where(triangle >= 0, answer["tfar"], np.float32(np.inf)).astype(np.float32)
    normal = answer["Ng"] / np.maximum(np.linalg.norm(answer["Ng"], axis=1), 1e-12)[:, None]
    return ranges, triangle, np.abs(np.einsum("ni,ni->n", normal, rays[:, 3:])), normal


def _mix(image: Array, share: float, rng: np.random.Generator) -> Array:
    """Ranges between the two surfaces at some of the depth edges along a row."""
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
