"""How well pieces of one plan lie on another one, over a grid of small moves of each."""

from __future__ import annotations

import numpy as np

from topomerge.kernels import compile_ahead


@compile_ahead("f8[:,::1], i8[::1], i8[::1], f8[:,::1], f8[::1], f8[::1], f8[::1], f4[:,:,::1], f8[::1], f8", error_model="numpy")
def score_moves(points, sector, start, places, turns, yaws, shifts, gain, origin, edge):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return (K, Y, S, S) sums of the gain at the points of each piece under each turn and shift.

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


@compile_ahead("f8[:,::1], f8[::1], i8[::1], i8, f8[:,::1], f4[:,::1], f8[::1], f8", error_model="numpy")
def sum_shifted_values(points, weights, owner, owners, shifts, values, origin, edge):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return (S, owners) sums of the values of a raster (nx, ny) at weighted points (n, 2) of each owner, moved by each shift (S,
    2)."""
    out = np.zeros((len(shifts), owners))
    for k in range(len(shifts)):
        for p in range(len(points)):
            u = int(np.floor((points[p, 0] + shifts[k, 0] - origin[0]) / edge))
            v = int(np.floor((points[p, 1] + shifts[k, 1] - origin[1]) / edge))
            if u >= 0 and v >= 0 and u < values.shape[0] and v < values.shape[1]:
                out[k, owner[p]] += values[u, v] * weights[p]
    return out


@compile_ahead("i4[:,::1], f8[:,::1], i8[:,::1], i8, i8", error_model="numpy")
def estimate_line_normals(row, points, columns, reach, least):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return (n, 2) unit normals of the lines through the points within `reach` columns of each one, and (n,) how straight these
    are (0 to 1); 0 where fewer than `least` points are near.

    Args:
        row: (nx, ny) int32 row of the point in each column, -1 none.
        points: (n, 2) m; columns (n, 2) int, where they are.
    """
    out, straight = np.zeros((len(points), 2)), np.zeros(len(points))
    for k in range(len(points)):
        n, mx, my, xx, xy, yy = 0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(max(columns[k, 0] - reach, 0), min(columns[k, 0] + reach + 1, row.shape[0])):
            for j in range(max(columns[k, 1] - reach, 0), min(columns[k, 1] + reach + 1, row.shape[1])):
                r = row[i, j]
                if r >= 0:
                    dx, dy = points[r, 0] - points[k, 0], points[r, 1] - points[k, 1]
                    n += 1
                    mx, my = mx + dx, my + dy
                    xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
        if n < least:
            continue
        xx, xy, yy = xx / n - mx * mx / (n * n), xy / n - mx * my / (n * n), yy / n - my * my / (n * n)
        mean, half = (xx + yy) / 2, np.sqrt((xx - yy) ** 2 / 4 + xy * xy)
        if half <= 0 or mean + half <= 1e-12:
            continue
        angle = np.arctan2(2 * xy, xx - yy) / 2  # along the line
        out[k, 0], out[k, 1] = -np.sin(angle), np.cos(angle)
        straight[k] = 1.0 - max(mean - half, 0.0) / (mean + half)
    return out, straight


