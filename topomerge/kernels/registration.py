"""Compiled loops of registration: alignment, point-to-plane steps, evidence and votes for poses."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from topomerge.kernels import compile_ahead, run_in_slices
from topomerge.kernels.voxels import find_row

Ints = NDArray[Any]
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
LEAST_NORMALS = 1024  # of a slice


@compile_ahead("f8[:,::1], f8[::1], i8", error_model="numpy")
def solve_cholesky(h, g, count):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return (F,) x of H x = g in the first `count` of F unknowns, 0 in the others: by Cholesky's factor.

    Args:
        h: (F, F) positive definite; only its upper half is read.
        g: (F,).
    """
    low, x = np.zeros((len(g), len(g))), np.zeros(len(g))
    for a in range(count):
        for b in range(a + 1):
            left = h[b, a]
            for k in range(b):
                left -= low[a, k] * low[b, k]
            low[a, b] = np.sqrt(left) if a == b else left / low[b, b]
    for a in range(count):
        left = g[a]
        for k in range(a):
            left -= low[a, k] * x[k]
        x[a] = left / low[a, a]
    for a in range(count - 1, -1, -1):
        left = x[a]
        for k in range(a + 1, count):
            left -= low[k, a] * x[k]
        x[a] = left / low[a, a]
    return x


@compile_ahead("f4[:,::1], f8, f8")
def _sample(field, u, v):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the value and gradient (per cell) of a field between the middles of its cells; False outside."""
    i, j = int(np.floor(u)), int(np.floor(v))
    if i < 0 or j < 0 or i + 1 >= field.shape[0] or j + 1 >= field.shape[1]:
        return False, 0.0, 0.0, 0.0
    a, b = u - i, v - j
    f00, f10, f01, f11 = field[i, j], field[i + 1, j], field[i, j + 1], field[i + 1, j + 1]
    value = f00 * (1 - a) * (1 - b) + f10 * a * (1 - b) + f01 * (1 - a) * b + f11 * a * b
    return True, value, (f10 - f00) * (1 - b) + (f11 - f01) * b, (f01 - f00) * (1 - a) + (f11 - f10) * a


@compile_ahead("f8[:,::1], f4[:,::1], f8[::1], f8, f8[:,::1], f8[::1], i8, b1", error_model="numpy")
def refine(points, field, origin, cell, poses, sigmas, rounds, scaled):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Run Gauss-Newton over (x, y, yaw, log scale) of many poses on a distance field, weights exp(-d2 / 2 sigma2), sigma
    shrinking.

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
                step = solve_cholesky(h, g, free)
                for a in range(free):
                    most = 0.5 if a < 2 else 0.05  # m, and rad or of the scale's logarithm
                    out[k, a] -= min(max(step[a], -most), most)
    return out, score


@compile_ahead("u4, u4")
def _compare_bits(p, q):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the share of the bits in either that are in both."""
    both, either = 0, 0
    for k in range(32):
        u, v = (p >> np.uint32(k)) & np.uint32(1), (q >> np.uint32(k)) & np.uint32(1)
        both += u & v
        either += u | v
    return both / max(either, 1)


WALL_STATE, FREE_STATE, CLUTTER_STATE, HAZE_STATE = 1, 2, 3, 4


@compile_ahead(
    "f8[:,::1], u1[::1], f4[:,::1], b1[::1], u4[::1], u1[:,::1], f4[:,::1], f4[:,::1], f4[:,:,::1], b1[:,::1], u4[:,::1],"
    "f8[::1], f8, f8[::1], f8, f8"
)
def tally(points, kinds, facing, inner, filled, kind, to_wall, to_any, face, open_, bits, origin, cell, pose, near, far):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Count what the columns of one plan meet in the other under a pose (x, y, yaw, log scale) of it in the other.

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
        cell_kind = kind[x, y]
        if what == WALL_STATE:
            if to_wall[x, y] <= near:
                fx, fy = c * facing[i, 0] - s * facing[i, 1], s * facing[i, 0] + c * facing[i, 1]
                agree = fx * face[x, y, 0] + fy * face[x, y, 1]
                out[0] += 1
                if agree > -0.3:
                    out[1] += 1
                else:
                    out[2] += 1
            elif cell_kind != 0:
                out[0] += 1
                if cell_kind == FREE_STATE and to_any[x, y] >= far:
                    out[3] += 1
            continue
        if cell_kind == 0:
            continue
        if what == FREE_STATE:
            out[4] += 1
            out[5] += cell_kind == FREE_STATE
        if not inner[i] or not open_[x, y]:
            continue
        close = 0.0
        for a in range(-1, 2):
            for b in range(-1, 2):
                if kind[x + a, y + b] == CLUTTER_STATE:
                    close = max(close, 1.0 if what == FREE_STATE else _compare_bits(filled[i], bits[x + a, y + b]))
        if what == CLUTTER_STATE:
            out[6] += 1
            out[7] += close
        elif what == FREE_STATE:
            out[8] += 1
            out[9] += close
    return out


