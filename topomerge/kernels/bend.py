"""How well pieces of one plan lie on another one, over a grid of small moves of each."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def move_scores(points, sector, start, places, turns, yaws, shifts, gain, origin, edge):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(K, Y, S, S) sums of the gain at the points of each piece under each turn and shift.

    Args:
        points: (n, 2) m about the anchor of their piece; sector (n,) int, which gain each point has.
        start: (K + 1,) first point of each piece.
        places: (K, 2) m, where the anchors are; turns (K,) rad.
        yaws: (Y,) rad, turns that are tried beyond `turns`; shifts (S,) m, along both axes.
        gain: (Q, nx, ny); points outside gain nothing.
        origin: (2,) m, corner of the raster; edge of its columns, m.
    """
    many, yaw_count, side = len(places), len(yaws), len(shifts)
    out = np.zeros((many, yaw_count, side, side))
    steps = shifts / edge
    column = np.empty(side, np.int64)
    for k in range(many):
        for a in range(yaw_count):
            c, s = np.cos(turns[k] + yaws[a]), np.sin(turns[k] + yaws[a])
            for p in range(start[k], start[k + 1]):
                x = (places[k, 0] + c * points[p, 0] - s * points[p, 1] - origin[0]) / edge
                y = (places[k, 1] + s * points[p, 0] + c * points[p, 1] - origin[1]) / edge
                for j in range(side):
                    column[j] = int(np.floor(y + steps[j]))
                q = sector[p]
                for i in range(side):
                    u = int(np.floor(x + steps[i]))
                    if u < 0 or u >= gain.shape[1]:
                        continue
                    for j in range(side):
                        v = column[j]
                        if v >= 0 and v < gain.shape[2]:
                            out[k, a, i, j] += gain[q, u, v]
    return out
