"""Walls and floor of a plan as masks: are they the other way round, and does floor lie outside of all walls?"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from topomerge.types import Array

JUDGED_FLOOR = 4.0  # m2 of floor below which nothing is judged
OUTSIDE_SHARE = 1 / 3  # of the floor: more outside of every wall is suspicious; of real maps that are read rightly up to .26 is
FEW_WALLS = 4  # of 8 directions in which a place outside of the walls meets one, at most
SAMPLED_PIXELS = 4_000_000  # of a larger picture every second, third ... pixel
BODY_RADIUS = 0.25  # m; floor where no body fits is no floor but the lines of walls
NARROW, WIDE = 0.1, 0.3  # of the pixels of walls, at most, and of floor, at least, that lie deeper than that in what is like them


def is_inverted(occupied: Array, free: Array, resolution: float) -> bool:
    """Return whether the floor is as narrow as the lines of walls, and the walls as wide as a floor.

    Args:
        occupied, free: (h, w) bool.
        resolution: m a pixel.
    """
    if occupied.sum() <= free.sum() or not free.any():  # there is more floor than walls
        return False
    step = max(1, math.ceil(math.sqrt(occupied.size / SAMPLED_PIXELS)))
    occupied, free, resolution = occupied[::step, ::step], free[::step, ::step], resolution * step
    if not (occupied.any() and free.any()):
        return False
    return _measure_deep_share(free, resolution) <= NARROW and _measure_deep_share(occupied, resolution) >= WIDE


def _measure_deep_share(mask: Array, resolution: float) -> float:
    """Measure the share of the pixels of a mask (h, w) that lie deeper in it than `BODY_RADIUS`."""
    inside = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1][mask]
    return float((inside * resolution > BODY_RADIUS).mean())


def check_outside_floor(occupied: Array, free: Array, resolution: float) -> list[str]:
    """Check for a floor of which much lies outside of every wall.

    Args:
        occupied, free: (h, w) bool.
        resolution: m a pixel.
    """
    if free.sum() * resolution**2 < JUDGED_FLOOR or not occupied.any():
        return []
    share = measure_outside_share(occupied, free)
    return [f"{share:.0%} of the floor lies outside of every wall"] if share > OUTSIDE_SHARE else []


def measure_outside_share(occupied: Array, free: Array) -> float:
    """Return share of the floor from which at most `FEW_WALLS` of 8 directions meet a wall before the border of the picture.

    Args:
        occupied, free: (h, w) bool.
    """
    step = max(1, math.ceil(math.sqrt(occupied.size / SAMPLED_PIXELS)))
    if step > 1:  # no wall may be lost, or it would not enclose anything
        padded = np.pad(occupied, [(0, -side % step) for side in occupied.shape])
        rows, columns = padded.shape
        occupied = np.logical_or.reduce(padded.reshape(rows // step, step, columns // step, step), axis=(1, 3))
        free = free[::step, ::step] & ~occupied
    met = np.zeros(free.shape, np.uint8)
    for back in (1, -1):
        met[:, ::back] += np.logical_or.accumulate(occupied[:, ::back], axis=1)
        met[::back] += np.logical_or.accumulate(occupied[::back], axis=0)
        for aside in (1, -1):
            _add_diagonal(met[::back, ::aside], occupied[::back, ::aside])
    return float((met[free] <= FEW_WALLS).mean()) if free.any() else 0.0


def _add_diagonal(met: Array, occupied: Array) -> None:
    """Add 1 to the pixels (h, w) that meet an occupied one towards the upper left."""
    reached = np.zeros(occupied.shape[1] + 1, bool)
    for row, walls in zip(met, occupied, strict=True):
        reached[1:] = reached[:-1] | walls
        reached[0] = False
        row += reached[1:]
