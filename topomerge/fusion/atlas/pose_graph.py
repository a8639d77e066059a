"""Poses of many maps from measured poses of pairs: robust least squares over yaw, translation and, where free, scale (method 4).

A measurement T_ij says where points of map j lie in map i. Its residuals are how far some points of the place that both maps saw
lie apart when each map puts them into the common frame: metres where it matters, and no weight of angles against lengths.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from topomerge.types import Array, Sim3

POSE_GRAPH_ROUNDS = 30
HALF_WEIGHT_GAP = 0.15  # m: a measurement that is off by this counts half (Cauchy)
LEAST_STEP = 1e-7  # m and rad: a smaller step ends the search
FREE_AT_FIXED_SCALE = np.array([True, True, True, True, False])  # x, y, z, yaw; not the logarithm of the scale


@dataclass(frozen=True, eq=False)
class Measured:
    """A measured pose of a pair.

    Args:
        maps: i and j.
        pose: T_ij.
        points: (k, 3) float64 of map j, in the place that both maps saw, m.
        weight: how much it counts; of amounts of evidence.
    """

    maps: tuple[int, int]
    pose: Sim3
    points: Array
    weight: float = 1.0


def residual(edge: Measured, poses: Mapping[int, Sim3]) -> float:
    """How far a measurement is from the poses: root mean square over its points, m."""
    i, j = edge.maps
    gap = poses[i].apply(edge.pose.apply(edge.points)) - poses[j].apply(edge.points)
    return float(np.sqrt((gap**2).sum(axis=1).mean()))


def optimise(
    start: Mapping[int, Sim3], edges: Sequence[Measured], scaled: bool = False, anchor: int | None = None
) -> dict[int, Sim3]:
    """Poses that agree best with all measurements.

    Args:
        start: map -> T_0k, near the solution (of a spanning tree).
        edges: measurements between maps of `start`.
        scaled: are the scales free, too?
        anchor: the map that keeps its pose; the first one of `start` by default.
    """
    names = list(start)
    anchor = names[0] if anchor is None else anchor
    moving = [name for name in names if name != anchor]
    free = np.array(FREE_AT_FIXED_SCALE if not scaled else [True] * 5)
    width = int(free.sum())
    place = {name: width * k for k, name in enumerate(moving)}
    poses = dict(start)
    for _ in range(POSE_GRAPH_ROUNDS if edges and moving else 0):
        h, g = 1e-9 * np.eye(width * len(moving)), np.zeros(width * len(moving))
        for edge in edges:
            _gather(edge, poses, place, free, h, g)
        step = np.linalg.solve(h, -g)
        for name, at in place.items():
            poses[name] = _moved(poses[name], step[at : at + width])
        if np.abs(step).max() < LEAST_STEP:
            break
    return poses


def _gather(edge: Measured, poses: Mapping[int, Sim3], place: Mapping[int, int], free: Array, h: Array, g: Array) -> None:
    """Add a measurement to the normal equations."""
    i, j = edge.maps
    points_i, points_j = edge.pose.apply(edge.points), edge.points
    gap = poses[i].apply(points_i) - poses[j].apply(points_j)
    off = float(np.sqrt((gap**2).sum(axis=1).mean()))
    weight = edge.weight / (1 + (off / HALF_WEIGHT_GAP) ** 2) / len(points_j)
    parts = []
    for name, points, sign in ((i, points_i, 1.0), (j, points_j, -1.0)):
        if name in place:
            parts.append((place[name], sign * _jacobian(poses[name], points)[:, :, free].reshape(-1, int(free.sum()))))
    flat = gap.reshape(-1)
    for at, jac in parts:
        rows = slice(at, at + jac.shape[1])
        g[rows] += weight * jac.T @ flat
        for other, jac_other in parts:
            h[rows, other : other + jac_other.shape[1]] += weight * jac.T @ jac_other


def _jacobian(pose: Sim3, points: Array) -> Array:
    """(k, 3, 5) of the placed points by x, y, z, yaw and the logarithm of the scale."""
    turned = pose.apply(points) - np.array(pose.translation)
    jacobian = np.zeros((len(points), 3, 5))
    jacobian[:, [0, 1, 2], [0, 1, 2]] = 1.0
    jacobian[:, 0, 3], jacobian[:, 1, 3] = -turned[:, 1], turned[:, 0]
    jacobian[:, :, 4] = turned
    return jacobian


def _moved(pose: Sim3, step: Array) -> Sim3:
    x, y, z = (np.array(pose.translation) + step[:3]).tolist()
    grown = pose.scale * float(np.exp(step[4])) if len(step) > 4 else pose.scale
    yaw = float((pose.yaw + step[3] + np.pi) % (2 * np.pi) - np.pi)
    return Sim3(yaw, (x, y, z), grown)
