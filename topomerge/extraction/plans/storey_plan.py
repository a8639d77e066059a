"""A storey seen from above: its plan, what probably stands in its columns, and the floors of a map cut into rooms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np

from topomerge.kernels.rasters import find_lowest_bit
from topomerge.types import Array, VoxelGrid

# A storey seen from above: the one type for it, and the one rule for which of its columns are walls (beyond the thesis).
#
# A wall fills most of the heights between furniture and lintels; what fills fewer is clutter. The extraction makes such plans
# from the navigable volume (`extraction.plans.plan`), the merging from bare cells (`registration.storeys`), the matching from
# finished maps (`matching.room_plans`).

WALL_HEIGHTS = np.linspace(0.5, 2.0, 7)  # m above the floor, limits of the bands in most of which a wall is seen
BODY_HEIGHTS = (0.25, 2.0)  # m above the floor: empty where one can walk
OBSERVED_SHARE = 0.2  # of the fullest band's columns: below, the sensor did not look at that height
UPRIGHT = 1.9  # m: nothing lower is a ceiling
USUAL_HEIGHT = 2.7  # m, floor to ceiling


@dataclass(frozen=True)
class HeightBands:
    """How the bits of a profile divide heights above the floor: bit k begins at (k - below) * step m."""

    step: float
    below: int
    count: int

    def build_mask(self, low: float, high: float) -> int:
        """Return the bits of the bands from `low` up to, not including, `high` m; of one at least, where any is as high."""
        first = min(max(round(low / self.step) + self.below, 0), self.count)
        last = min(max(round(high / self.step) + self.below, first + 1), self.count)
        return (1 << last) - (1 << first)


HEIGHT_BANDS = HeightBands(step=0.25, below=2, count=32)  # of the plans that poses are judged by: from 0.5 m below the floor


@dataclass(frozen=True, eq=False)
class StoreyPlan:
    """One storey as rasters (nx, ny) of columns, the first axis is x; column (0, 0) has its corner at `origin`.

    Args:
        origin: (2,) float64 m.
        edge: m, of a column.
        wall: bool.
        inside: bool, known and no wall: empty ground and what stands on it. A column that is neither is unknown.
        profile: unsigned, occupied bands of heights above the local floor.
        bands: what the bits of `profile` mean.
        floor: float64 m, height of the local floor; a guess where it was not seen.
        ceiling: float64 m above the local floor; nan where none was seen.
        top: float64 m above the local floor, where the storey above begins; inf where none is known.
        levels: m, heights of the storey's floor and of its ceiling; nan where not seen.
        observed: bits of the bands at which the map looked at all.
        sliced: was it seen at one height only? Its floor is a guess then.
    """

    origin: Array
    edge: float
    wall: Array
    inside: Array
    profile: Array
    bands: HeightBands
    floor: Array
    ceiling: Array
    top: Array | float = np.inf
    levels: tuple[float, float] = (np.nan, np.nan)
    observed: int = 0
    sliced: bool = False

    @cached_property
    def standing(self) -> Array:
        """(nx, ny) bool: something is at the height of a body."""
        return self.is_occupied(*BODY_HEIGHTS)

    @cached_property
    def clutter(self) -> Array:
        """(nx, ny) bool: inside, and something stands there."""
        return self.inside & self.standing

    @cached_property
    def free(self) -> Array:
        """(nx, ny) bool: inside, and nothing stands there."""
        return self.inside & ~self.standing

    @cached_property
    def explored(self) -> Array:
        """(nx, ny) bool."""
        return self.wall | self.inside

    @cached_property
    def clear(self) -> Array:
        """(nx, ny) float64 m above the local floor, lower side of the first thing above 1.9 m; nan where nothing was seen."""
        return find_first_above(self.profile, self.bands)

    @cached_property
    def floor_height(self) -> Array:
        """(nx, ny) float32 m, `floor`."""
        return self.floor.astype(np.float32)

    @cached_property
    def ceiling_height(self) -> Array:
        """(nx, ny) float32 m, height of the ceiling in the map's frame."""
        return (self.floor + self.ceiling).astype(np.float32)

    @property
    def floor_guess(self) -> float:
        """Height of the storey's floor, m; where it was not seen, that below its ceiling."""
        floor, ceiling = self.levels
        return floor if np.isfinite(floor) else ceiling - USUAL_HEIGHT

    def is_occupied(self, low: float, high: float) -> Array:
        """Return (nx, ny) bool: is anything between two heights above the floor, m?"""
        out: Array = (self.profile & self.profile.dtype.type(self.bands.build_mask(low, high))) != 0
        return out

    def compute_points(self, mask: Array) -> Array:
        """Return (n, 2) float64 middles of masked columns, m."""
        return self.origin + (np.argwhere(mask) + 0.5) * self.edge


