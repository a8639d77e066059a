"""Poses from matched rooms, as the finished thesis fuses maps (method 4): each pair of rooms is aligned by itself, and the poses
that agree are averaged.

Point features and a random sample consensus give a first pose, point-to-plane refinement under gravity the pose; pairs whose
surfaces stay apart are dropped. Clusters replace the thesis' DBSCAN, and rotations are averaged as rotations.
"""

from __future__ import annotations

import numpy as np

from topomerge.fusion.refine import Surface, refine_pose, surface
from topomerge.fusion.thesis.fpfh import Features, fpfh, sampled_pose
from topomerge.fusion.thesis.pose_clusters import pose_clusters
from topomerge.types import Array, Sim3, TopometricMap, VoxelGrid

ROOM_POINTS = 2_000  # of a room at most
ROOM_LEAST_POINTS = 20
LARGEST_ERROR = 0.2  # m, root mean square distance of the surfaces (method 4)
ALIGNED_PAIRS = 30  # of rooms, the likeliest ones
Room = tuple[Surface, Features]


def room_poses(a: TopometricMap, b: TopometricMap, rooms: Array, weights: Array) -> list[tuple[Sim3, float]]:
    """Poses T_ab of clusters of pairs of rooms, with their weight, heaviest first; none where no pair can be aligned.

    Args:
        rooms: (M, 2) matched rooms of a and b.
        weights: (M,) how likely each is.
    """
    order = np.argsort(-weights, kind="stable")[:ALIGNED_PAIRS]
    sides = [{k: described(m, k) for k in np.unique(rooms[order, s]).tolist()} for s, m in enumerate((a, b))]
    poses, areas = [], []
    for i, j in rooms[order].tolist():
        pose = aligned(sides[0][i], sides[1][j])
        if pose is not None:
            poses.append(pose)
            areas.append(float(min(a.rooms["area"][i], b.rooms["area"][j])))
    middle = b.grid.centroids().mean(axis=0) if len(b.grid) else np.zeros(3)
    return [(pose, weight) for pose, weight, _ in pose_clusters(poses, np.array(areas), middle)]


def described(map: TopometricMap, room: int) -> Room | None:
    """The surface of a room, and features of some of its points; None of a room that has hardly any."""
    cells = map.grid.cells[map.room == room]
    if len(cells) < ROOM_LEAST_POINTS:
        return None
    room_surface = surface(VoxelGrid.from_cells(cells, map.grid.origin, map.grid.edge))
    flat = np.flatnonzero(room_surface.flat > 0)
    if len(flat) < ROOM_LEAST_POINTS:
        return None
    if len(flat) > ROOM_POINTS:
        flat = np.sort(np.random.default_rng(0).permutation(flat)[:ROOM_POINTS])
    points, normals = room_surface.points[flat], room_surface.normals[flat]
    inward = ((map.rooms["centroid"][room] - points) * normals).sum(axis=1)
    return room_surface, fpfh(points, normals * np.where(inward < 0, -1.0, 1.0)[:, None])


def aligned(a: Room | None, b: Room | None) -> Sim3 | None:
    """T_ab of one room: sample consensus, then refinement; None where the surfaces stay apart."""
    if a is None or b is None:
        return None
    start = sampled_pose(a[1], b[1])
    if start is None:
        return None
    refined = refine_pose(a[0], b[0], start)
    return refined.pose if np.isfinite(refined.rmse) and refined.rmse <= LARGEST_ERROR else None
