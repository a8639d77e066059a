"""Watershed of a clearance map: every cell flows to the peak that it can reach without descending."""

from __future__ import annotations

import numpy as np
from numba import njit

from topomerge.kernels.components import _root


@njit(cache=True)
def watershed(clearance, order, prominence):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(nx, ny) int64 label of each cell with clearance above 0, numbered in the order of the peaks, -1 elsewhere.

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
                    best, widest = _root(parent, label[u, v]), clearance[u, v]
        if best < 0:
            label[x, y], parent[count], peak[count] = count, count, value
            count += 1
            continue
        label[x, y] = best
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                u, v = x + dx, y + dy
                if 0 <= u < nx and 0 <= v < ny and label[u, v] >= 0:
                    a, b = _root(parent, label[x, y]), _root(parent, label[u, v])
                    if a != b and min(peak[a], peak[b]) - value < prominence:
                        if peak[a] < peak[b]:
                            a, b = b, a
                        parent[b] = a
    number = np.full(count, -1, np.int64)
    used = 0
    for i in range(count):
        root = _root(parent, i)
        if number[root] < 0:
            number[root] = used
            used += 1
        number[i] = number[root]
    for x in range(nx):
        for y in range(ny):
            if label[x, y] >= 0:
                label[x, y] = number[label[x, y]]
    return label


@njit(cache=True)
def contacts(label, clearance):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(k, 3) int64 pairs of neighbouring cells of different labels: the two labels, ascending, and the flat index of the
    narrower cell."""
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
