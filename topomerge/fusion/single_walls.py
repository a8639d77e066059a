"""One wall where two maps show it a little apart: the copy that a later map brings becomes that wall (method 4).

Maps that were bent onto each other still differ by a cell or two. A wall and its copy are told from the faces of a thick wall,
each of which only one map saw, by what the maps saw through: a map cannot see through a wall.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from topomerge.kernels import copies as kernel
from topomerge.kernels.lookup import build
from topomerge.types import Array

COPY_REACH = 0.25  # m between a wall and its copy, at most
AROUND = 8  # cells about the walls, of which free ones are asked for
Seen = tuple[Array, Array]


def copies(first: Seen, second: Seen, edge: float) -> Array:
    """(n,) int64 row of the cell of the first map's wall of which each cell of the second map is a copy, -1 none.

    Args:
        first, second: cells (n, 3) of one lattice that a map shows, and the free cells (m, 3), twice as long, of the lattice on
            the same corner.
        edge: m, of a cell.
    """
    reach = int(COPY_REACH / edge + 1e-6)
    flat = range(-reach, reach + 1)
    beside = [(x, y) for x, y in product(flat, flat) if 0 < np.hypot(x, y) * edge <= COPY_REACH + 1e-6]
    if not beside:
        return np.full(len(second[0]), -1, np.int64)
    offsets = np.array(sorted(beside, key=lambda o: (o[0] ** 2 + o[1] ** 2, o)), np.int64)
    low = 2 * ((np.minimum(first[0].min(axis=0), second[0].min(axis=0)) - AROUND) // 2)
    high = np.maximum(first[0].max(axis=0), second[0].max(axis=0)) + AROUND + 1 - low
    tables = [_table(cells - low, high) for cells in (first[0], second[0])]
    tables += [_table(cells - low // 2, high // 2 + 1) for cells in (first[1], second[1])]
    return kernel.copied(np.ascontiguousarray(second[0] - low), offsets, *tables)


def _table(cells: Array, size: Array) -> tuple[Array, Array]:
    """`kernels.lookup` of those cells that lie in a volume of so many cells."""
    inside = ((cells >= 0) & (cells < size)).all(axis=1)
    x, y, z = size.tolist()
    return build(np.ascontiguousarray(cells[inside]), (x, y, z))
