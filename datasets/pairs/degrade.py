"""Pairs made harder in one known way, for curves of robustness: fewer points, noise, missing surface, another scale, time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.simulation.scanner import moved

from topomerge.errors import InputError
from topomerge.types import Array, PointCloud, Sim3

UNCHANGED = ("", 0.0)
BALL = 1.0  # m, radius of a hole
CHANGES = {
    "density": (0.001, 1.0),  # share of the points that is kept
    "noise": (0.0, 0.5),  # m, standard deviation that is added to each coordinate
    "missing": (0.0, 0.95),  # share of the points that lie in holes of 1 m
    "scale": (0.1, 10.0),  # by which the second map is larger
    "plan": (1.0, 1.0),  # the second map is the building's floor plan (`drawing`)
    "time": (0.0, 1.0),  # share of the furniture that moved, and of the doors; half as much is gone
}


def check_change(what: str, values: Sequence[float]) -> None:
    """Refuse a change that can't be made.

    Raises:
        InputError: names it.
    """
    if what not in CHANGES:
        raise InputError(f"vary: unknown {what!r}; {', '.join(CHANGES)} are possible")
    low, high = CHANGES[what]
    for value in values:
        if not low <= value <= high:
            raise InputError(f"vary.{what} must be {low:g} to {high:g}, not {value}")


def apart_in_time(difficulty: Difficulty, change: tuple[str, float]) -> Difficulty:
    """The difficulty of sessions that lie apart as the change ``("time", share)`` says; of other changes the same."""
    what, value = change
    return replace(difficulty, moved=value / 2, gone=value / 2, doors_moved=value) if what == "time" else difficulty


def degraded(pair: Pair, change: tuple[str, float], seed: int) -> Pair:
    """The pair with both its clouds changed (of ``scale`` only the second)."""
    what, value = change
    if what == "scale":
        size = Sim3(scale=value)
        truth = None if pair.truth is None else pair.truth @ size.inverse()
        frames = None if pair.frames is None else (pair.frames[0], size @ pair.frames[1])
        return replace(pair, b=moved(pair.b, size), truth=truth, frames=frames)
    if what not in KEEPING:
        return pair
    a, b = (KEEPING[what](c, value, np.random.default_rng([seed, k])) for k, c in enumerate((pair.a, pair.b)))
    return replace(pair, a=a, b=b)


def _thinned(cloud: PointCloud, share: float, rng: np.random.Generator) -> PointCloud:
    return taken(cloud, rng.random(len(cloud)) < share)


def _noisy(cloud: PointCloud, spread: float, rng: np.random.Generator) -> PointCloud:
    return replace(cloud, points=cloud.points + rng.normal(0, spread, cloud.points.shape).astype(np.float32))


def _holed(cloud: PointCloud, share: float, rng: np.random.Generator) -> PointCloud:
    """Without the points in balls about random points; the last ball may take more than the share."""
    tree, lost = cKDTree(cloud.points), np.zeros(len(cloud), bool)
    for centre in rng.permutation(len(cloud)):
        if lost.mean() >= share:
            break
        lost[tree.query_ball_point(cloud.points[centre], BALL)] = True
    return taken(cloud, ~lost)


def taken(cloud: PointCloud, rows: Array) -> PointCloud:
    """Some points of a cloud."""
    some = {n: v[rows] for n in ("points", "colors", "labels", "pose_of", "intensities") if (v := getattr(cloud, n)) is not None}
    return replace(cloud, **some)


KEEPING: dict[str, Callable[[PointCloud, float, np.random.Generator], PointCloud]] = {
    "density": _thinned, "noise": _noisy, "missing": _holed,
}  # fmt: skip