@compile_ahead(
    "f8[:,::1], f8[:,::1], b1[::1], i8[::1], f8[:,::1], f8[::1], i4[:,::1], f8[:,::1], f8[:,::1], b1[::1], f8[::1], f8, i8, f8",
    error_model="numpy",
)
def build_line_equations(
    points, normal, faced, start, places, turns, row, target, target_normal, target_faced, origin, edge, reach, sigma
):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Build the normal equations of a shift and a turn of each piece: each of its points and the nearest one of the target whose
    normal is alike, within `reach` columns; two sides of a wall are not alike.

    Args:
        points: (n, 2) m about the anchor of their piece; normal (n, 2), towards empty space where `faced` (n,).
        start: (K + 1,) first point of each piece; places (K, 2) m, where anchors are; turns (K,) rad.
        row: (nx, ny) int32 row of the target's point in each column, -1 none; target (m, 2), its normals, and are they faced?
        sigma: m, of the robust weights (Geman-McClure).

    Returns:
        H (K, 3, 3), g (K, 3), partners (K,), sums of weights and of weighted squared distances (K, 2).
    """
    many = len(places)
    h, g, partners, sums = np.zeros((many, 3, 3)), np.zeros((many, 3)), np.zeros(many, np.int64), np.zeros((many, 2))
    jac = np.zeros(3)
    for k in range(many):
        c, s = np.cos(turns[k]), np.sin(turns[k])
        for p in range(start[k], start[k + 1]):
            dx, dy = c * points[p, 0] - s * points[p, 1], s * points[p, 0] + c * points[p, 1]
            nx, ny = c * normal[p, 0] - s * normal[p, 1], s * normal[p, 0] + c * normal[p, 1]
            x, y = places[k, 0] + dx, places[k, 1] + dy
            i0, j0 = int(np.floor((x - origin[0]) / edge)), int(np.floor((y - origin[1]) / edge))
            best, near, sign = -1, (reach * edge) ** 2, 1.0
            for i in range(max(i0 - reach, 0), min(i0 + reach + 1, row.shape[0])):
                for j in range(max(j0 - reach, 0), min(j0 + reach + 1, row.shape[1])):
                    r = row[i, j]
                    if r < 0:
                        continue
                    dot = nx * target_normal[r, 0] + ny * target_normal[r, 1]
                    if abs(dot) < 0.8 or (dot < 0 and faced[p] and target_faced[r]):
                        continue
                    far = (target[r, 0] - x) ** 2 + (target[r, 1] - y) ** 2
                    if far < near:
                        best, near, sign = r, far, 1.0 if dot > 0 else -1.0
            if best < 0:
                continue
            ux, uy = sign * nx + target_normal[best, 0], sign * ny + target_normal[best, 1]  # of both: neither map is the truth
            length = np.sqrt(ux * ux + uy * uy)
            ux, uy = ux / length, uy / length
            d = ux * (x - target[best, 0]) + uy * (y - target[best, 1])
            w = 1.0 / (1.0 + (d / sigma) ** 2) ** 2
            jac[0], jac[1], jac[2] = ux, uy, uy * dx - ux * dy
            for u in range(3):
                g[k, u] += w * d * jac[u]
                for v in range(3):
                    h[k, u, v] += w * jac[u] * jac[v]
            partners[k] += 1
            sums[k, 0] += w
            sums[k, 1] += w * d * d
    return h, g, partners, sums


@compile_ahead("f8[:,::1], f8[::1], f8, f8[:,:,::1]", error_model="numpy")
def interpolate_nodes(points, origin, step, nodes):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return (n, 2) bilinear values at points (n, 2) of those at the nodes (nx, ny, 2) of a lattice; outside the value at its
    rim.

    Args:
        origin: (2,) m, node (0, 0); step: m between nodes.
    """
    out = np.empty((len(points), 2))
    wide, deep = nodes.shape[0] - 1, nodes.shape[1] - 1
    for k in range(len(points)):
        x = min(max((points[k, 0] - origin[0]) / step, 0.0), float(wide))
        y = min(max((points[k, 1] - origin[1]) / step, 0.0), float(deep))
        i, j = min(int(x), wide - 1), min(int(y), deep - 1)
        u, v = x - i, y - j
        for c in range(2):
            low = (1 - u) * nodes[i, j, c] + u * nodes[i + 1, j, c]
            high = (1 - u) * nodes[i, j + 1, c] + u * nodes[i + 1, j + 1, c]
            out[k, c] = (1 - v) * low + v * high
    return out


@compile_ahead("u1[:,:,::1], f4[::1], f4[:,::1], b1[:,::1]", error_model="numpy")
def compute_wall_gain(level, table, lost, seen):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return (Q, nx, ny) float32: the entry of a table (256,) at each level (Q, nx, ny) uint8, less what is lost there (nx, ny)
    float32; 0 where nothing was seen (nx, ny) and the entry is not above 0."""
    out = np.zeros(level.shape, np.float32)
    for q in range(level.shape[0]):
        for i in range(level.shape[1]):
            for j in range(level.shape[2]):
                gain = table[level[q, i, j]]
                if seen[i, j] or gain > 0:
                    out[q, i, j] = gain - lost[i, j]
    return out


@compile_ahead("f8[:,::1], f8[:,::1], i8[:,::1], f8[:,::1], f8[:,::1], f8", error_model="numpy")
def blend_moves(points, distance, nearest, anchors, moves, reach):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return (n, 2) m: shifts of points (n, 2) by the moves (k, 4) of pieces about their anchors (k, 2).

    Args:
        distance, nearest: (n, q) m to the nearest pieces, ascending, and which these are.
        reach: m, standard deviation of the weights.
    """
    out = np.zeros((len(points), 2))
    c, s = np.exp(moves[:, 3]) * np.cos(moves[:, 2]) - 1.0, np.exp(moves[:, 3]) * np.sin(moves[:, 2])
    for p in range(len(points)):
        total, x, y = 0.0, 0.0, 0.0
        for q in range(nearest.shape[1]):
            k = nearest[p, q]
            weight = np.exp((distance[p, 0] ** 2 - distance[p, q] ** 2) / (2 * reach**2))
            dx, dy = points[p, 0] - anchors[k, 0], points[p, 1] - anchors[k, 1]
            total += weight
            x += weight * (moves[k, 0] + c[k] * dx - s[k] * dy)
            y += weight * (moves[k, 1] + s[k] * dx + c[k] * dy)
        out[p, 0], out[p, 1] = x / total, y / total
    return out
