"""Compiled loops over triangles and tangent planes: points on triangles, Voronoi weights."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from topomerge.kernels import compile_ahead

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
def compute_voronoi_weights(flat, spacing):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the area of each point's cell, and the weight of each of its neighbours: length of the common side over the
    distance.

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


@njit(cache=True, inline="always")
def _draw_uniform(number):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Draw a number uniform in [0, 1) from an integer (splitmix64)."""
    h = (np.uint64(number) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return ((h ^ (h >> np.uint64(31))) >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@compile_ahead("f8[:,:,::1], f8, i8, f8[:,::1], i8[::1], b1", error_model="numpy")
def _walk(triangles, spacing, first, points, owner, fill):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Count the lattice points, or write them where `fill`; triangle i has the number first + i."""
    count = 0
    for i in range(len(triangles)):
        best, base = -1.0, 0  # lines run along the longest edge
        for k in range(3):
            d = triangles[i, (k + 1) % 3] - triangles[i, k]
            length = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
            if length > best:
                best, base = length, k
        a, b, c = triangles[i, base], triangles[i, (base + 1) % 3], triangles[i, (base + 2) % 3]
        width = np.sqrt(best)
        if not width > 0.0 or not np.isfinite(width):
            continue
        u = (b - a) / width
        along = (c[0] - a[0]) * u[0] + (c[1] - a[1]) * u[1] + (c[2] - a[2]) * u[2]
        v = c - a - along * u
        height = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        if not height > 0.0:
            continue
        v = v / height
        row = _draw_uniform(2 * (first + i)) * spacing
        start = _draw_uniform(2 * (first + i) + 1)
        while row < height:
            t = row / height
            left, right = t * along, width + t * (along - width)
            x = (np.ceil(left / spacing - start) + start) * spacing
            while x < right:
                if fill:
                    for k in range(3):
                        points[count, k] = a[k] + x * u[k] + row * v[k]
                    owner[count] = i
                count += 1
                x += spacing
            row += spacing
    return count


def sample_triangles(triangles: NDArray[Any], spacing: float, first: int = 0) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return (n, 3) points on triangles (m, 3, 3) and the (n,) triangle of each; `first` is the number of the first triangle.

    The caller bounds the area: n is about the area over spacing².
    """
    triangles = np.ascontiguousarray(triangles, np.float64)
    empty = np.empty((0, 3)), np.empty(0, np.int64)
    spacing, first = float(spacing), int(first)  # the types that the loop is compiled for
    count = int(_walk(triangles, spacing, first, *empty, False))
    points, owner = np.empty((count, 3)), np.empty(count, np.int64)
    _walk(triangles, spacing, first, points, owner, True)
    return points, owner


def compute_areas(triangles: NDArray[Any]) -> NDArray[np.float64]:
    """Return (m,) areas of triangles (m, 3, 3)."""
    with np.errstate(over="ignore", invalid="ignore"):
        t = np.asarray(triangles, np.float64)
        return 0.5 * np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1)