@dataclass(frozen=True)
class WallRule:
    """The rule that makes a column a wall.

    Args:
        share: of the observed bands that it fills.
        lacking: bands that it may have fewer, though not less than half, where it fills more than enough with its neighbours.
        least_bands: observed ones; with fewer, nothing is known of walls.
    """

    share: float = 4 / 6
    lacking: int = 1
    least_bands: int = 1

    def count_least_bands(self, observed: int) -> int:
        """Count how many of the observed bands a wall fills."""
        return max(int(np.ceil(self.share * observed - 1e-6)), 1)


WALL_RULE = WallRule()  # of the plans that poses are judged by


def find_first_above(profile: Array, bands: HeightBands, height: float = UPRIGHT) -> Array:
    """Return (nx, ny) float64 m above the local floor, lower side of the first thing above a height; nan where there is none."""
    bit = find_lowest_bit(profile.ravel(), round(height / bands.step) + bands.below).reshape(profile.shape)
    return np.where(bit >= 0, (bit - bands.below) * bands.step, np.nan)


def build_band_stack(profile: Array, bands: HeightBands, heights: Array = WALL_HEIGHTS) -> Array:
    """Return (B, nx, ny) bool: is anything between each two of B + 1 heights, m, of a profile (nx, ny)?"""
    masks = [profile.dtype.type(bands.build_mask(low, high)) for low, high in pairwise(heights)]
    return np.stack([(profile & mask) != 0 for mask in masks])


def is_observed_band(filled: Array) -> Array:
    """Return (B,) bool: does a band (B, nx, ny) hold enough to say that the map looked there?"""
    count = filled.sum(axis=(1, 2))
    return np.asarray(count >= OBSERVED_SHARE * max(int(count.max()), 1)) & (count.max() > 0)


