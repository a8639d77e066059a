"""How well the walls of two maps agree, and the transform under which they agree best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from topomerge.datasets.pairs.flat import keys, squares, thin
from topomerge.datasets.pairs.pairs import Pair

from topomerge.errors import InputError
from topomerge.types import Array, Sim3

FIT_CELL = 0.05  # m, of the columns in which walls are looked for
BAND = (0.4, 2.0)  # m above the floor
FIT_STEP = 0.1  # m of height
FILLED_SHARE = 0.5  # share of the steps in that band that a wall fills
SEEN_REACH = 0.3  # m; a wall of b is in a's sight when a knows something that near
REACHES = (1.0, 0.5, 0.3, 0.2)  # m; partners are looked for ever closer


@dataclass(frozen=True)
class Residual:
    """How far b's walls lie from a's under a transform, where a has seen anything.

    Args:
        median: m.
        near: share of them within 0.2 m.
        seen: share of b's walls that lie where a has seen anything.
        moved: m by which `fit_walls`, started at the transform, moves the middle of those walls: how exact the truth is, where
            the maps themselves are.
        turned: degrees, the same.
    """

    median: float
    near: float
    seen: float
    moved: float = float("inf")
    turned: float = float("inf")


def wall_points(points: Array, floor: float) -> Array:
    """(n, 2) float64 middles of the columns of points (m, 3) that are filled like a wall above a floor at a height, m."""
    points = points[(points[:, 2] > floor + BAND[0]) & (points[:, 2] < floor + BAND[1])]
    if not len(points):
        return np.empty((0, 2))
    cells = squares(points, np.array([FIT_CELL, FIT_CELL, FIT_STEP]))
    _, first, column = np.unique(keys(cells[:, :2])[0], return_index=True, return_inverse=True)
    steps = np.unique(keys(np.column_stack([column, cells[:, 2]]))[0], return_index=True)[1]
    filled = np.bincount(column[steps], minlength=len(first)) >= FILLED_SHARE * (BAND[1] - BAND[0]) / FIT_STEP
    many = np.bincount(column)
    return np.column_stack([np.bincount(column, points[:, k]) / many for k in range(2)])[filled]


def walls(pair: Pair, truth: Sim3) -> tuple[Array, Array]:
    """(n, 2) walls of a and of b over b's lowest floor, in a's frame."""
    a = pair.a.points.astype(np.float64) + pair.a.shift
    b = truth.apply(pair.b.points.astype(np.float64) + pair.b.shift)
    floor = float(np.percentile(b[:, 2], 1))
    return wall_points(a, floor), wall_points(b, floor)


def residual(pair: Pair) -> Residual:
    """Of a pair's walls under its truth.

    Raises:
        InputError: the maps are of two places.
    """
    if pair.truth is None:
        raise InputError(f"{pair.name}: maps of two places have no walls in common")
    a, b = walls(pair, pair.truth)
    walls_of_a = cKDTree(thin(pair.a.points[:, :2].astype(np.float64) + pair.a.shift[:2], 2 * FIT_CELL))
    seen = walls_of_a.query(b, distance_upper_bound=SEEN_REACH)[0] <= SEEN_REACH
    if not seen.any() or not len(a):
        return Residual(float("inf"), 0.0, 0.0)
    b = b[seen]
    distance, middle = cKDTree(a).query(b)[0], b.mean(axis=0)
    better = fit_walls(a - middle, b - middle, Sim3())
    moved, turned = float(np.hypot(*better.translation[:2])), float(abs(np.degrees(better.yaw)))
    return Residual(float(np.median(distance)), float((distance < 0.2).mean()), float(seen.mean()), moved, turned)


def fit_walls(a: Array, b: Array, guess: Sim3, scale: bool = False) -> Sim3:
    """The similarity near a guess that lays walls b (m, 2) on walls a (n, 2): iterated closest points (Besl & McKay 1992),
    trimmed at `REACHES`.

    Args:
        scale: fit the scale, too; else the guess's is kept.
    """
    tree, x = cKDTree(a), b[:, 0] + 1j * b[:, 1]  # a plane similarity is one product and one sum of complex numbers
    turn = guess.scale * np.exp(1j * guess.yaw)
    shift = complex(*guess.translation[:2])
    for reach in np.repeat(REACHES, 20):
        moved = turn * x + shift
        distance, partner = tree.query(np.column_stack([moved.real, moved.imag]), distance_upper_bound=reach)
        near = np.isfinite(distance)
        if near.sum() < 3:
            break
        p, q = x[near], a[partner[near]] @ [1, 1j]
        p0, q0 = p.mean(), q.mean()
        product = (np.conj(p - p0) * (q - q0)).sum()
        turn = product / (np.abs(p - p0) ** 2).sum() if scale else product / abs(product) * guess.scale
        shift = q0 - turn * p0
    return Sim3(float(np.angle(turn)), (float(shift.real), float(shift.imag), guess.translation[2]), float(abs(turn)))