def estimate_normals(
    table: Ints, bricks: Ints, cells: Ints, points: Floats, chosen: Ints, reach: int, least: int
) -> tuple[Floats, Floats]:
    """Return (m, 3) unit normals of the planes through the points of the cells within `reach` of each `chosen` row, and (m,) how
    flat these are (0 to 1); 0 where fewer than `least` cells are near."""
    out, flat = np.zeros((len(chosen), 3)), np.zeros(len(chosen))
    square, enough = np.zeros((len(chosen), 3, 3)), np.zeros(len(chosen), np.bool_)
    run_in_slices(_sum_squares, len(chosen), LEAST_NORMALS, table, bricks, cells, points, chosen, reach, least, square, enough)
    # NumPy's batch: the same bits as in the loop, which takes 3.9 s longer to compile with it (docs/adr/0031).
    values, vectors = np.linalg.eigh(square[enough])
    is_plane = values[:, 1] > 1e-12
    rows = np.flatnonzero(enough)[is_plane]
    out[rows] = vectors[is_plane, :, 0]
    flat[rows] = 1.0 - np.maximum(values[is_plane, 0], 0.0) / values[is_plane, 1]
    return out, flat


@compile_ahead("i8, i8, i4[:,:,::1], i4[:,::1], i4[:,::1], f8[:,::1], i8[::1], i8, i8, f8[:,:,::1], b1[::1]")
def _sum_squares(first, last, table, bricks, cells, points, chosen, reach, least, out, enough):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write the covariances (m, 3, 3) of the points around each chosen row of which enough cells are near."""
    for k in range(first, last):
        i = chosen[k]
        n, mean, square = 0, np.zeros(3), out[k]
        for a in range(-reach, reach + 1):
            for b in range(-reach, reach + 1):
                for c in range(-reach, reach + 1):
                    j = find_row(table, bricks, cells[i, 0] + a, cells[i, 1] + b, cells[i, 2] + c)
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
        enough[k] = True


@compile_ahead(
    "i4[:,:,::1], i4[:,::1], f8[::1], f8, f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], i8, f8, b1", error_model="numpy"
)
def build_normal_equations(table, bricks, origin, edge, points, normal, moving, moving_normal, pose, reach, sigma, scaled):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Build the normal equations of one round: each moving point and the nearest one with a like normal within `reach` cells.

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
                    j = find_row(table, bricks, x + a, y + b, z + d)
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


WALL_NEAR, WALL_FAR = 0.1, 0.3  # m from a wall column: floor there stands in the wall; a wall beyond it stands on free floor


def measure_pose_evidence(
    poses: Floats, storeys: Ints, points: Floats, storey: Ints, is_wall: Bools, distance: NDArray[np.float32], floor: Bools,
    origin: Floats, edge: float, sigma: float,
) -> Floats:  # fmt: skip
    """Return the agreement, conflict and common floor of each pose, in numbers of points.

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
    run_in_slices(
        _measure_pose_evidence, len(poses), 1, poses, storeys, points, storey, is_wall, distance, floor, origin, edge, sigma, out
    )
    return out


