"""At which heights a map shows storeys: floors and ceilings, layers of slices, or lines that were given walls (method 4)."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.plans.storey_plan import USUAL_HEIGHT
from topomerge.types import Array, VoxelGrid

STOREY_GAP = 1.9  # m of empty height between a floor and its ceiling
STOREY_LEAST_AREA = 3.0  # m2
STOREY_LEAST_SHARE = 0.08  # of the largest storey's area
SLICE_HEIGHT = 0.6  # m; a map that is not higher is a slice
LOWEST_EXTRUDED = 1.2  # m, of levels of one size: a map of lines that were given walls has walls that high, at least
LAYER_SHARE = 0.1  # of the cells that a layer of a map of slices holds at least


def extruded(grid: VoxelGrid) -> bool:
    """Was a map made from lines, which were given walls? Then all of its levels but the lowest hold the same columns."""
    if not len(grid):
        return False
    level = grid.cells[:, 2] - grid.cells[:, 2].min()
    counts = np.bincount(level)[1:]
    if len(counts) * grid.edge < LOWEST_EXTRUDED or (counts != counts[0]).any():
        return False
    first = grid.cells[level == 1, :2]
    return all(np.array_equal(grid.cells[level == k, :2], first) for k in range(2, len(counts) + 1))


def lines_of(grid: VoxelGrid) -> tuple[VoxelGrid, VoxelGrid]:
    """The lines of such a map at the height of the floor that it was given, where its sensor looked; and that floor, over which
    it looked."""
    level = grid.cells[:, 2] - grid.cells[:, 2].min()
    lines, floor = grid.cells[level == 1] - (0, 0, 1), grid.cells[level == 0]
    drawn = VoxelGrid.from_cells(lines, grid.origin, grid.edge, grid.shape)
    return drawn, VoxelGrid.from_cells(floor[~drawn.contains(floor)], grid.origin, grid.edge, grid.shape)


def slices(grid: VoxelGrid) -> list[float]:
    """Heights of the layers of a map that was seen at one height a storey only, lowest first; none for other maps.

    Nearly all cells lie in a few thin layers, and these show lines, where floors and ceilings would show areas.
    """
    z = grid.centroids()[:, 2]
    if float(np.ptp(z)) + grid.edge <= SLICE_HEIGHT:
        return [] if _filled(grid.cells, grid.edge) else [float(np.median(z))]
    thick = max(round(SLICE_HEIGHT / 2 / grid.edge), 1)
    counts = np.convolve(np.bincount(grid.cells[:, 2], minlength=grid.shape[2]), np.ones(thick), "same")
    layers: list[int] = []
    for k in np.argsort(-counts, kind="stable"):
        if counts[k] < LAYER_SHARE * len(grid):
            break
        if all(abs(int(k) - other) * grid.edge >= STOREY_GAP for other in layers):
            layers.append(int(k))
    inside = [np.abs(grid.cells[:, 2] - k) <= thick / 2 for k in layers]
    if not layers or sum(int(i.sum()) for i in inside) < 0.7 * len(grid):
        return []
    if _filled(grid.cells[np.logical_or.reduce(inside)], grid.edge):
        return []
    return sorted(float(np.median(z[i])) for i in inside)


def _filled(cells: Array, edge: float) -> bool:
    """Do cells fill areas, seen from above, or only draw lines?"""
    flat = cells[:, :2].astype(np.int64)
    columns = len(np.unique(flat[:, 0] << 32 | flat[:, 1]))
    side = max(round(0.5 / edge), 1)
    blocks = len(np.unique((flat[:, 0] // side) << 32 | (flat[:, 1] // side)))
    return columns > 0.6 * blocks * side**2


def levels(grid: VoxelGrid) -> list[tuple[float, float, float]]:
    """(floor, ceiling, base) of each storey, m, lowest first: nan where not seen; bands are counted from the base.

    A floor and its ceiling bound empty columns; where hardly any column has both, the largest level is a floor if most of the
    map lies above it, else a ceiling.
    """
    bottom, top = _gaps(grid)
    columns = len(np.unique(grid.cells[:, 0].astype(np.int64) * grid.shape[1] + grid.cells[:, 1]))
    if len(bottom) > 0.15 * columns:
        storeys = _closed(grid, bottom, top)
        if storeys:
            return storeys
    area = np.convolve(np.bincount(grid.cells[:, 2], minlength=grid.shape[2]), np.ones(3), "same")
    level = int(area.argmax())
    z = grid.origin[2] + (level + 0.5) * grid.edge
    above, below = int((grid.cells[:, 2] > level + 2).sum()), int((grid.cells[:, 2] < level - 2).sum())
    return [(z, np.nan, z)] if above >= below else [(np.nan, z, z - USUAL_HEIGHT)]


def _gaps(grid: VoxelGrid) -> tuple[Array, Array]:
    """Levels of the cells below and above each run of empty cells of at least `STOREY_GAP` in a column."""
    x, y, z = grid.cells.T.astype(np.int64)
    key = np.sort((x * grid.shape[1] + y) * (1 << 21) + z)
    step = np.diff(key)
    wide = (step > STOREY_GAP / grid.edge) & (key[1:] >> 21 == key[:-1] >> 21)
    mask = (1 << 21) - 1
    return key[:-1][wide] & mask, key[1:][wide] & mask


def _closed(grid: VoxelGrid, bottom: Array, top: Array) -> list[tuple[float, float, float]]:
    area = np.convolve(np.bincount(bottom, minlength=grid.shape[2]).astype(float), np.ones(3), "same") * grid.edge**2
    least = min(max(STOREY_LEAST_AREA, STOREY_LEAST_SHARE * area.max()), area.max())
    floors: list[int] = []
    level = np.bincount(grid.cells[:, 2], minlength=grid.shape[2])
    near, far = round(0.3 / grid.edge), round(1.6 / grid.edge)
    for z in np.argsort(-area, kind="stable"):
        if area[z] < least:
            break
        # An upper side of a ceiling, as a map shows that lacks all that is low, has hardly anything standing on it.
        hollow = level[z + near : z + far].sum() < 0.5 * level[max(z - far, 0) : max(z - near, 0)].sum()
        if not hollow and all(abs(int(z) - f) * grid.edge >= STOREY_GAP for f in floors):
            floors.append(int(z))
    storeys = []
    for z in sorted(floors):
        near = np.abs(bottom - z) * grid.edge <= 0.25
        floor = grid.origin[2] + (float(bottom[near].mean()) + 0.5) * grid.edge
        ceiling = grid.origin[2] + (float(np.median(top[near])) + 0.5) * grid.edge
        storeys.append((floor, ceiling, floor))
    return storeys
