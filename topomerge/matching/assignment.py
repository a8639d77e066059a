"""Pair rooms one to one: costs, assignment, growing, scores (seeds 3.3)."""

from __future__ import annotations

from collections import deque

import numpy as np
from scipy.spatial.distance import cdist

from topomerge.embedding.quarter_turns import Rows, TurnedRows, compute_similarity, find_neighbours
from topomerge.types import Array, Sim3, TopometricMap


def assign(cost: Array, largest: float = np.inf) -> Array:
    """Return (M, 2) pairs of the one-to-one assignment of least total cost (Jonker-Volgenant; seeds 3.3), ascending.

    Args:
        cost: (n, m).
        largest: cost of a pair above which both rather stay alone: each row and column can go to a dustbin for half of it. A row
            that is dearer than this to all columns changes nothing for the others.
    """
    n, m = cost.shape
    if not n or not m:
        return np.zeros((0, 2), np.int64)
    from scipy.optimize import linear_sum_assignment  # here: a hundred modules, of which maps that do not fit need none

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


def match_by_overlap(
    common: Array, area_a: Array, area_b: Array, least: float = 0.15, inside: float = 0.5
) -> tuple[Array, Array]:
    """Return pairs of rooms that share floor under a transform: one to one first, then pieces.

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


def compute_descriptor_costs(a: Rows, b: Rows, standardise: bool = False) -> Array:
    """Return (R_a, R_b) Euclidean distances of the rows of a (R_a, D) and b (R_b, D), over the root of D; where rooms have a row
    for each quarter turn, as far apart as rows of length 1 of their mean cosine over turns (`embedding.quarter_turns`).

    Args:
        standardise: scale each column by its standard deviation over the rooms of both maps first. Rooms that only one map has
            then change the costs of all, so it is not for descriptors that are scaled already.
    """
    if isinstance(a, TurnedRows) and isinstance(b, TurnedRows):
        apart: Array = np.sqrt(np.maximum(2 - 2 * compute_similarity(a, b), 0.0))
        return apart / np.sqrt(max(a.rows[0].size, 1) if len(a) else 1)
    a, b = np.asarray(a), np.asarray(b)
    if standardise and len(a) + len(b):
        spread = np.concatenate([a, b]).std(axis=0)
        scale = np.where(spread > 1e-9, spread, 1.0)
        a, b = a / scale, b / scale
    out: Array = cdist(a, b) / np.sqrt(max(a.shape[1], 1))
    return out


def compute_similarities(cost: Array, temperature: float | None = None, dustbin: float | None = None) -> Array:
    """Return (R_a, R_b) 0..1 of each pair: softmax along its row times that along its column, each with the choice of no partner.

    Args:
        temperature: cost that divides likelihoods by e; a fifth of the median cost if None.
        dustbin: cost of having no partner; the median of each room's cheapest pair, times 1.5, if None.
    """
    if not cost.size:
        return np.zeros(cost.shape)
    t = temperature if temperature is not None else max(float(np.median(cost)) / 5, 1e-9)
    none = dustbin if dustbin is not None else compute_usual_best_cost(cost) * 1.5
    weight = np.exp(-np.clip(cost / t, 0, 600))
    bin_weight = np.exp(-min(none / t, 600))
    out: Array = weight / (weight.sum(axis=1, keepdims=True) + bin_weight) * weight / (weight.sum(axis=0) + bin_weight)
    return np.sqrt(out)


def compute_usual_best_cost(cost: Array) -> float:
    """Return median over rooms of both maps of their cheapest pair's cost; 0 without any."""
    return float(np.median(np.concatenate([cost.min(axis=0), cost.min(axis=1)]))) if cost.size else 0.0


def select_best_partners(cost: Array, number: int) -> Array:
    """Return (P, 2) pairs that are among the `number` cheapest of their row or of their column, ascending."""
    if not cost.size:
        return np.zeros((0, 2), np.int64)
    keep = np.zeros(cost.shape, bool)
    columns = np.argsort(cost, axis=1, kind="stable")[:, :number]
    keep[np.arange(len(cost))[:, None], columns] = True
    rows = np.argsort(cost, axis=0, kind="stable")[:number]
    keep[rows, np.arange(cost.shape[1])[None]] = True
    return np.argwhere(keep)


Pairs = tuple[tuple[int, int], ...]


