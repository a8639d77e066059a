"""The widest way between two regions of a graph of cells."""

from __future__ import annotations

import numpy as np
from numba import njit

from topomerge.kernels.components import _root
from topomerge.kernels.lookup import row


@njit(cache=True)
def saddle(cells, table, bricks, offsets, rows, first, second, parent):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Row of the narrowest cell on the widest way from cell `first` to `second` through the cells `rows`, -1 if there is none.

    `rows` must be in descending order of clearance: cells are added one by one, as in Kruskal's algorithm, until the two ends are
    joined. `parent` (n,) must hold -1 everywhere and does so again afterwards.
    """
    found = np.int64(-1)
    for i in rows:
        parent[i] = i
        for k in range(len(offsets)):
            j = row(table, bricks, cells[i, 0] + offsets[k, 0], cells[i, 1] + offsets[k, 1], cells[i, 2] + offsets[k, 2])
            if j >= 0 and parent[j] >= 0:
                a, b = _root(parent, i), _root(parent, j)
                if a != b:
                    parent[b] = a
        if parent[first] >= 0 and parent[second] >= 0 and _root(parent, first) == _root(parent, second):
            found = i
            break
    for i in rows:
        parent[i] = -1
    return found
