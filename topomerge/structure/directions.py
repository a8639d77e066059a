"""Directions in which walls run, of points seen from above: a profile over half a turn, and the sharpest directions in it.

Lines that are fitted tell theirs more exactly (`structure.lines.estimate_main_direction`).
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from topomerge.types import Array

DIRECTION_STEP = 0.5  # degrees, of the direction profile
TURN_STEPS = (np.radians(1.0), np.radians(0.1))  # in which the direction of walls is sought
MOST_DIRECTIONS, DIRECTIONS_APART = 3, np.radians(10.0)  # of walls that are told apart
OTHER_DIRECTION = 0.15  # of the sharpness of the first direction, beyond what any has, that another one must have
MOST_WALLS = 6000  # columns whose direction is taken
DIRECTION_BIN = 0.1  # m, into which walls are projected


def compute_direction_profile(walls: Array, edge: float, most: int = 6000) -> Array:
    """Return (360,) float64: for each direction in steps of 0.5 degrees, how much the walls' projection across it is heaped
    up."""
    if not len(walls):
        return np.zeros(int(180 / DIRECTION_STEP))
    rng = np.random.default_rng(0)
    points = walls if len(walls) <= most else walls[rng.permutation(len(walls))[:most]]
    points = points - points.mean(axis=0) + rng.uniform(-edge / 2, edge / 2, points.shape)  # else the raster lines up at 0 and 90
    angles = np.radians(np.arange(0, 180, DIRECTION_STEP))
    across = points @ np.stack([-np.sin(angles), np.cos(angles)])
    rows = np.floor(across / 0.2).astype(np.int64)
    rows -= rows.min()
    width = int(rows.max()) + 1
    flat = (rows + np.arange(len(angles)) * width).ravel()
    heaps = np.bincount(flat, minlength=len(angles) * width).reshape(len(angles), width).astype(float)
    sharp: Array = (heaps**2).sum(axis=1) / len(points)
    return np.clip(sharp - np.median(sharp), 0, None)


def estimate_wall_directions(walls: Array) -> tuple[float, ...]:
    """Return directions in [0, pi/2), rad, along which walls (n, 2), m, line up, the sharpest first: there they fall into
    the fewest, fullest bins of both axes; 0 without any walls."""
    if not len(walls):
        return (0.0,)
    walls = walls[np.linspace(0, len(walls) - 1, min(len(walls), MOST_WALLS)).astype(int)]
    walls = walls - walls.mean(axis=0)
    turns = np.arange(-45, 45) * TURN_STEPS[0]
    sharpness = np.array([_measure_sharpness(walls, float(turn)) for turn in turns])
    excess = sharpness - np.median(sharpness)
    around = ndimage.maximum_filter1d(sharpness, 2 * round(DIRECTIONS_APART / TURN_STEPS[0]) - 1, mode="wrap")
    peaks = np.flatnonzero((sharpness == around) & (excess >= OTHER_DIRECTION * excess.max()))
    best = peaks[np.argsort(-sharpness[peaks], kind="stable")[:MOST_DIRECTIONS]]
    return tuple(_refine_direction(walls, float(turns[k])) % (np.pi / 2) for k in best)


def _refine_direction(walls: Array, turn: float) -> float:
    around = round(TURN_STEPS[0] / TURN_STEPS[1])
    turns = turn + np.arange(-around, around) * TURN_STEPS[1]
    return float(turns[int(np.argmax([_measure_sharpness(walls, float(near)) for near in turns]))])


def _measure_sharpness(walls: Array, turn: float) -> float:
    """Sum of squares of how many walls fall into each bin of both axes; bins are blurred, so that none is cut in two."""
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s], [s, c]])
    total = 0.0
    for values in (walls @ rotation).T:
        counts = np.bincount(np.floor((values - values.min()) / DIRECTION_BIN).astype(np.int64)).astype(float)
        total += float((counts**2).sum() + (counts[1:] * counts[:-1]).sum())
    return total
