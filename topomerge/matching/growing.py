"""Hypothesis growing: from one matched pair of rooms to their neighbours, while costs and geometry allow (seeds 3.3; thesis)."""

from __future__ import annotations

from collections import deque

import numpy as np

from topomerge.embedding.room_cells import neighbours
from topomerge.matching.assignment import assign
from topomerge.types import Array, Sim3, TopometricMap

Pairs = tuple[tuple[int, int], ...]


def grow(a: TopometricMap, b: TopometricMap, cost: Array, c_max: float | None = None, de_max: float = 2.5) -> list[Pairs]:
    """Hypotheses, the one with most matches first (of equal ones the cheapest); each is a set of pairs, ascending.

    Every pair of the assignment of least cost is a seed. A seed's neighbours are assigned to those of its partner; a pair is
    taken if its cost is at most `c_max` and the alignment of all matched centroids does not get worse by more than `de_max`;
    its own neighbours come next.

    Args:
        cost: (R_a, R_b).
        c_max: the thesis does not name one; the median of the costs if None.
        de_max: m.
    """
    if not cost.size:
        return []
    limit = float(np.median(cost)) if c_max is None else c_max
    beside = [[set(n.tolist()) - {i} for i, n in enumerate(neighbours(m))] for m in (a, b)]
    centroids = (a.rooms["centroid"], b.rooms["centroid"])
    hypotheses = {_grown((i, j), cost, beside, centroids, limit, de_max) for i, j in assign(cost).tolist()}
    return sorted(hypotheses, key=lambda pairs: (-len(pairs), sum(cost[p] for p in pairs), pairs))


def _grown(
    seed: tuple[int, int], cost: Array, beside: list[list[set[int]]], centroids: tuple[Array, Array], c_max: float, de_max: float
) -> Pairs:
    """One hypothesis from its seed."""
    partner = {seed[0]: seed[1]}
    error, queue = 0.0, deque([seed])
    while queue:
        i, j = queue.popleft()
        free_a = np.array(sorted(beside[0][i] - set(partner)), np.int64)
        free_b = np.array(sorted(beside[1][j] - set(partner.values())), np.int64)
        costs = cost[np.ix_(free_a, free_b)]
        pairs = assign(costs)
        for k, l in pairs[np.argsort(costs[tuple(pairs.T)], kind="stable")].tolist():
            new = (int(free_a[k]), int(free_b[l]))
            if cost[new] > c_max:
                continue
            tried = {**partner, new[0]: new[1]}
            worse = align(centroids[0][list(tried)], centroids[1][list(tried.values())])[1]
            if worse - error <= de_max:
                partner, error = tried, worse
                queue.append(new)
    return tuple(sorted(partner.items()))


def align(to: Array, points: Array, scale: bool = False, weight: Array | None = None) -> tuple[Sim3, float]:
    """The turn about the vertical and the translation (and the scale) that bring points (n, 3) onto others best, and the root
    mean square error, m. One point, or several in one place, leave the turn at 0."""
    w = np.ones(len(to)) if weight is None else weight
    w = w / w.sum()
    middle_to, middle = w @ to, w @ points
    p, q = (points - middle)[:, :2], (to - middle_to)[:, :2]
    z = (w * (p[:, 0] + 1j * p[:, 1]).conj()) @ (q[:, 0] + 1j * q[:, 1])
    yaw = float(np.angle(z)) if abs(z) > 1e-12 else 0.0
    spread = float(w @ (p**2).sum(axis=1))
    size = abs(z) / spread if scale and spread > 1e-9 and abs(z) > 1e-12 else 1.0
    turn = Sim3(yaw, (0.0, 0.0, 0.0), float(size))
    x, y, height = (middle_to - turn.apply(middle[None])[0]).tolist()
    transform = Sim3(yaw, (x, y, height), float(size))
    off = transform.apply(points) - to
    return transform, float(np.sqrt(w @ (off**2).sum(axis=1)))
