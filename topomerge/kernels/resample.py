"""Cells of a lattice whose middles lie in the cells of a grid that was moved, perhaps bent."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def filled(cells, holding, matrix, local, slack, reach, tall):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(m, 3) int64 cells of the lattice of which the middle lies in a cell of the grid, and (m,) int64 in which one.

    A bent grid is taken as linear in each of its cells: what is bent to p is at middle + J (p - bent) - lean (height of p over
    the middle).

    Args:
        cells: (n, 3) of the grid.
        holding: (n, 3) int64 cells of the lattice in which their middles are laid.
        matrix: (3, 4) places of the lattice in those of the bent grid, both in cells; upright.
        local: (n, 8) of each cell: where its middle is bent to (2, in cells), J (4, row by row) and lean (2); (0, 8): rigid.
        slack: of a cell, by which a place may lie beside it.
        reach, tall: lattice cells around the holding one that are tried, in the plane and up and down.
    """
    most = 2 * len(cells) + 64
    out, rows = np.empty((most, 3), np.int64), np.empty(most, np.int64)
    count = 0
    for i in range(len(cells)):
        for w in range(-tall, tall + 1):
            q = holding[i, 2] + w
            z = matrix[2, 2] * (q + 0.5) + matrix[2, 3]
            if np.floor(z) != cells[i, 2]:
                continue
            up = z - (cells[i, 2] + 0.5)
            for u in range(holding[i, 0] - reach, holding[i, 0] + reach + 1):
                for v in range(holding[i, 1] - reach, holding[i, 1] + reach + 1):
                    x = matrix[0, 0] * (u + 0.5) + matrix[0, 1] * (v + 0.5) + matrix[0, 3] - cells[i, 0]
                    y = matrix[1, 0] * (u + 0.5) + matrix[1, 1] * (v + 0.5) + matrix[1, 3] - cells[i, 1]
                    if len(local):
                        dx, dy = x + cells[i, 0] - local[i, 0], y + cells[i, 1] - local[i, 1]
                        x = 0.5 + local[i, 2] * dx + local[i, 3] * dy - local[i, 6] * up
                        y = 0.5 + local[i, 4] * dx + local[i, 5] * dy - local[i, 7] * up
                    if not (-slack <= x < 1 + slack and -slack <= y < 1 + slack):
                        continue
                    if count == most:
                        most *= 2
                        wider, longer = np.empty((most, 3), np.int64), np.empty(most, np.int64)
                        for k in range(count):
                            longer[k] = rows[k]
                            for a in range(3):
                                wider[k, a] = out[k, a]
                        out, rows = wider, longer
                    out[count, 0], out[count, 1], out[count, 2], rows[count] = u, v, q, i
                    count += 1
    return out[:count], rows[:count]
