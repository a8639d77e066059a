"""Poses from matched rooms, as the finished thesis fuses maps (method 3): each pair of rooms is aligned by itself, and the poses
that agree are averaged.

Point features and a random sample consensus give a first pose, point-to-plane refinement under gravity the pose; pairs whose
surfaces stay apart are dropped. Clusters replace the thesis' DBSCAN, and rotations are averaged as rotations.
"""

from __future__ import annotations

import numpy as np

from topomerge.fusion.refine import Surface, refine_pose, surface
from topomerge.fusion.thesis.fpfh import fpfh
from topomerge.fusion.thesis.pose_clusters import pose_clusters
from topomerge.types import Array, Sim3, TopometricMap, VoxelGrid

FEATURE_RADIUS = 1.0  # m
ROOM_POINTS = 2_000  # of a room at most
ROOM_LEAST_POINTS = 20
TRIPLES_DRAWN = 20_000
TRIPLES_TRIED = 200  # of those with like edges (method 3: 200 are enough)
EDGE_RATIO = 0.8  # of the edges of two triples (method 3)
SHORTEST_EDGE = 0.5  # m, below which edges tell no direction
INLIER_DISTANCE = 0.3  # m
LARGEST_ERROR = 0.2  # m, root mean square distance of the surfaces (method 3)
ALIGNED_PAIRS = 30  # of rooms, the likeliest ones


def room_poses(a: TopometricMap, b: TopometricMap, rooms: Array, weights: Array) -> list[tuple[Sim3, float]]:
    """Poses T_ab of clusters of pairs of rooms, with their weight, heaviest first; none where no pair can be aligned.

    Args:
        rooms: (M, 2) matched rooms of a and b.
        weights: (M,) how likely each is.
    """
    order = np.argsort(-weights, kind="stable")[:ALIGNED_PAIRS]
    sides = [{k: _Room(m, k) for k in np.unique(rooms[order, s]).tolist()} for s, m in enumerate((a, b))]
    poses, areas = [], []
    for i, j in rooms[order].tolist():
        pose = aligned(sides[0][i], sides[1][j])
        if pose is not None:
            poses.append(pose)
            areas.append(float(min(a.rooms["area"][i], b.rooms["area"][j])))
    middle = b.grid.centroids().mean(axis=0) if len(b.grid) else np.zeros(3)
    return [(pose, weight) for pose, weight, _ in pose_clusters(poses, np.array(areas), middle)]


class _Room:
    """The surface of a room, some of its points, and their features."""

    def __init__(self, map: TopometricMap, room: int) -> None:
        rows = np.flatnonzero(map.room == room)
        cells = map.grid.cells[rows]
        self.surface: Surface | None = None
        if len(cells) < ROOM_LEAST_POINTS:
            return
        grid = VoxelGrid.from_cells(cells, map.grid.origin, map.grid.edge)
        self.surface = surface(grid)
        flat = np.flatnonzero(self.surface.flat > 0)
        if len(flat) > ROOM_POINTS:
            flat = np.sort(np.random.default_rng(0).permutation(flat)[:ROOM_POINTS])
        self.points = self.surface.points[flat]
        inward = map.rooms["centroid"][room] - self.points
        facing = np.where((inward * self.surface.normals[flat]).sum(axis=1) < 0, -1.0, 1.0)
        self.features = fpfh(self.points, self.surface.normals[flat] * facing[:, None], FEATURE_RADIUS)


def aligned(a: _Room, b: _Room) -> Sim3 | None:
    """T_ab of one room: sample consensus, then refinement; None where the surfaces stay apart."""
    if a.surface is None or b.surface is None or min(len(a.points), len(b.points)) < ROOM_LEAST_POINTS:
        return None
    partner = ((a.features**2).sum(axis=1) - 2 * b.features @ a.features.T).argmin(axis=1)  # of 33 numbers no tree is quicker
    start = sampled(a.points[partner], b.points)
    if start is None:
        return None
    refined = refine_pose(a.surface, b.surface, start)
    return refined.pose if np.isfinite(refined.rmse) and refined.rmse <= LARGEST_ERROR else None


def sampled(to: Array, points: Array, seed: int = 0) -> Sim3 | None:
    """The pose under gravity that brings most `points` near their partners `to`, of triples with like edges.

    Args:
        to, points: (N, 3) m.
    """
    rng = np.random.default_rng(seed)
    triples = rng.integers(len(points), size=(TRIPLES_DRAWN, 3))
    edges = [np.linalg.norm(p[triples] - p[triples[:, [1, 2, 0]]], axis=2) for p in (to, points)]
    alike = np.minimum(*edges) >= np.maximum(EDGE_RATIO * np.maximum(*edges), SHORTEST_EDGE)
    triples = triples[alike.all(axis=1)][:TRIPLES_TRIED]
    if not len(triples):
        return None
    yaw, shift = upright(to[triples], points[triples])
    best = max(range(len(triples)), key=lambda k: int(_near(to, points, yaw[k], shift[k]).sum()))
    near = _near(to, points, yaw[best], shift[best])
    if near.sum() < 3:
        return None
    yaw, shift = upright(to[near][None], points[near][None])
    x, y, z = shift[0].tolist()
    return Sim3(float(yaw[0]), (x, y, z))


def upright(to: Array, points: Array) -> tuple[Array, Array]:
    """(H,) yaws and (H, 3) translations of the least-squares poses under gravity of (H, n, 3) points onto `to`."""
    from_middle, to_middle = points.mean(axis=1, keepdims=True), to.mean(axis=1, keepdims=True)
    p, q = points - from_middle, to - to_middle
    sine = (p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]).sum(axis=1)
    cosine = (p[..., 0] * q[..., 0] + p[..., 1] * q[..., 1]).sum(axis=1)
    yaw = np.arctan2(sine, cosine)
    return yaw, to_middle[:, 0] - _turned(from_middle[:, 0], yaw)


def _turned(points: Array, yaw: Array) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * points[..., 0] - s * points[..., 1], s * points[..., 0] + c * points[..., 1], points[..., 2]], axis=-1)


def _near(to: Array, points: Array, yaw: Array, shift: Array) -> Array:
    near: Array = ((_turned(points, yaw) + shift - to) ** 2).sum(axis=1) < INLIER_DISTANCE**2
    return near
