"""Clusters of poses and their means, in place of the thesis' DBSCAN: rotations are averaged as rotations, so that -179 and 179
degrees give 180 (method 4)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from topomerge.fusion.pose_difference import pose_difference
from topomerge.types import Array, Sim3

CLUSTER_RADIUS = (0.5, np.radians(5.0), 0.05)  # m, rad, log scale: poses nearer than that are of one cluster
CLUSTER_ROUNDS = 5  # in which a cluster's mean and its members settle


def mean_yaw(yaws: Array | Sequence[float], weights: Array | Sequence[float] | None = None) -> float:
    """Mean angle, rad in [-pi, pi): the direction of the summed unit vectors.

    Raises:
        ValueError: no yaw, or they cancel each other.
    """
    yaws = np.asarray(yaws, np.float64)
    weights = np.ones(len(yaws)) if weights is None else np.asarray(weights, np.float64)
    if not len(yaws):
        raise ValueError("there is no yaw to average")
    total = (weights * np.exp(1j * yaws)).sum()
    if abs(total) < 1e-9 * max(weights.sum(), 1e-300):
        raise ValueError(f"yaws {np.degrees(yaws).round(1)} degrees have no mean: they cancel each other")
    return float((np.angle(total) + np.pi) % (2 * np.pi) - np.pi)


def mean_pose(poses: Sequence[Sim3], weights: Array | Sequence[float] | None = None, anchor: Array | None = None) -> Sim3:
    """Mean of similarities: angle as an angle, scale in logarithms, translation where they place `anchor`.

    Args:
        poses: one or more.
        weights: one each; alike by default.
        anchor: (3,) m, a point of the moved map, its middle: translations are those of the frame's origin, which may lie far
            away, where a small difference of yaw is a large one of translation.

    Raises:
        ValueError: no pose, or turned so that they cancel each other.
    """
    weights = np.ones(len(poses)) if weights is None else np.asarray(weights, np.float64)
    anchor = np.zeros(3) if anchor is None else np.asarray(anchor, np.float64)
    yaw = mean_yaw([p.yaw for p in poses], weights)
    share = weights / weights.sum()
    scale = float(np.exp((share * np.log([p.scale for p in poses])).sum()))
    placed = share @ np.array([p.apply(anchor[None])[0] for p in poses])
    x, y, z = (placed - Sim3(yaw, (0.0, 0.0, 0.0), scale).apply(anchor[None])[0]).tolist()
    return Sim3(yaw, (x, y, z), scale)


def pose_clusters(
    poses: Sequence[Sim3], weights: Array | Sequence[float], anchor: Array | None = None
) -> list[tuple[Sim3, float, list[int]]]:
    """Clusters of weighted poses, heaviest first: (mean, weight, members).

    The pose with most weight around it is a cluster's seed; members are those within `CLUSTER_RADIUS` of the mean, until none
    changes.

    Args:
        anchor: see `mean_pose`.
    """
    anchor = np.zeros(3) if anchor is None else np.asarray(anchor, np.float64)
    weights = np.asarray(weights, np.float64)
    left = list(range(len(poses)))
    clusters = []
    while left:
        neighbours = [[j for j in left if _near(poses[i], poses[j], anchor)] for i in left]
        members = max(neighbours, key=lambda m: float(weights[m].sum()))
        mean = mean_pose([poses[i] for i in members], weights[members], anchor)
        for _ in range(CLUSTER_ROUNDS):
            around = [j for j in left if _near(mean, poses[j], anchor)]
            if around == members or not around:
                break
            members, mean = around, mean_pose([poses[i] for i in around], weights[around], anchor)
        clusters.append((mean, float(weights[members].sum()), members))
        left = [i for i in left if i not in members]
    return sorted(clusters, key=lambda c: -c[1])


def _near(p: Sim3, q: Sim3, anchor: Array) -> bool:
    return all(d <= limit for d, limit in zip(pose_difference(p, q, anchor), CLUSTER_RADIUS, strict=True))