def grow(a: TopometricMap, b: TopometricMap, cost: Array, c_max: float | None = None, de_max: float = 2.5) -> list[Pairs]:
    """Grow hypotheses, the one with most matches first (of equal ones the cheapest); each is a set of pairs, ascending.

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
    neighbours = [[set(n.tolist()) - {i} for i, n in enumerate(find_neighbours(m))] for m in (a, b)]
    centroids = (a.rooms["centroid"], b.rooms["centroid"])
    hypotheses = {_grow_from_seed((i, j), cost, neighbours, centroids, limit, de_max) for i, j in assign(cost).tolist()}
    return sorted(hypotheses, key=lambda pairs: (-len(pairs), sum(cost[p] for p in pairs), pairs))


def _grow_from_seed(
    seed: tuple[int, int],
    cost: Array,
    neighbours: list[list[set[int]]],
    centroids: tuple[Array, Array],
    c_max: float,
    de_max: float,
) -> Pairs:
    """Grow one hypothesis from its seed."""
    partner = {seed[0]: seed[1]}
    error, queue = 0.0, deque([seed])
    while queue:
        i, j = queue.popleft()
        free_a = np.array(sorted(neighbours[0][i] - set(partner)), np.int64)
        free_b = np.array(sorted(neighbours[1][j] - set(partner.values())), np.int64)
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
    """Return the turn about the vertical and the translation (and the scale) that bring points (n, 3) onto others best, and the
    root mean square error, m. One point, or several in one place, leave the turn at 0."""
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


TWIN_SIZE = 0.15  # rooms whose area, length and width differ by no more than this share are near-identical


def rank_partners(similarity: Array, matches: Array) -> tuple[Array, Array]:
    """Return, for each room of a that has a partner, which one it is, and the rank, from 1, of its best partner among all rooms
    of b.

    Ties count half of those that are as similar, so that a constant is as good as chance.

    Args:
        similarity: (R_a, R_b), larger is more alike.
        matches: (M, 2) rooms that are one true room; a room may have several partners.

    Returns:
        (n,) int64 rooms of a, ascending; (n,) float64 ranks.
    """
    rooms = np.unique(matches[:, 0]).astype(np.int64)
    ranks = np.zeros(len(rooms))
    for k, i in enumerate(rooms):
        partners = matches[matches[:, 0] == i, 1]
        best = similarity[i, partners].max()
        others = np.delete(similarity[i], partners)
        ranks[k] = 1 + (others > best).sum() + (others == best).sum() / 2
    return rooms, ranks


def has_twin(sizes: Array, matches: Array, rooms: Array) -> Array:
    """Return (n,) bool: is there another room in b that is nearly the same as the partner of a room of a?

    Args:
        sizes: (R_b, 3) area (m2), length and width (m) of the rooms of b: columns 0, 3 and 4 of a graph's `x`.
        matches: (M, 2).
        rooms: (n,) of a, each with a partner.
    """
    out = np.zeros(len(rooms), bool)
    logs = np.log(np.maximum(np.asarray(sizes, float), 1e-3))
    alike = (np.abs(logs[:, None] - logs[None]) <= np.log1p(TWIN_SIZE)).all(axis=2)
    for k, i in enumerate(rooms):
        partners = matches[matches[:, 0] == i, 1]
        others = np.ones(len(sizes), bool)
        others[partners] = False
        out[k] = alike[partners][:, others].any()
    return out


def compute_certainty(rows: Array, columns: Array) -> Array:
    """Return (R_a, R_b) geometric mean of the probabilities that j is i's partner and i is j's.

    Args:
        rows: (R_a, R_b + 1) probabilities of the partner of each room of a; the last: none.
        columns: (R_b, R_a + 1) likewise.
    """
    out: Array = np.sqrt(rows[:, :-1] * columns[:, :-1].T)
    return out


def assign_certain(certain: Array, least: float) -> Array:
    """Return (M, 2) one-to-one pairs of the largest sum of certainty, each at least `least`; the other rooms stay alone."""
    return assign(1 - certain, 1 - least)


def count_pairs(pairs: Array, matches: Array) -> tuple[int, int, int, int]:
    """Return the numbers of pairs, of right ones, of rooms of a and b that have a partner, and of those that got a right one.

    Precision is the second over the first, recall the fourth over the third.
    """
    true = {(int(i), int(j)) for i, j in matches}
    right = [(int(i), int(j)) for i, j in pairs if (int(i), int(j)) in true]
    requested = sum(len(np.unique(matches[:, k])) for k in (0, 1))
    got = sum(len({pair[k] for pair in right}) for k in (0, 1))
    return len(pairs), len(right), requested, got