@compile_ahead("i8, i8, f8[:,::1], i8[:,::1], f8[:,::1], i8[::1], b1[::1], f4[:,:,::1], b1[:,:,::1], f8[::1], f8, f8, f8[:,::1]")
def _measure_pose_evidence(first, last, poses, storeys, points, storey, is_wall, distance, floor, origin, edge, sigma, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    _, nx, ny = distance.shape
    for h in range(first, last):
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


@compile_ahead("f8[:,::1], f8[::1], i8[:,::1], f8[::1], i8[::1], i8[::1], f8[::1], f8", error_model="numpy")
def sum_votes(way, rise, room, probability, voted, voters, widths, level_gap):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the sums (len(voted), len(widths)) float64 of the chances of the voters whose way is near that of each pair, by how
    near it is: the weight of a voter falls from 1 to 0 at a width (biweight). None votes for a pair that shares a room with it.

    Args:
        way: (n, 2) float64 m from one map to the other by each pair of rooms; rise: (n,) float64 m, likewise upwards.
        room: (n, 2) int64 the two rooms of each pair.
        probability: (n,) float64 how likely each pair is.
        voted, voters: int64 pairs that are voted for, and those that vote.
        widths: float64 m.
        level_gap: m, from which on two ways lead to different storeys.
    """
    out = np.zeros((len(voted), len(widths)))
    for i in range(len(voted)):
        p = voted[i]
        for q in voters:
            if room[p, 0] == room[q, 0] or room[p, 1] == room[q, 1] or not abs(rise[p] - rise[q]) < level_gap:
                continue
            x, y = way[p, 0] - way[q, 0], way[p, 1] - way[q, 1]
            apart = x * x + y * y
            for k in range(len(widths)):
                near = 1 - apart / widths[k] ** 2
                if near > 0:
                    out[i, k] += near * near * probability[q]
    return out


UP, LEAST_UP = 2, 4  # of a cell's wall: of so many cells above it and below it, itself included, these many are occupied


@compile_ahead("i4[:,:,::1], i4[:,::1], i8, i8, i8")
def _is_upright(table, bricks, x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    count = 0
    for w in range(z - UP, z + UP + 1):
        if find_row(table, bricks, x, y, w) >= 0:
            count += 1
    return count >= LEAST_UP


@compile_ahead("Tuple((i4[:,:,::1], i4[:,::1])), i8, i8, i8, f8, f8")
def _is_seen_through(free, x, y, z, u, v):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return whether the first or second place of free space behind (x, y, z), in the direction (u, v), is known to be empty."""
    for step in (1.5, 2.5, 3.5):
        p, q = int(np.floor(x + 0.5 + step * u)), int(np.floor(y + 0.5 + step * v))
        if find_row(free[0], free[1], p >> 1, q >> 1, z >> 1) >= 0:
            return True
    return False


@compile_ahead(
    "i8[:,::1], i8[:,::1], Tuple((i4[:,:,::1], i4[:,::1])), Tuple((i4[:,:,::1], i4[:,::1])), "
    "Tuple((i4[:,:,::1], i4[:,::1])), Tuple((i4[:,:,::1], i4[:,::1]))"
)
def find_copied_cells(cells, offsets, first, second, first_free, second_free):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the (n,) int64 row of the first map's cell of which each of the second one's is a copy, -1 none.

    A copy is a cell of a wall, beside one of a wall of the first map, where that is not occupied itself: and either the first map
    saw through where it stands, or the second one through where the other stands. Else the two are the faces of a thick wall.

    Args:
        cells: (n, 3) int64 of the second map.
        offsets: (k, 2) int64 steps to the cells beside, the nearest first.
        first, second: table and bricks of their cells (`kernels.voxels.build`).
        first_free, second_free: of their free cells, which are twice as long.
    """
    out = np.full(len(cells), -1, np.int64)
    for i in range(len(cells)):
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        if find_row(first[0], first[1], x, y, z) >= 0 or not _is_upright(second[0], second[1], x, y, z):
            continue
        for k in range(len(offsets)):
            dx, dy = offsets[k, 0], offsets[k, 1]
            other = find_row(first[0], first[1], x + dx, y + dy, z)
            if other < 0 or not _is_upright(first[0], first[1], x + dx, y + dy, z):
                continue
            length = np.sqrt(float(dx * dx + dy * dy))
            u, v = dx / length, dy / length
            if _is_seen_through(first_free, x, y, z, -u, -v) or _is_seen_through(second_free, x + dx, y + dy, z, u, v):
                out[i] = other
            break
    return out
