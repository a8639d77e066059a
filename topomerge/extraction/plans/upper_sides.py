"""The upper sides of ceilings that look like the floor of an upper storey (beyond the thesis)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from topomerge.extraction.ceilings import CARRIED, NOWHERE
from topomerge.extraction.plans.plan import columns_of
from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.extraction.slices import SIGHT_DIRECTIONS, walled_directions
from topomerge.kernels.columns import hollow_below
from topomerge.types import Array, VoxelGrid

SHEET_THICKNESS = 0.2  # m: thinner than a floor that carries somebody
STOREY_BELOW = 1.2, 8.0  # m of empty space under a ceiling: at least, at most
ONE_SIDED_SHARE = 0.6  # of the directions in which a place sees a wall, on average: beside one long wall half of them
FLOOR_HEIGHTS = -0.3, 0.3  # m about the level of a storey, between which its floor lies
LEAST_FLOOR_SHARE = 0.1  # of a region in which a floor was seen
OPEN_SHARE = 0.25  # of the outline with walls, and of the floor with a ceiling: less, and a floor may be a ceiling


def without_upper_sides(grid: VoxelGrid, plan: StoreyPlan, region: Array, places: Array = NOWHERE) -> Array:
    """The regions of an upper storey less those that are the upper side of a ceiling: nothing above, and either no walls around
    or so thin that nobody is carried, with a storey right below. The flat roof of low rooms beside a hall has walls on one side:
    those of the hall, which so becomes no storey of its own.

    Args:
        grid: occupied cells.
        plan: of the upper storey.
        region: (nx, ny) region of each column, -1 none.
        places: (n, 3) m, where the sensor was: what it was carried over is a floor.
    """
    count = int(region.max(initial=-1)) + 1
    in_region = region >= 0
    size = np.maximum(np.bincount(region[in_region], minlength=count), 1)
    covered = np.bincount(region[in_region], ~np.isnan(plan.clear[in_region]), minlength=count) / size
    walled = ndimage.binary_dilation(plan.wall, np.ones((5, 5)))
    outline = in_region & ndimage.binary_dilation(~plan.inside, np.ones((3, 3)))
    length = np.maximum(np.bincount(region[outline], minlength=count), 1)
    beside_walls = np.bincount(region[outline], walled[outline], minlength=count) / length
    suspect = covered < OPEN_SHARE
    low, base = columns_of(plan, grid)
    at = np.floor((places[np.isfinite(places).all(axis=1)] - grid.origin) / grid.edge).astype(np.int64) - (*low, 0)
    at = at[((at[:, :2] >= 0) & (at[:, :2] < region.shape)).all(axis=1)]
    above, of = (at[:, 2] - base[tuple(at[:, :2].T)]) * grid.edge, region[tuple(at[:, :2].T)]
    suspect[of[(above > CARRIED[0]) & (above < CARRIED[1]) & (of >= 0)]] = False
    if not suspect.any():
        return region
    at = np.argwhere(in_region & suspect[np.where(in_region, region, 0)])
    cells = np.ascontiguousarray(np.column_stack([at + low, base[tuple(at.T)]]))  # each layout is compiled by itself
    heights = (round(height / grid.edge) for height in (SHEET_THICKNESS, *STOREY_BELOW))
    hollow = hollow_below(*grid._bricks, cells, 1, *heights)
    thin = np.bincount(region[tuple(at.T)], hollow, minlength=count) > 0.5 * size
    directions = walled_directions(plan.wall, plan.edge) / SIGHT_DIRECTIONS
    walls_around = np.bincount(region[in_region], directions[in_region], minlength=count) / size
    ceiling = suspect & (thin | (beside_walls < OPEN_SHARE) | (walls_around < ONE_SIDED_SHARE))
    if ceiling.any():  # what the hall beside a roof adds to that has no floor
        on_floor = (plan.profile & plan.profile.dtype.type(plan.bands.mask(*FLOOR_HEIGHTS))) != 0
        ceiling |= np.bincount(region[in_region], on_floor[in_region], minlength=count) < LEAST_FLOOR_SHARE * size
    return np.where(in_region & ceiling[np.where(in_region, region, 0)], -1, region)
