"""Compiled loops over rasters of a storey: columns, components, growing, watershed, lines."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from topomerge.kernels import compile_ahead, run_in_slices
from topomerge.kernels.voxels import find_row

LEAST_CELLS = 1 << 13  # of a slice
Ints = NDArray[Any]


@compile_ahead("i8[::1], i8")
def _find_root(parent, i):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@compile_ahead("i4[:,::1], i4[:,:,::1], i4[:,::1], i8[:,::1], i8[::1]")
def label_components(cells, table, bricks, offsets, group):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the (n,) component of each cell, numbered by first cell. Neighbours are `offsets` (k, 3), which must hold one of
    each pair of opposite directions; only cells of the same `group` are joined, cells of a negative group are left out (-1)."""
    n = len(cells)
    parent = np.arange(n)
    for i in range(n):
        if group[i] < 0:
            continue
        for k in range(len(offsets)):
            j = find_row(table, bricks, cells[i, 0] + offsets[k, 0], cells[i, 1] + offsets[k, 1], cells[i, 2] + offsets[k, 2])
            if j >= 0 and group[j] == group[i]:
                a, b = _find_root(parent, i), _find_root(parent, j)
                if a < b:
                    parent[b] = a
                else:
                    parent[a] = b
    labels = np.full(n, -1, np.int64)
    count = 0
    for i in range(n):
        if group[i] < 0:
            continue
        r = _find_root(parent, i)  # the smallest row of its component, so it has been numbered already
        if r == i:
            labels[i] = count
            count += 1
        else:
            labels[i] = labels[r]
    return labels


@compile_ahead("i4[:,::1], i4[:,:,::1], i4[:,::1], i8[:,::1], i8[::1], i8")
def spread(cells, table, bricks, offsets, labels, limit):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Carry labels breadth first from labelled cells to unlabelled (-1) neighbours, at most `limit` steps; in place."""
    n = len(cells)
    queue = np.empty(n, np.int64)
    tail = 0
    for i in range(n):
        if labels[i] >= 0:
            queue[tail] = i
            tail += 1
    head = 0
    for _ in range(limit):
        if head == tail:
            break
        end = tail
        while head < end:
            i = queue[head]
            head += 1
            for k in range(len(offsets)):
                j = find_row(table, bricks, cells[i, 0] + offsets[k, 0], cells[i, 1] + offsets[k, 1], cells[i, 2] + offsets[k, 2])
                if j >= 0 and labels[j] < 0:
                    labels[j] = labels[i]
                    queue[tail] = j
                    tail += 1


@compile_ahead("f8[:,::1], i8[::1], f8")
def compute_watershed(clearance, order, prominence):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the (nx, ny) int64 label of each cell with clearance above 0, numbered in the order of the peaks, -1 elsewhere.

    Cells are flooded from the widest place down. Where two basins meet they are one if the lower peak rises less than
    `prominence` above the pass.

    Args:
        clearance: (nx, ny) float64.
        order: flat indices of the cells with clearance above 0, widest first.
    """
    nx, ny = clearance.shape
    label = np.full((nx, ny), -1, np.int64)
    parent = np.empty(len(order), np.int64)
    peak = np.empty(len(order))
    count = 0
    for k in range(len(order)):
        x, y = order[k] // ny, order[k] % ny
        value = clearance[x, y]
        best, widest = -1, -1.0
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                u, v = x + dx, y + dy
                if 0 <= u < nx and 0 <= v < ny and label[u, v] >= 0 and clearance[u, v] > widest:
                    best, widest = _find_root(parent, label[u, v]), clearance[u, v]
        if best < 0:
            label[x, y], parent[count], peak[count] = count, count, value
            count += 1
            continue
        label[x, y] = best
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                u, v = x + dx, y + dy
                if 0 <= u < nx and 0 <= v < ny and label[u, v] >= 0:
                    a, b = _find_root(parent, label[x, y]), _find_root(parent, label[u, v])
                    if a != b and min(peak[a], peak[b]) - value < prominence:
                        if peak[a] < peak[b]:
                            a, b = b, a
                        parent[b] = a
    number = np.full(count, -1, np.int64)
    used = 0
    for i in range(count):
        root = _find_root(parent, i)
        if number[root] < 0:
            number[root] = used
            used += 1
        number[i] = number[root]
    for x in range(nx):
        for y in range(ny):
            if label[x, y] >= 0:
                label[x, y] = number[label[x, y]]
    return label