def detect_wall_columns(filled: Array, rule: WallRule) -> Array:
    """Return (nx, ny) bool: which columns are walls, by the observed bands of heights (B, nx, ny) that they fill."""
    if len(filled) < rule.least_bands:
        return np.zeros(filled.shape[1:], bool)
    need = rule.count_least_bands(len(filled))
    nearly = max(need - rule.lacking, -(-need // 2))
    own = filled.sum(axis=0)
    around = _spread_bands(filled).sum(axis=0)
    return np.asarray((own >= need) | ((own >= nearly) & (around > need)))


def _spread_bands(filled: Array) -> Array:
    """Return the bands that each column or one of the four beside it fills: a noisy wall is spread over columns."""
    out = filled.copy()
    out[:, 1:] |= filled[:, :-1]
    out[:, :-1] |= filled[:, 1:]
    out[:, :, 1:] |= filled[:, :, :-1]
    out[:, :, :-1] |= filled[:, :, 1:]
    return out


# What probably stands in the columns of a storey (beyond the thesis: docs/adr/0005).

COLUMN_CLASSES = ("inside", "wall", "doorway", "shut", "outside")  # furniture is inside
INSIDE_CLASS, WALL_CLASS, DOORWAY_CLASS, SHUT_CLASS = range(4)  # of them
PASSAGE_REACH = 0.3  # m around a passage
SIGNS_REACH = 0.5  # m around it, in which walls and leaves are looked for
PLAN_SIGNS = (
    "doorway",
    "doorway_most",
    "walled",
    "leaf",
)  # around a passage: mean, highest, mean of a wall, highest of a shut door


@dataclass(frozen=True, eq=False)
class ClassifiedStorey:
    """Class probabilities of the columns of a storey, in the frame of the map.

    Args:
        probability: (nx, ny, 5) of each of `COLUMN_CLASSES`.
        origin: (2,) m, lower corner of the first column.
        edge: m, of a column.
        height: m, of the floor.
    """

    probability: Array
    origin: Array
    edge: float
    height: float


def compute_plan_features(storeys: Sequence[ClassifiedStorey], centres: Array) -> Array:
    """Return (n, 4) `PLAN_SIGNS` at passages (n, 3) m; zeros where no plan is."""
    signs = np.zeros((len(centres), len(PLAN_SIGNS)))
    for row, centre in zip(signs, centres if storeys else (), strict=False):
        storey = _find_nearest_storey(storeys, centre)
        near, wider = (_crop_around(storey, centre, reach) for reach in (PASSAGE_REACH, SIGNS_REACH))
        if near.size:
            doorway = near[..., DOORWAY_CLASS]
            row[:] = doorway.mean(), doorway.max(), wider[..., WALL_CLASS].mean(), wider[..., SHUT_CLASS].max()
    return signs


def _find_nearest_storey(storeys: Sequence[ClassifiedStorey], centre: Array) -> ClassifiedStorey:
    return min(storeys, key=lambda s: abs(s.height - float(centre[2])))


def _crop_around(storey: ClassifiedStorey, centre: Array, reach: float) -> Array:
    """Return (a, b, 5) of the columns at most `reach` m from a place, along each axis."""
    columns = max(int(reach / storey.edge), 1)
    low = np.floor((np.asarray(centre)[:2] - storey.origin) / storey.edge).astype(np.int64) - columns
    box = tuple(slice(max(k, 0), max(k + 2 * columns + 1, 0)) for k in low.tolist())
    near: Array = storey.probability[box]
    return near


Merge = tuple[int, int, float]  # two areas whose sides became one, and the probability of a door between these

# The floors of a map cut into rooms: what rooms of plans and rooms of views become before the graph is made (seeds 2.7).


@dataclass(frozen=True, eq=False)
class Floor:
    """The floors of all storeys, cut into rooms.

    Args:
        cells: the navigable volume, and the floor under furniture where rooms have such. Its property `standing` (bool) tells
            where a body fits; absent, it fits everywhere.
        storeys: (S,) STOREY_DTYPE.
        storey, room, area: (m,) int32 of each cell, -1 none.
        room_of_area: (A,) int32.
        label: (n,) int32 room of each occupied cell of the grid, -1 none.
        body_width: m, how much wider than its cells a passage is: where they tell where a body's middle may be, the body's width.
        door_probability: that a door parts two rooms, where it was judged.
        merges: of areas into rooms, in their order.
        completeness: (R,) share of each room's outline at which a wall was seen, where the plans tell it.
        classified_storeys: what probably stands in the columns of the storeys' plans.
        plans: these plans, without furniture.
        chosen_parameters: of the extraction, that a step chose by itself.
    """

    cells: VoxelGrid
    storeys: Array
    storey: Array
    room: Array
    area: Array
    room_of_area: Array
    label: Array
    body_width: float = 0.0
    door_probability: dict[tuple[int, int], float] = field(default_factory=dict)
    merges: tuple[Merge, ...] = ()
    completeness: Array | None = None
    classified_storeys: tuple[ClassifiedStorey, ...] = ()
    plans: tuple[StoreyPlan, ...] = ()
    chosen_parameters: dict[str, float] = field(default_factory=dict)
