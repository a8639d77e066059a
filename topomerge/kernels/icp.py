"""Point-to-plane registration with four or five unknowns: yaw, translation, and log scale where it is free."""

from __future__ import annotations

import numpy as np
from numba import njit

from topomerge.kernels.lookup import row


@njit(cache=True, nogil=True)
def normals(table, bricks, cells, points, chosen, reach, least):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(m, 3) unit normals of the planes through the points of the cells within `reach` of each `chosen` row, and (m,) how flat
    these are (0 to 1); 0 where fewer than `least` cells are near."""
    out, flat = np.zeros((len(chosen), 3)), np.zeros(len(chosen))
    for k in range(len(chosen)):
        i = chosen[k]
        n, mean, square = 0, np.zeros(3), np.zeros((3, 3))
        for a in range(-reach, reach + 1):
            for b in range(-reach, reach + 1):
                for c in range(-reach, reach + 1):
                    j = row(table, bricks, cells[i, 0] + a, cells[i, 1] + b, cells[i, 2] + c)
                    if j >= 0:
                        n += 1
                        for u in range(3):
                            d = points[j, u] - points[i, u]
                            mean[u] += d
                            for v in range(u + 1):
                                square[u, v] += d * (points[j, v] - points[i, v])
        if n < least:
            continue
        for u in range(3):
            for v in range(u + 1):
                square[u, v] = square[u, v] / n - mean[u] * mean[v] / (n * n)
                square[v, u] = square[u, v]
        values, vectors = np.linalg.eigh(square)
        if values[1] > 1e-12:
            out[k] = vectors[:, 0]
            flat[k] = 1.0 - max(values[0], 0.0) / values[1]
    return out, flat


@njit(cache=True, nogil=True, error_model="numpy")
def gather(table, bricks, origin, edge, points, normal, moving, moving_normal, pose, reach, sigma, scaled):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Normal equations of one round: each moving point and the nearest one with a like normal within `reach` cells.

    `pose` is (x, y, z, yaw, log scale); moving points are about the origin of the rotation. Returns H (5, 5), g (5,), number of
    partners, and the sums of weights and of weighted squared distances.
    """
    h, g = np.zeros((5, 5)), np.zeros(5)
    partners, weight, square = 0, 0.0, 0.0
    size = np.exp(pose[4])
    c, s = np.cos(pose[3]), np.sin(pose[3])
    jac = np.zeros(5)
    for i in range(len(moving)):
        dx = size * (c * moving[i, 0] - s * moving[i, 1])
        dy = size * (s * moving[i, 0] + c * moving[i, 1])
        dz = size * moving[i, 2]
        px, py, pz = dx + pose[0], dy + pose[1], dz + pose[2]
        nx = c * moving_normal[i, 0] - s * moving_normal[i, 1]
        ny = s * moving_normal[i, 0] + c * moving_normal[i, 1]
        nz = moving_normal[i, 2]
        x = int(np.floor((px - origin[0]) / edge))
        y = int(np.floor((py - origin[1]) / edge))
        z = int(np.floor((pz - origin[2]) / edge))
        best, near = -1, 1e9
        for a in range(-reach, reach + 1):
            for b in range(-reach, reach + 1):
                for d in range(-reach, reach + 1):
                    j = row(table, bricks, x + a, y + b, z + d)
                    if j < 0:
                        continue
                    if abs(nx * normal[j, 0] + ny * normal[j, 1] + nz * normal[j, 2]) < 0.8:
                        continue
                    far = (points[j, 0] - px) ** 2 + (points[j, 1] - py) ** 2 + (points[j, 2] - pz) ** 2
                    if far < near:
                        best, near = j, far
        if best < 0:
            continue
        ux, uy, uz = normal[best, 0], normal[best, 1], normal[best, 2]
        if ux * nx + uy * ny + uz * nz < 0:
            nx, ny, nz = -nx, -ny, -nz
        ux, uy, uz = ux + nx, uy + ny, uz + nz  # the mean of both planes' normals: neither map is the truth
        length = np.sqrt(ux * ux + uy * uy + uz * uz)
        ux, uy, uz = ux / length, uy / length, uz / length
        r = ux * (px - points[best, 0]) + uy * (py - points[best, 1]) + uz * (pz - points[best, 2])
        w = 1.0 / (1.0 + (r / sigma) ** 2) ** 2  # Geman-McClure
        jac[0], jac[1], jac[2] = ux, uy, uz
        jac[3] = uy * dx - ux * dy
        jac[4] = (ux * dx + uy * dy + uz * dz) if scaled else 0.0
        for u in range(5):
            g[u] += w * r * jac[u]
            for v in range(5):
                h[u, v] += w * jac[u] * jac[v]
        partners += 1
        weight += w
        square += w * r * r
    return h, g, partners, weight, square
