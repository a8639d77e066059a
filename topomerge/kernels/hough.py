"""The run of points that most metres of wall line up on: the voting of a Hough transform."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def strongest(points, weights, angles, width):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Direction (rad) and offset across it (m) of the line with most weight in two neighbouring bins; the first of several.

    Args:
        points: (n, 2) m, about their middle.
        weights: (n,).
        angles: (k,) rad, directions that are tried.
        width: m, of a bin.
    """
    best, angle, offset = 0.0, 0.0, 0.0
    across = np.empty(len(points))
    for a in angles:
        c, s = np.cos(a), -np.sin(a)
        low, high = np.inf, -np.inf
        for i in range(len(points)):
            across[i] = points[i, 0] * s + points[i, 1] * c
            low, high = min(low, across[i]), max(high, across[i])
        count = np.zeros(int((high - low) / width) + 1)
        for i in range(len(points)):
            count[int((across[i] - low) / width)] += weights[i]
        for k in range(max(len(count) - 1, 1)):
            two = count[k] + (count[k + 1] if len(count) > 1 else 0.0)
            if two > best:
                best, angle, offset = two, a, low + (k + 1) * width
    return angle, offset
