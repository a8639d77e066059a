"""Rooms paired one to one, or left alone; and a second pass for rooms that are cut in two in the other map."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from topomerge.types import Array


def assign(cost: Array, largest: float = np.inf) -> Array:
    """(M, 2) pairs of the one-to-one assignment of least total cost (Jonker-Volgenant; seeds 3.3), ascending.

    Args:
        cost: (n, m).
        largest: cost of a pair above which both rather stay alone: each row and column can go to a dustbin for half of it. A row
            that is dearer than this to all columns changes nothing for the others.
    """
    n, m = cost.shape
    if not n or not m:
        return np.zeros((0, 2), np.int64)
    if np.isinf(largest):
        i, j = linear_sum_assignment(cost)
        return np.stack([i, j], axis=1).astype(np.int64)
    wide = np.full((n + m, n + m), 0.0)
    wide[:n, :m] = np.minimum(cost, 2 * abs(largest) + 1)
    wide[:n, m:] = wide[n:, :m] = 2 * abs(largest) + 1  # another's dustbin
    wide[np.arange(n), m + np.arange(n)] = largest / 2
    wide[n + np.arange(m), np.arange(m)] = largest / 2
    i, j = linear_sum_assignment(wide)
    paired = (i < n) & (j < m)
    i, j = i[paired], j[paired]
    good = cost[i, j] <= largest
    return np.stack([i[good], j[good]], axis=1).astype(np.int64)


def by_overlap(common: Array, area_a: Array, area_b: Array, least: float = 0.15, inside: float = 0.5) -> tuple[Array, Array]:
    """Pairs of rooms that share floor under a transform: one to one first, then pieces.

    Args:
        common: (R_a, R_b) m2 of floor that a room of a shares with one of b.
        area_a, area_b: m2 of floor of each.
        least: IoU of a pair.
        inside: share of a room that is left over which must lie in a room of the other map to be a piece of it.

    Returns:
        (M, 2) pairs, ascending; (M,) IoU of each, of a piece the share that lies inside.
    """
    iou = common / np.maximum(area_a[:, None] + area_b[None] - common, 1e-9)
    pairs = assign(1 - iou, 1 - least)
    fit = {(i, j): float(iou[i, j]) for i, j in pairs.tolist()}
    for axis, area in ((0, area_a), (1, area_b)):
        share = common / np.maximum(area[:, None] if axis == 0 else area[None], 1e-9)
        for left in np.setdiff1d(np.arange(len(area)), pairs[:, axis]):
            row = share[left] if axis == 0 else share[:, left]
            if row.size and row.max() >= inside:
                k = int(row.argmax())
                fit[(int(left), k) if axis == 0 else (k, int(left))] = float(min(row.max(), 1.0))
    keys = sorted(fit)
    return np.array(keys, np.int64).reshape(-1, 2), np.array([fit[k] for k in keys])
