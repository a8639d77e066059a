"""Points on triangles: a square lattice on each, one point an area of spacing².

A lattice leaves no holes, as points drawn at random do (at one draw a cell, 37 % of the cells stay empty). Each triangle's
lattice starts at an offset of its own, drawn from a hash of its number, so slivers and triangles smaller than the lattice get
their share of points on average, and the same mesh always gives the same points.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, inline="always")
def _offset(number):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Uniform in [0, 1) from an integer (splitmix64)."""
    h = (np.uint64(number) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return ((h ^ (h >> np.uint64(31))) >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@njit(cache=True, error_model="numpy")
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
        row = _offset(2 * (first + i)) * spacing
        start = _offset(2 * (first + i) + 1)
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


def points_on_triangles(triangles: NDArray[Any], spacing: float, first: int = 0) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(n, 3) points on triangles (m, 3, 3) and the (n,) triangle of each; `first` is the number of the first triangle.

    The caller bounds the area: n is about the area over spacing².
    """
    triangles = np.ascontiguousarray(triangles, np.float64)
    empty = np.empty((0, 3)), np.empty(0, np.int64)
    count = int(_walk(triangles, spacing, first, *empty, False))
    points, owner = np.empty((count, 3)), np.empty(count, np.int64)
    _walk(triangles, spacing, first, points, owner, True)
    return points, owner


def areas(triangles: NDArray[Any]) -> NDArray[np.float64]:
    """(m,) areas of triangles (m, 3, 3)."""
    with np.errstate(over="ignore", invalid="ignore"):
        t = np.asarray(triangles, np.float64)
        return 0.5 * np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1)
