"""The greys of unknown and of floor in a robot's grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topomerge.types import Array

SPREAD = 12  # levels of 255 to either side of a grey: so far noise carries most of its pixels
APART = 20  # levels of 255, at least, from the grey of unknown to that of floor
NEAR_TWO_GREYS = 0.9  # of the pixels of all but the commonest grey: of real maps of three values .9 to 1 lie around the second
NEAR_TWO_GREYS_JPEG = 0.7  # likewise; its noise carries pixels further
BETWEEN = 0.2  # pixels between the two greys for each one of noise around that of unknown, at most, where the two are clear cut
LEAST_BLACK = 0.25  # of a pixel of a wall that was washed out when the picture was made smaller
FLOOR_GREY, LEAST_UNKNOWN = 250, 0.1  # lighter is floor; share of the pixels that have the very grey of unknown
BESIDE_WALL = 20  # levels of 255 by which it is darker than what lies on both sides
LEAST_WASHED = 0.2  # of a grid's walls: of those that robots leave at most .13 are grey lines, of a storey made smaller .26
USUAL_UNKNOWN, USUAL_WITHIN = 205, 4  # levels of 255: the grey of unknown of ROS, and how far pictures saved again are from it


@dataclass(frozen=True)
class GreyLevels:
    """The greys of unknown and of floor in a map, from 0 (wall) to 255 (free)."""

    unknown: int
    floor: int

    @property
    def middle(self) -> float:
        """Lighter pixels are nearer to the grey of floor."""
        return (self.unknown + self.floor) / 2

    @property
    def threshold(self) -> float:
        """The `free_thresh` that parts them: a share of 0..1."""
        return 1.0 - self.middle / 255.0


def find_grey_levels(levels: Array, lossy: bool) -> GreyLevels | None:
    """Find the greys of unknown and of floor, where nearly all pixels that are no walls lie around two greys; else None.

    Args:
        levels: (n,) uint8, the pixels that are neither walls nor transparent; 255 is certainly free.
        lossy: was the picture saved as JPEG?
    """
    counts = np.bincount(levels, minlength=256).astype(np.float64)
    first = _find_mode(counts)
    others = counts.copy()
    others[_get_level_window(first)] = 0
    if not others.any():
        return None
    second = _find_mode(others)
    near = others[_get_level_window(second)].sum() / others.sum()
    if near < (NEAR_TWO_GREYS_JPEG if lossy else NEAR_TWO_GREYS) or abs(first - second) < APART:
        return None
    return GreyLevels(min(first, second), max(first, second))


def is_clear_cut(grey: GreyLevels, levels: Array) -> bool:
    """Return whether hardly any pixels are between the noise around the greys of unknown and of floor.

    Args:
        grey: of the picture.
        levels: (n,) uint8, of the pixels that count as floor.
    """
    noise = (levels <= grey.unknown + SPREAD).sum()
    between = (levels > grey.unknown + SPREAD) & (levels < grey.floor - SPREAD)
    return bool(between.sum() <= BETWEEN * noise)


def is_unknown_grey(grey: GreyLevels, levels: Array, counted: Array) -> bool:
    """Return whether the grey of unknown is that of ROS, or the commoner one along the border of the picture.

    Args:
        grey: of the picture.
        levels: (h, w) uint8.
        counted: (h, w) bool, the pixels that are neither walls nor transparent.
    """
    if abs(grey.unknown - USUAL_UNKNOWN) <= USUAL_WITHIN:
        return True
    inner = np.zeros(levels.shape, bool)
    inner[1:-1, 1:-1] = True
    border = levels[counted & ~inner]
    return bool((border < grey.middle).sum() > (border >= grey.middle).sum())


def find_washed_walls(levels: Array, counted: Array, occupied: Array) -> Array:
    """Find the thin lines (h, w) bool that are darker than unknown: walls washed out when the picture was made smaller.

    A grid has three values, so that darker pixels hold black. Lines alone: the washed-out rim of a black wall would thicken it.

    Args:
        levels: (h, w) uint8; where the grey of unknown is not that of ROS, darker ones may be anything, and no wall is found.
        counted: (h, w) bool, the pixels that are neither walls nor transparent.
        occupied: (h, w) bool, the walls that are black enough: where these are most of all, none was washed out.
    """
    shares = np.bincount(levels[counted], minlength=256) / max(int(counted.sum()), 1)
    unknown = int(shares[:FLOOR_GREY].argmax())
    if abs(unknown - USUAL_UNKNOWN) > USUAL_WITHIN or shares[unknown] < LEAST_UNKNOWN:
        return np.zeros(levels.shape, bool)
    value = levels.astype(np.int16)
    around = np.pad(value, 2, constant_values=unknown)
    line = np.zeros(levels.shape, bool)
    for turned, out in ((around, line), (around.T, line.T)):
        h = len(out)
        middle = turned[2:-2, 2:-2]
        before, after = turned[1 : 1 + h, 2:-2], turned[3 : 3 + h, 2:-2]
        farther = np.minimum(turned[:h, 2:-2], turned[4 : 4 + h, 2:-2])
        out |= (middle <= before) & (middle <= after) & (middle + BESIDE_WALL < farther)
    washed = line & counted & (value < (1 - LEAST_BLACK) * unknown)
    return washed if washed.sum() >= LEAST_WASHED * (washed.sum() + occupied.sum()) else np.zeros(levels.shape, bool)


def _get_level_window(level: int) -> slice:
    return slice(max(level - SPREAD, 0), level + SPREAD + 1)


def _find_mode(counts: Array) -> int:
    """Return the grey with the most pixels around it."""
    sums = np.convolve(counts, np.ones(2 * SPREAD + 1), "same")
    near = _get_level_window(int(sums.argmax()))
    smooth = np.convolve(counts, (1, 2, 3, 2, 1), "same")
    return near.start + int(smooth[near].argmax())
