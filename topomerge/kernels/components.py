"""Connected components of cells and labels spread from cell to cell, over the brick lookup."""

from __future__ import annotations

import numpy as np
from numba import njit

from topomerge.kernels.lookup import row


@njit(cache=True)
def _root(parent, i):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True)
def components(cells, table, bricks, offsets, group):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(n,) component of each cell, numbered by first cell. Neighbours are `offsets` (k, 3), which must hold one of each pair of
    opposite directions; only cells of the same `group` are joined, cells of a negative group are left out (-1)."""
    n = len(cells)
    parent = np.arange(n)
    for i in range(n):
        if group[i] < 0:
            continue
        for k in range(len(offsets)):
            j = row(table, bricks, cells[i, 0] + offsets[k, 0], cells[i, 1] + offsets[k, 1], cells[i, 2] + offsets[k, 2])
            if j >= 0 and group[j] == group[i]:
                a, b = _root(parent, i), _root(parent, j)
                if a < b:
                    parent[b] = a
                else:
                    parent[a] = b
    labels = np.full(n, -1, np.int64)
    count = 0
    for i in range(n):
        if group[i] < 0:
            continue
        r = _root(parent, i)  # the smallest row of its component, so it has been numbered already
        if r == i:
            labels[i] = count
            count += 1
        else:
            labels[i] = labels[r]
    return labels


@njit(cache=True)
def spread(cells, table, bricks, offsets, labels, limit):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Labels carried breadth first from labelled cells to unlabelled (-1) neighbours, at most `limit` steps; in place."""
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
                j = row(table, bricks, cells[i, 0] + offsets[k, 0], cells[i, 1] + offsets[k, 1], cells[i, 2] + offsets[k, 2])
                if j >= 0 and labels[j] < 0:
                    labels[j] = labels[i]
                    queue[tail] = j
                    tail += 1
