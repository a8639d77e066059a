"""A sheet of pixels turned, stretched and bent: the compiled loop behind `training.other_sensors.bent`."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def drift(knots, x, y):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """How far the place x, y of a grid of `knots` (2, m, n) float64 moves, between its four neighbours; those at the border reach
    on for ever."""
    m, n = knots.shape[1] - 1, knots.shape[2] - 1
    x, y = min(max(x, 0.0), m - 1e-9), min(max(y, 0.0), n - 1e-9)
    i, j = int(x), int(y)
    u, v = x - i, y - j
    w = ((1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v)
    dx = w[0] * knots[0, i, j] + w[1] * knots[0, i + 1, j] + w[2] * knots[0, i, j + 1] + w[3] * knots[0, i + 1, j + 1]
    dy = w[0] * knots[1, i, j] + w[1] * knots[1, i + 1, j] + w[2] * knots[1, i, j + 1] + w[3] * knots[1, i + 1, j + 1]
    return dx, dy


@njit(cache=True, nogil=True)
def drifts(knots, places):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(n, 2) `drift` of places (n, 2) float64."""
    out = np.zeros((len(places), 2))
    for k in range(len(places)):
        out[k, 0], out[k, 1] = drift(knots, places[k, 0], places[k, 1])
    return out


@njit(cache=True, nogil=True)
def warped(planes, room, back, low, shape, knots, step):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Planes (*shape, P) uint8 and rooms (*shape) int16: each pixel is that of the sheet that came there; off it 0 and -1.

    Args:
        planes: (H, W, P) uint8; room: (H, W) int16.
        back: (2, 2) float64, turns and shrinks a place back to where it was before; low: (2,) float64 place of the first pixel.
        knots: (2, m, n) float64 pixels that places `step` pixels apart had moved before.
    """
    height, width, count = planes.shape
    out, of = np.zeros((shape[0], shape[1], count), np.uint8), np.full((shape[0], shape[1]), -1, np.int16)
    for i in range(shape[0]):
        for j in range(shape[1]):
            x, y = i + 0.5 + low[0], j + 0.5 + low[1]
            x, y = back[0, 0] * x + back[0, 1] * y, back[1, 0] * x + back[1, 1] * y
            dx, dy = drift(knots, x / step, y / step)
            p, q = int(np.floor(x - dx)), int(np.floor(y - dy))
            if p >= 0 and q >= 0 and p < height and q < width:
                out[i, j], of[i, j] = planes[p, q], room[p, q]
    return out, of