@compile_ahead("i8[:,::1], f8[:,::1]")
def find_contacts(label, clearance):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the (k, 3) int64 pairs of neighbouring cells of different labels: the two labels, ascending, and the flat index of
    the narrower cell."""
    nx, ny = label.shape
    pairs = []
    for x in range(nx):
        for y in range(ny):
            a = label[x, y]
            if a < 0:
                continue
            for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
                u, v = x + dx, y + dy
                if 0 <= u < nx and 0 <= v < ny and label[u, v] >= 0 and label[u, v] != a:
                    b = label[u, v]
                    place = x * ny + y if clearance[x, y] <= clearance[u, v] else u * ny + v
                    pairs.append((min(a, b), max(a, b), place))
    out = np.empty((len(pairs), 3), np.int64)
    for i in range(len(pairs)):
        out[i, 0], out[i, 1], out[i, 2] = pairs[i]
    return out


@compile_ahead("b1[:,::1], b1[:,::1]")
def count_steps(start, way):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the (nx, ny) int64 fewest steps, of 8 neighbours and through pixels of `way` only, from a pixel of `start` to each;
    -1 none.

    Args:
        start, way: (nx, ny) bool.
    """
    nx, ny = start.shape
    steps = np.full((nx, ny), -1, np.int64)
    queue = np.empty(nx * ny, np.int64)
    tail = 0
    for x in range(nx):
        for y in range(ny):
            if start[x, y]:
                steps[x, y] = 0
                queue[tail] = x * ny + y
                tail += 1
    head = 0
    while head < tail:
        x, y = queue[head] // ny, queue[head] % ny
        head += 1
        for u in range(max(x - 1, 0), min(x + 2, nx)):
            for v in range(max(y - 1, 0), min(y + 2, ny)):
                if way[u, v] and steps[u, v] < 0:
                    steps[u, v] = steps[x, y] + 1
                    queue[tail] = u * ny + v
                    tail += 1
    return steps


