"""Many poses of a plan refined and judged on another one."""

from __future__ import annotations

import numpy as np
from numba import njit

from topomerge.kernels.symmetric import solved


@njit(cache=True, nogil=True, inline="always")
def _sample(field, u, v):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Value and gradient (per cell) of a field between the middles of its cells; False outside."""
    i, j = int(np.floor(u)), int(np.floor(v))
    if i < 0 or j < 0 or i + 1 >= field.shape[0] or j + 1 >= field.shape[1]:
        return False, 0.0, 0.0, 0.0
    a, b = u - i, v - j
    f00, f10, f01, f11 = field[i, j], field[i + 1, j], field[i, j + 1], field[i + 1, j + 1]
    value = f00 * (1 - a) * (1 - b) + f10 * a * (1 - b) + f01 * (1 - a) * b + f11 * a * b
    return True, value, (f10 - f00) * (1 - b) + (f11 - f01) * b, (f01 - f00) * (1 - a) + (f11 - f10) * a


@njit(cache=True, nogil=True, error_model="numpy")
def refine(points, field, origin, cell, poses, sigmas, rounds, scaled):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Gauss-Newton over (x, y, yaw, log scale) of many poses on a distance field, weights exp(-d2 / 2 sigma2), sigma shrinking.

    Points are (n, 2) about their middle; a pose places that middle at (x, y). `scaled`: is the scale free, too?
    Returns the poses and, for each, the sum of the weights at the last sigma.
    """
    out = poses.copy()
    score = np.zeros(len(poses))
    free = 4 if scaled else 3
    for k in range(len(poses)):
        for sigma in sigmas:
            for r in range(rounds + 1):
                x, y, yaw, size = out[k, 0], out[k, 1], out[k, 2], np.exp(out[k, 3])
                c, s = np.cos(yaw) * size, np.sin(yaw) * size
                h, g = np.zeros((4, 4)), np.zeros(4)
                total = 0.0
                for i in range(len(points)):
                    dx, dy = c * points[i, 0] - s * points[i, 1], s * points[i, 0] + c * points[i, 1]
                    inside, d, gx, gy = _sample(field, (x + dx - origin[0]) / cell - 0.5, (y + dy - origin[1]) / cell - 0.5)
                    if not inside or d > 3 * sigma:
                        continue
                    w = np.exp(-d * d / (2 * sigma * sigma))
                    total += w
                    gx, gy = gx / cell, gy / cell
                    j0, j1, j2, j3 = gx, gy, gy * dx - gx * dy, gx * dx + gy * dy
                    g[0] += w * d * j0
                    g[1] += w * d * j1
                    g[2] += w * d * j2
                    g[3] += w * d * j3
                    h[0, 0] += w * j0 * j0
                    h[0, 1] += w * j0 * j1
                    h[0, 2] += w * j0 * j2
                    h[0, 3] += w * j0 * j3
                    h[1, 1] += w * j1 * j1
                    h[1, 2] += w * j1 * j2
                    h[1, 3] += w * j1 * j3
                    h[2, 2] += w * j2 * j2
                    h[2, 3] += w * j2 * j3
                    h[3, 3] += w * j3 * j3
                score[k] = total
                if r == rounds or total < 3.0:
                    break
                for a in range(free):
                    h[a, a] += 1e-3 * h[a, a] + 1e-3
                step = solved(h, g, free)
                for a in range(free):
                    most = 0.5 if a < 2 else 0.05  # m, and rad or of the scale's logarithm
                    out[k, a] -= min(max(step[a], -most), most)
    return out, score


@njit(cache=True, nogil=True, inline="always")
def _alike(p, q):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Bits in both of those in either."""
    both, either = 0, 0
    for k in range(32):
        u, v = (p >> np.uint32(k)) & np.uint32(1), (q >> np.uint32(k)) & np.uint32(1)
        both += u & v
        either += u | v
    return both / max(either, 1)


WALL_STATE, FREE_STATE, CLUTTER_STATE, HAZE_STATE = 1, 2, 3, 4


@njit(cache=True, nogil=True)
def tally(points, kinds, facing, inner, filled, kind, to_wall, to_any, face, open_, bits, origin, cell, pose, near, far):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """What the columns of one plan meet in the other under a pose (x, y, yaw, log scale) that maps them into it.

    `facing` and `face` are unit vectors from walls towards empty space (0 where unknown); `to_wall` and `to_any` the distances to
    the nearest wall, and to anything standing, m. Returns counts of columns:
    0 walls on known ground, 1 of these near a wall that faces alike, 2 near one that faces the other way, 3 walls on free ground
    that stand `far` from anything; 4 free on known ground, 5 free on free; of the columns that are `inner` here and fall on such
    there (`open_`): 6 clutter, 7 of these near clutter, weighed by how alike the bands are that they fill (`filled`, `bits`),
    8 free, 9 of these near clutter; 10 walls in all.
    """
    out = np.zeros(11)
    size = np.exp(pose[3])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    for i in range(len(points)):
        what = kinds[i]
        if what == WALL_STATE:
            out[10] += 1
        x = int(np.floor((size * (c * points[i, 0] - s * points[i, 1]) + pose[0] - origin[0]) / cell))
        y = int(np.floor((size * (s * points[i, 0] + c * points[i, 1]) + pose[1] - origin[1]) / cell))
        if x < 1 or y < 1 or x >= kind.shape[0] - 1 or y >= kind.shape[1] - 1:
            continue
        there = kind[x, y]
        if what == WALL_STATE:
            if to_wall[x, y] <= near:
                fx, fy = c * facing[i, 0] - s * facing[i, 1], s * facing[i, 0] + c * facing[i, 1]
                agree = fx * face[x, y, 0] + fy * face[x, y, 1]
                out[0] += 1
                if agree > -0.3:
                    out[1] += 1
                else:
                    out[2] += 1
            elif there != 0:
                out[0] += 1
                if there == FREE_STATE and to_any[x, y] >= far:
                    out[3] += 1
            continue
        if there == 0:
            continue
        if what == FREE_STATE:
            out[4] += 1
            out[5] += there == FREE_STATE
        if not inner[i] or not open_[x, y]:
            continue
        close = 0.0
        for a in range(-1, 2):
            for b in range(-1, 2):
                if kind[x + a, y + b] == CLUTTER_STATE:
                    close = max(close, 1.0 if what == FREE_STATE else _alike(filled[i], bits[x + a, y + b]))
        if what == CLUTTER_STATE:
            out[6] += 1
            out[7] += close
        elif what == FREE_STATE:
            out[8] += 1
            out[9] += close
    return out
