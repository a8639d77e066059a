"""Voronoi cells of points in their tangent planes: the weights of a Laplacian on a point cloud."""

from __future__ import annotations

import numpy as np
from numba import njit

CORNERS = 40  # of a cell, at most: each neighbour adds one


@njit(cache=True)
def _clip(corners, owner, count, x, y, half, name):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Keep of a convex polygon what has (x, y) . p <= half; the new side belongs to `name`. Gives the number of corners."""
    beyond = False  # of most neighbours the cell is clear already
    for c in range(count):
        beyond |= corners[c, 0] * x + corners[c, 1] * y > half
    if not beyond:
        return count
    cut, cut_owner = np.empty((CORNERS, 2)), np.empty(CORNERS, np.int64)
    m = 0
    for c in range(count):
        d = (c + 1) % count
        side = corners[c, 0] * x + corners[c, 1] * y - half
        next_side = corners[d, 0] * x + corners[d, 1] * y - half
        if side <= 0:
            cut[m, 0], cut[m, 1], cut_owner[m] = corners[c, 0], corners[c, 1], owner[c]
            m += 1
        if (side <= 0) != (next_side <= 0):
            t = side / (side - next_side)
            for a in range(2):
                cut[m, a] = corners[c, a] + t * (corners[d, a] - corners[c, a])
            cut_owner[m] = name if side <= 0 else owner[c]
            m += 1
    for c in range(m):
        corners[c, 0], corners[c, 1], owner[c] = cut[c, 0], cut[c, 1], cut_owner[c]
    return m


@njit(cache=True)
def voronoi_weights(flat, spacing):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Area of each point's cell, and the weight of each of its neighbours: length of the common side over the distance.

    Args:
        flat: (n, k, 2) float64 neighbours in the tangent plane of each point, the point itself being the origin.
        spacing: (n,) usual distance of neighbours. A cell that has none on one side ends there after half of it.

    Returns:
        area (n,), weight (n, k) float64; a point's weights are half the sum of two cotangents where the cells tile a surface.
    """
    n, k = flat.shape[:2]
    area, weight = np.zeros(n), np.zeros((n, k))
    for i in range(n):
        corners, owner = np.empty((CORNERS, 2)), np.empty(CORNERS, np.int64)
        r = 2 * spacing[i]
        for c in range(4):  # a square, counter-clockwise; the owner is that of the side that begins at a corner
            corners[c, 0], corners[c, 1], owner[c] = r if c in (1, 2) else -r, r if c > 1 else -r, -1
        count, sum_x, sum_y = np.int64(4), 0.0, 0.0
        for j in range(k + 1):  # one call for all half planes: each further one is compiled anew
            if j < k:
                x, y, name = flat[i, j, 0], flat[i, j, 1], j
                sum_x += x
                sum_y += y
                half = 0.5 * (x**2 + y**2)
                if not half > 1e-12:
                    continue
            else:  # on the side that has no neighbour
                length = np.sqrt(sum_x**2 + sum_y**2)
                is_open = False
                for c in range(count):
                    is_open |= owner[c] < 0
                if not (length > 1e-9 and is_open):
                    continue
                x, y, name, half = -sum_x / length, -sum_y / length, -1, 0.5 * spacing[i]
            count = _clip(corners, owner, count, x, y, half, name)
        for c in range(count):
            d = (c + 1) % count
            area[i] += 0.5 * (corners[c, 0] * corners[d, 1] - corners[d, 0] * corners[c, 1])
            j = owner[c]
            if j >= 0:
                side = np.sqrt((corners[d, 0] - corners[c, 0]) ** 2 + (corners[d, 1] - corners[c, 1]) ** 2)
                weight[i, j] += side / np.sqrt(flat[i, j, 0] ** 2 + flat[i, j, 1] ** 2)
    return area, weight