@compile_ahead("i8[::1], i8[::1], f8[::1], f8[:,::1], f8, f8")
def compute_column_bits(ix, iy, z, base, low, band):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return (H, W) uint32: bit k is set where a cell lies between low + k * band and low + (k + 1) * band above `base` (H,
    W)."""
    out = np.zeros(base.shape, np.uint32)
    for i in range(len(z)):
        x, y = ix[i], iy[i]
        if np.isnan(z[i]) or x < 0 or y < 0 or x >= base.shape[0] or y >= base.shape[1]:
            continue
        k = int(np.floor((z[i] - base[x, y] - low) / band))
        if 0 <= k < 32:
            out[x, y] |= np.uint32(1) << np.uint32(k)
    return out


@njit(cache=True, nogil=True)
def find_line_columns(mask, cosines, sines, long, least, beside):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return (H, W) bool: the columns of a mask in, or at an end of, a straight run of `long` columns of which `least` are in it,
    with a parallel run, `beside` columns away to the left or to the right, of which a fifth at most is in it."""
    out = np.zeros(mask.shape, np.bool_)
    height, width = mask.shape
    for x in range(height):
        for y in range(width):
            if not mask[x, y]:
                continue
            for k in range(len(cosines)):
                ahead, behind, near = 0, 0, 0  # hits over the whole length ahead, behind, and over half of it both ways
                for d in range(1, long):
                    u, v = x + int(np.rint(d * cosines[k])), y + int(np.rint(d * sines[k]))
                    if u >= 0 and v >= 0 and u < height and v < width and mask[u, v]:
                        ahead += 1
                        near += d <= long // 2
                    u, v = x - int(np.rint(d * cosines[k])), y - int(np.rint(d * sines[k]))
                    if u >= 0 and v >= 0 and u < height and v < width and mask[u, v]:
                        behind += 1
                        near += d <= long // 2
                if 1 + max(ahead, behind, near) < least:
                    continue
                first, last = -(long // 2), long // 2 + 1
                if 1 + ahead >= least:
                    first, last = 0, long
                elif 1 + behind >= least:
                    first, last = 1 - long, 1
                for side in (-beside, beside):
                    hits = 0
                    for d in range(first, last):
                        u = x + int(np.rint(d * cosines[k] - side * sines[k]))
                        v = y + int(np.rint(d * sines[k] + side * cosines[k]))
                        hits += u >= 0 and v >= 0 and u < height and v < width and mask[u, v]
                    if 5 * hits <= last - first:
                        out[x, y] = True
                if out[x, y]:
                    break
    return out


PROFILE_LEVELS = 64
PROFILE_BELOW = 4  # levels below the floor that a profile begins with


@compile_ahead("i4[:,::1], i8[::1], i8[:,::1], i8[:,::1], u8[:,::1]")
def fill_profiles(cells, low, base, top, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Set in `out` (nx, ny) uint64 bit b where cell (x, y, base - PROFILE_BELOW + b) is occupied, up to the level `top`.

    `low` (2,) is the column of out[0, 0]; a `base` below -PROFILE_BELOW means that the column has no floor.
    """
    nx, ny = base.shape
    for i in range(len(cells)):
        x, y = cells[i, 0] - low[0], cells[i, 1] - low[1]
        if 0 <= x < nx and 0 <= y < ny and base[x, y] >= -PROFILE_BELOW and cells[i, 2] <= top[x, y]:
            b = cells[i, 2] - base[x, y] + PROFILE_BELOW
            if 0 <= b < PROFILE_LEVELS:
                out[x, y] |= np.uint64(1) << np.uint64(b)


@compile_ahead("u8[::1], i8")
def find_lowest_bit(profile, begin):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the (n,) first set bit of each profile from bit `begin` on; -1: none."""
    out = np.full(len(profile), -1, np.int64)
    for i in range(len(profile)):
        word = profile[i]
        for b in range(begin, PROFILE_LEVELS):
            if (word >> np.uint64(b)) & np.uint64(1):
                out[i] = b
                break
    return out


@compile_ahead("i8, i8, i4[:,:,::1], i4[:,::1], i8[:,::1], i8, i8, i8, i8[::1]")
def _find_first_occupied(first, last, table, bricks, cells, start, step, limit, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(first, last):
        for d in range(start, limit + 1):
            if find_row(table, bricks, cells[i, 0], cells[i, 1], cells[i, 2] + step * d) >= 0:
                out[i] = d
                break


def find_first_occupied(table: Ints, bricks: Ints, cells: Ints, start: int, step: int, limit: int) -> Ints:
    """Return the (m,) number of cells from each cell to the first occupied one above (`step` 1) or below (-1) it, beginning
    `start` cells away; 0 where there is none within `limit` cells."""
    out = np.zeros(len(cells), np.int64)
    run_in_slices(_find_first_occupied, len(cells), LEAST_CELLS, table, bricks, cells, start, step, limit, out)
    return out


@compile_ahead("i4[:,:,::1], i4[:,::1], i8, i8, i8, i8")
def _is_any_near(table, bricks, x, y, z, reach):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    for dx in range(-reach, reach + 1):
        for dy in range(-reach, reach + 1):
            if find_row(table, bricks, x + dx, y + dy, z) >= 0:
                return True
    return False


@compile_ahead("i8, i8, i4[:,:,::1], i4[:,::1], i8[:,::1], i8, i8, i8, i8, b1[::1]")
def _is_hollow_below(first, last, table, bricks, cells, reach, thickness, headroom, limit, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(first, last):
        empty = 0
        for d in range(1, limit + 1):
            if _is_any_near(table, bricks, cells[i, 0], cells[i, 1], cells[i, 2] - d, reach):
                if empty >= headroom:
                    out[i] = True
                    break
                empty = 0
            else:
                if empty == 0 and d > thickness + 1:
                    break
                empty += 1


def is_hollow_below(
    table: Ints, bricks: Ints, cells: Ints, reach: int, thickness: int, headroom: int, limit: int
) -> NDArray[np.bool_]:
    """Return (m,) bool: whether a run of at least `headroom` empty cells begins within `thickness` cells below each cell, and
    ends at an occupied one within `limit` cells. A level is occupied if any cell within `reach` columns is: sparse points leave
    gaps."""
    out = np.zeros(len(cells), np.bool_)
    run_in_slices(_is_hollow_below, len(cells), LEAST_CELLS, table, bricks, cells, reach, thickness, headroom, limit, out)
    return out


@compile_ahead("i8, i8, i4[:,:,::1], i4[:,::1], i8[:,::1], i8, i8, i8[::1]")
def _count_levels_below(first, last, table, bricks, cells, reach, depth, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(first, last):
        for d in range(1, depth + 1):
            out[i] += _is_any_near(table, bricks, cells[i, 0], cells[i, 1], cells[i, 2] - d, reach)


def count_levels_below(table: Ints, bricks: Ints, cells: Ints, reach: int, depth: int) -> Ints:
    """Return (m,) how many of the `depth` levels below each cell are occupied within `reach` columns."""
    out = np.zeros(len(cells), np.int64)
    run_in_slices(_count_levels_below, len(cells), LEAST_CELLS, table, bricks, cells, reach, depth, out)
    return out


@compile_ahead("f8[:,::1], f8[::1], f8[::1], f8")
def find_strongest_line(points, weights, angles, width):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the direction (rad) and the offset across it (m) of the line with most weight in two neighbouring bins; the first of
    several.

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


@compile_ahead("f8[:,::1], f8[::1], f8[::1], f8[::1]")
def weigh_by_distance(points, weights, along, scales):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return (n,) weights of points, those far from the line through most of them counting less (Cauchy).

    Args:
        points: (n, 2) m.
        weights: (n,).
        along: (2,) direction of the line; zeros: that of least squares.
        scales: (k,) m, of each round: what is as far off counts half in the next one.
    """
    weight = weights.copy()
    for scale in scales:
        total, x, y = 0.0, 0.0, 0.0
        for i in range(len(points)):
            total += weight[i]
            x += weight[i] * points[i, 0]
            y += weight[i] * points[i, 1]
        x, y = x / total, y / total
        c, s = along[0], along[1]
        if c == 0.0 and s == 0.0:
            xx, xy, yy = 0.0, 0.0, 0.0
            for i in range(len(points)):
                u, v = points[i, 0] - x, points[i, 1] - y
                xx += weight[i] * u * u
                xy += weight[i] * u * v
                yy += weight[i] * v * v
            angle = 0.5 * np.arctan2(2 * xy, xx - yy)
            c, s = np.cos(angle), np.sin(angle)
        for i in range(len(points)):
            off = (points[i, 1] - y) * c - (points[i, 0] - x) * s
            weight[i] = weights[i] / (1 + (off / scale) ** 2)
    return weight
