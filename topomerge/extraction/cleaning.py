"""Points and cells that are too many or too few: strays, points that hang at edges, gaps of sparse scans, means of cells."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from topomerge.errors import InputError
from topomerge.extraction.convolution import build_moore, convolve
from topomerge.kernels.occupied_cells import OFFSET_STEPS
from topomerge.types import Array, VoxelGrid, compute_extent

# Where the points of a cell lie on average: surfaces are known better by it than by the cell alone.
#
# A grid holds it as its property ``offset``, (n, 3) uint8: of the way through the cell along each axis, in 256 parts. So it stays
# right when a map is moved to another origin or scaled.

LOCATED = 1 << 18  # points that are located at a time
MIDDLE = OFFSET_STEPS // 2  # offset of a cell whose points are not known


def compute_cell_means(grid: VoxelGrid) -> Array:
    """Return (n, 3) float64 m: the mean of the points of each cell where the grid has it (property ``offset``), else the
    centroids."""
    offset = grid.properties.get("offset")
    if offset is None:
        return grid.compute_centroids()
    out: Array = offset.astype(np.float64)  # then in place: it has three numbers a cell
    out += 0.5
    out /= OFFSET_STEPS
    out += grid.cells
    out *= grid.edge
    out += grid.origin
    return out


def add_means(grid: VoxelGrid, points: Array, counts: Array | None = None) -> VoxelGrid:
    """Return the grid with the property ``offset`` of points (N, 3), m, that each stand for so many points; others are left
    out."""
    points = np.asarray(points, np.float64)
    parts = [grid.find_rows(grid.locate(points[k : k + LOCATED])) for k in range(0, len(points), LOCATED)]  # several copies each
    rows = np.concatenate(parts) if parts else np.zeros(0, np.int64)
    inside = rows >= 0
    weights = np.ones(len(rows)) if counts is None else np.asarray(counts, np.float64)
    if not inside.all():
        points, rows, weights = points[inside], rows[inside], weights[inside]
    many = np.bincount(rows, weights, len(grid))
    offset = np.empty((len(grid), 3), np.uint8)
    for k in range(3):  # an axis at a time: a merge is largest here
        within = (points[:, k] - grid.origin[k]) / grid.edge - grid.cells[rows, k]
        mean = np.where(many > 0, np.bincount(rows, weights * within, len(grid)) / np.maximum(many, 1e-9), 0.5)
        offset[:, k] = np.clip(mean * OFFSET_STEPS, 0, OFFSET_STEPS - 1).astype(np.uint8)
    return grid.assign_properties(offset=offset)


# What stands far from the rest of a cloud: stray points, and places that are no part of one building.
#
# Rasters cover the rectangle around all cells. What costs so much more than the cells themselves is told apart here, before any
# is made: few cells far off are left out, and several large places far apart are refused.

# A group of points is a stray when it lies this far (m) from every larger group and holds less than this share of the cells.
STRAY_DISTANCE = 10.0
STRAY_SHARE = 0.01
STRAY_TOTAL_SHARE = 0.05  # of all cells may be strays
LARGE_VOLUME = 2e8  # cells: 200 x 200 x 5 m at 0.1 m; smaller grids cost little whatever is in them
STRAY_CELLS = 16  # cells in a block as wide as STRAY_DISTANCE; fewer join nothing: dust would else join all that it lies between

PLACE_DISTANCE = 100.0  # m of nothing that part places of which each may be a building
PLACE_MARGIN = 48  # columns around a plan, in which nothing is
LARGE_AREA = 4e6  # columns of the rectangle around all places; smaller ones cost a few seconds
AREA_RATIO = 4.0  # times the rectangles around each
MOST_NAMED = 3  # places in a message
AROUND = np.argwhere(np.ones((3, 3, 3), bool))[14:] - 1  # half of the 26 neighbours


def select_without_strays(cells: Array, counts: Array, edge: float) -> tuple[Array, str]:
    """Select the cells to keep, and warn if some go: strays, where they make the grid much larger.

    A wing that was scanned thinly is no stray. Where much would go, the points are not strays: the unit is wrong.

    Args:
        cells: (n, 3) int64.
        counts: (n,) points in each.
        edge: m.
    """
    volume = compute_box_volume(cells)
    if volume <= LARGE_VOLUME:
        return np.ones(len(cells), bool), ""
    keep = _is_not_stray(cells, edge)
    if compute_box_volume(cells[keep]) >= volume / 4 or keep.mean() <= 1 - STRAY_TOTAL_SHARE:
        return np.ones(len(cells), bool), ""
    dropped = int(counts[~keep].sum())
    subject = "1 stray point lies" if dropped == 1 else f"{dropped} stray points lie"
    return keep, f"{subject} more than {STRAY_DISTANCE:g} m from the rest: left out"


def select_largest_place(cells: Array, counts: Array, edge: float) -> tuple[Array, str]:
    """Return the cells of the largest place, and a warning if there are others, where the rectangle around all is absurdly large.

    Args:
        cells: (n, 3) int64.
        counts: (n,) points in each.
        edge: m.

    Raises:
        InputError: a second place is too large to be left out.
    """
    everything = np.ones(len(cells), bool)
    total = _columns(cells)
    if total <= LARGE_AREA:
        return everything, ""
    place = label_groups(cells, max(int(PLACE_DISTANCE / edge), 1))
    size = np.bincount(place)
    order = np.argsort(-size, kind="stable")
    if total <= AREA_RATIO * sum(_columns(cells[place == k]) for k in order[: int(1 / STRAY_SHARE)]):
        return everything, ""
    main = place == order[0]
    dropped = int(counts[~main].sum())
    where = [_describe_place(cells[place == k], int(size[k]) / len(cells), edge) for k in order[:MOST_NAMED]]
    more = f" and {len(size) - MOST_NAMED} more" if len(size) > MOST_NAMED else ""
    if main.mean() <= 1 - STRAY_TOTAL_SHARE:
        raise InputError(
            f"the points lie in {len(size):,} places more than {PLACE_DISTANCE:g} m apart with nothing between them "
            f"({', '.join(where)}{more}): crop the file to one of them, or check --unit"
        )
    others = f"{', '.join(where[1:])}{more}"
    return main, f"{dropped:,} points lie more than {PLACE_DISTANCE:g} m from the rest with nothing between ({others}): left out"


def compute_box_volume(cells: Array) -> float:
    """Return cells of a box of whole bricks: what the lookup table has to cover."""
    low, high = compute_extent(cells)
    shape = high - low + 1
    return float(np.prod(((shape + 7) // 8 * 8).astype(np.float64)))


def label_groups(cells: Array, block: int, least: int = 1) -> Array:
    """Return (n,) int64 group of each cell, numbered from 0: those in blocks that touch each other.

    Args:
        cells: (n, 3) int64.
        block: cells a side of a block.
        least: cells in a block that joins its neighbours; of two blocks that touch, one must have as many.
    """
    keys, of_block, size = np.unique(cells // block, axis=0, return_inverse=True, return_counts=True)
    keys = np.column_stack([_squeeze_keys(keys[:, axis]) for axis in range(3)])
    span = [int(s) for s in keys.max(axis=0) + 2]
    if span[0] * span[1] * span[2] >= 1 << 62:
        raise InputError("the points are scattered over an extent that no building has: check --unit, or crop the file")
    step = np.array([span[1] * span[2], span[2], 1])
    codes = keys @ step  # ascending, as the keys are
    pairs = []
    for other in codes + (AROUND @ step)[:, None]:
        at = np.minimum(np.searchsorted(codes, other), len(codes) - 1)
        joined = (codes[at] == other) & ((size >= least) | (size[at] >= least))
        pairs.append(np.stack([np.flatnonzero(joined), at[joined]]))
    rows, columns = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(rows), bool), (rows, columns)), (len(codes), len(codes)))
    _, group = connected_components(graph, directed=False)
    return np.asarray(group, np.int64)[of_block.ravel()]


def _squeeze_keys(keys: Array) -> Array:
    """Return numbers from 1, in the same order, of which those stay neighbours that were: gaps take no more than one."""
    values, inverse = np.unique(keys, return_inverse=True)
    steps = np.minimum(np.diff(values, prepend=values[0] - 1), 2)
    return np.asarray(np.cumsum(steps)[inverse.ravel()])


def _is_not_stray(cells: Array, edge: float) -> Array:
    """Return (n,) bool: not in a small group of cells far from the rest. One stray return must not decide the size of the
    grid."""
    group = label_groups(cells, max(int(STRAY_DISTANCE / edge), 1), STRAY_CELLS)
    size = np.bincount(group)
    keep = (size >= STRAY_SHARE * len(cells))[group]
    return keep if keep.any() else group == size.argmax()


def _columns(cells: Array) -> float:
    """Count the columns of the rectangle around cells, with the margin that a plan has."""
    low, high = compute_extent(cells[:, :2])
    size = high - low + 1 + 2 * PLACE_MARGIN
    return float(size[0]) * float(size[1])


def _describe_place(cells: Array, share: float, edge: float) -> str:
    middle = ", ".join(f"{v:.0f}" for v in (np.median(cells, axis=0) + 0.5) * edge)
    return f"{100 * share:.2g} % around {middle} m"


# Points that are too few: cells are made so large that surfaces hold together (beyond the thesis).

COARSEST_CELL = 0.3  # m: in larger ones no door is seen


_neighbours: WeakKeyDictionary[VoxelGrid, Array] = WeakKeyDictionary()


def _count_neighbours(grid: VoxelGrid) -> Array:
    """Return (n,) occupied ones of the 26 cells around each; the count is kept for whoever asks next."""
    if grid not in _neighbours:
        _neighbours[grid] = convolve(grid, build_moore())
    return _neighbours[grid]


def coarsen_until_dense(grid: VoxelGrid, neighbours: float, warnings: list[str]) -> VoxelGrid:
    """Return the grid with cells so large that surfaces hold together: doubled until the median cell has as many neighbours (of
    26).

    Cells that would be too large to find doors are not made.

    Args:
        warnings: what the user should know is appended here.
    """
    while len(grid) and 2 * grid.edge <= COARSEST_CELL and float(np.median(_count_neighbours(grid))) < neighbours:
        fine, grid = grid, grid.coarsen(2)
        if "offset" in fine.properties:
            grid = add_means(grid, compute_cell_means(fine), fine.properties.get("count"))
        warnings.append(f"the points are sparse: cells of {grid.edge:g} m were taken")
    return grid


# Points that are too many (beyond the thesis).
#
# At the edge of a door a laser or a depth camera averages what is in front and what is behind: points hang in the opening, and a
# single one of them obstructs the body of the stick kernel.

# By the median alone (26 of solid walls) the floor beside them was noise, and such plans were refused (docs/adr/0005).
THICK_SURFACE = 17  # neighbours of a cell in a surface that is two cells thick


def remove_flying_cells(grid: VoxelGrid, share: float) -> VoxelGrid:
    """Return the cells that have at least `share` of the usual (median) number of neighbours.

    The limit follows the map: where points are sparse, surfaces have few neighbours, too, and only lonely cells go. In plans
    whose walls are solid most cells have all 26, and the floor 8: there the limit is that of a surface.
    """
    neighbours = _count_neighbours(grid)
    _neighbours.pop(grid)  # nobody asks a third time
    return grid.select_cells(neighbours >= share * min(float(np.median(neighbours)), THICK_SURFACE))
