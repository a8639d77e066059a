"""Evidence for poses of one plan on another: walls on walls, and walls where the other saw free floor."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

WALL_NEAR, WALL_FAR = 0.1, 0.3  # m from a wall column: floor there stands in the wall; a wall beyond it stands on free floor


@njit(cache=True, parallel=True)
def pose_evidence(poses, storeys, points, storey, is_wall, distance, floor, origin, edge, sigma):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Agreement, conflict and common floor of each pose, in numbers of points.

    Args:
        poses: (H, 4) float64 a, b, x, y: (u, v) -> (a u - b v + x, b u + a v + y).
        storeys: (H, S_b) int64 storey of the plan that each storey of the points falls on, -1 none.
        points: (N, 2) float64; storey (N,) int64; is_wall (N,) bool: wall or floor?
        distance: (S, nx, ny) float32, m to the nearest wall column; floor (S, nx, ny) bool: known to be free.
        origin: (2,); edge: m; sigma: m, of the fall of agreement with distance.

    Returns:
        (H, 3) float64: walls on walls, points that contradict the plan (walls on free floor, floor in walls), floor on floor.
    """
    out = np.zeros((len(poses), 3))
    _, nx, ny = distance.shape
    for h in prange(len(poses)):
        a, b, x, y = poses[h, 0], poses[h, 1], poses[h, 2], poses[h, 3]
        agree, against, common = 0.0, 0.0, 0.0
        for i in range(len(points)):
            s = storeys[h, storey[i]]
            if s < 0:
                continue
            u = int(np.floor((a * points[i, 0] - b * points[i, 1] + x - origin[0]) / edge))
            v = int(np.floor((b * points[i, 0] + a * points[i, 1] + y - origin[1]) / edge))
            if u < 0 or v < 0 or u >= nx or v >= ny:
                continue
            d, free = distance[s, u, v], floor[s, u, v]
            if is_wall[i]:
                if d < 3 * sigma:
                    agree += np.exp(-0.5 * (d / sigma) ** 2)
                if free and d > WALL_FAR:
                    against += 1
            elif free:
                common += 1
            elif d < WALL_NEAR:
                against += 1
        out[h, 0], out[h, 1], out[h, 2] = agree, against, common
    return out
