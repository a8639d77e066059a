"""Map -> plans: what each storey shows from above. Walls, empty space and clutter are what registration goes by (method 3).

A *wall* column is filled at most of the heights between 0.5 and 2.0 m above the floor; a *free* one has a floor or a ceiling and
nothing between, or rays crossed it; the rest of the occupied ones are *clutter*. Works for scans, extruded drawings, and slices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from topomerge.errors import InputError
from topomerge.kernels.plan import column_bits
from topomerge.types import Array, TopometricMap, VoxelGrid

CELL = 0.1  # m
BAND, LOW = 0.25, -0.5  # m, bands of heights, and where the lowest begins, above the floor
BODY = (3, 10)  # bands 0.25 to 2.0 m: empty where one can walk
WALL = (4, 10)  # bands 0.5 to 2.0 m: filled by walls
FILLED = 4 / 6  # share of the observed wall bands
OBSERVED = 0.2  # a band is observed where it holds this share of the cells of the fullest one
GAP = 1.9  # m of empty height between a floor and its ceiling
LEAST_AREA = 3.0  # m2 of a storey
LEAST_SHARE = 0.08  # of the largest storey
SLICE = 0.6  # m; a map that is not higher is a slice
NOMINAL = (2.7, 0.3, 1.375)  # m: floor to ceiling; a slice's height above the floor; and the height at which slices are drawn
FLAT = 1.5  # m, radius over which the floor may rise and fall
SHORT = 1.3  # m; what a slice shows of less than this is furniture
UNIT = np.uint32(1)


@dataclass(frozen=True, eq=False)
class Plan:
    """A storey from above. Arrays are (H, W) bool, the first axis is x; column (0, 0) has its corner at `origin`.

    Args:
        origin: (2,) m.
        cell: m.
        wall, free, clutter: exclusive; a column that is none of them is unknown.
        floor, ceiling: heights, m; nan where not seen.
        bits: (H, W) uint32, occupied bands of heights (`BAND`, from `LOW`) above the floor.
        bands: uint32, the bands that the map observed at all.
        height: (H, W) float32, m, the ceiling's height above the floor, or above 0 where no floor was seen; nan without ceiling.
        sliced: seen at one height only: `floor` is a guess.
    """

    origin: Array
    cell: float
    wall: Array
    free: Array
    clutter: Array
    floor: float
    ceiling: float
    bits: Array
    bands: int
    height: Array
    sliced: bool = False

    @property
    def known(self) -> Array:
        """(H, W) bool."""
        return self.wall | self.free | self.clutter

    @property
    def guess(self) -> float:
        """Height of the floor, m; a guess where it was not seen."""
        return self.floor if np.isfinite(self.floor) else self.ceiling - NOMINAL[0]

    def points(self, mask: Array) -> Array:
        """(n, 2) float64 middles of masked columns, m."""
        return self.origin + (np.argwhere(mask) + 0.5) * self.cell


def plans(map: TopometricMap | VoxelGrid, free: VoxelGrid | None = None, cell: float = CELL) -> list[Plan]:
    """The storeys of a map, lowest first.

    Args:
        map: a topometric map (its `free` is used) or occupied cells.
        free: cells known to be empty.
        cell: edge length of a column, m; never below that of the map's cells.

    Raises:
        InputError: the map has no cells.
    """
    grid = map.grid if isinstance(map, TopometricMap) else map
    free = map.free if isinstance(map, TopometricMap) and free is None else free
    if not len(grid):
        raise InputError("the map has no occupied cells: there is nothing to register")
    cell = max(cell, grid.edge)
    points = cell_middles(grid)
    low = np.floor(points[:, :2].min(axis=0) / cell).astype(np.int64)
    columns = np.floor(points[:, :2] / cell).astype(np.int64) - low
    shape = tuple((columns.max(axis=0) + 1).tolist())
    ix, iy = np.ascontiguousarray(columns.T)
    empty = None
    if free is not None and len(free):
        at = free.centroids()
        columns = np.floor(at[:, :2] / cell).astype(np.int64) - low
        level = np.full(len(at), np.median(points[:, 2])) if _is_slice(grid) else at[:, 2]
        empty = (np.ascontiguousarray(columns[:, 0]), np.ascontiguousarray(columns[:, 1]), level)
    sliced, found = _is_slice(grid), []
    z = np.full(len(points), np.median(points[:, 2])) if sliced else points[:, 2]
    for floor, ceiling, base in levels(grid):
        heights = np.full(shape, base)
        if np.isfinite(floor) and not sliced:
            heights = _local_floor(ix, iy, z, heights)
        occupied = column_bits(ix, iy, z, heights, LOW, BAND)
        crossed = column_bits(*empty, heights, LOW, BAND) if empty else np.zeros(shape, np.uint32)
        height = _ceiling(ix, iy, z, base, ceiling, shape) - (heights if np.isfinite(floor) else 0.0)
        found.append(_plan(occupied, crossed, low * cell, cell, floor, ceiling, height.astype(np.float32), sliced))
    return found


def cell_middles(grid: VoxelGrid) -> Array:
    """(n, 3) float64: the mean of the points of each cell where the grid has it (property ``mean``), else the centroids."""
    mean = grid.properties.get("mean")
    return grid.centroids() if mean is None else np.asarray(mean, np.float64)


def _is_slice(grid: VoxelGrid) -> bool:
    return float(np.ptp(grid.cells[:, 2]) + 1) * grid.edge <= SLICE


def levels(grid: VoxelGrid) -> list[tuple[float, float, float]]:
    """(floor, ceiling, base) of each storey, m, lowest first: nan where not seen; bands are counted from the base.

    A floor and its ceiling bound empty columns; where hardly any column has both, the largest level is a floor if most of the
    map lies above it, else a ceiling.
    """
    middle = grid.origin[2] + (grid.cells[:, 2].astype(np.float64) + 0.5) * grid.edge
    if _is_slice(grid):
        z = float(np.median(cell_middles(grid)[:, 2]))
        return [(z - NOMINAL[1], np.nan, z - NOMINAL[2])]
    bottom, top = _gaps(grid)
    columns = len(np.unique(grid.cells[:, 0].astype(np.int64) * grid.shape[1] + grid.cells[:, 1]))
    if len(bottom) > 0.15 * columns:
        return _closed(grid, bottom, top)
    area = np.convolve(np.bincount(grid.cells[:, 2], minlength=grid.shape[2]), np.ones(3), "same")
    level = int(area.argmax())
    z = grid.origin[2] + (level + 0.5) * grid.edge
    above, below = int((grid.cells[:, 2] > level + 2).sum()), int((grid.cells[:, 2] < level - 2).sum())
    return [(z, np.nan, z)] if above >= below else [(np.nan, z, z - NOMINAL[0])]


def _gaps(grid: VoxelGrid) -> tuple[Array, Array]:
    """Levels of the cells below and above each run of empty cells of at least `GAP` in a column."""
    x, y, z = grid.cells.T.astype(np.int64)
    key = np.sort((x * grid.shape[1] + y) * (1 << 21) + z)
    step = np.diff(key)
    wide = (step > GAP / grid.edge) & (key[1:] >> 21 == key[:-1] >> 21)
    mask = (1 << 21) - 1
    return key[:-1][wide] & mask, key[1:][wide] & mask


def _closed(grid: VoxelGrid, bottom: Array, top: Array) -> list[tuple[float, float, float]]:
    area = np.convolve(np.bincount(bottom, minlength=grid.shape[2]).astype(float), np.ones(3), "same") * grid.edge**2
    least = min(max(LEAST_AREA, LEAST_SHARE * area.max()), area.max())
    floors: list[int] = []
    for z in np.argsort(-area, kind="stable"):
        if area[z] < least:
            break
        if all(abs(int(z) - f) * grid.edge >= GAP for f in floors):
            floors.append(int(z))
    found = []
    for z in sorted(floors):
        near = np.abs(bottom - z) * grid.edge <= 0.25
        floor = grid.origin[2] + (float(bottom[near].mean()) + 0.5) * grid.edge
        ceiling = grid.origin[2] + (float(np.median(top[near])) + 0.5) * grid.edge
        found.append((floor, ceiling, floor))
    return found


def _local_floor(ix: Array, iy: Array, z: Array, heights: Array) -> Array:
    """The floor under each column: drift and a tilted map raise and lower it by a few centimetres."""
    near = np.abs(z - heights[ix, iy]) < 0.3
    where = (ix[near], iy[near])
    many, total = np.zeros(heights.shape, np.float32), np.zeros(heights.shape, np.float32)
    np.add.at(many, where, 1.0)
    np.add.at(total, where, (z[near] - heights[where]).astype(np.float32))
    cells = FLAT / CELL
    many, total = (ndimage.gaussian_filter(i, cells, truncate=2.0) for i in (many, total))
    return heights + np.where(many > 0.02, total / np.maximum(many, 1e-6), 0.0)


def _ceiling(ix: Array, iy: Array, z: Array, base: float, ceiling: float, shape: tuple[int, ...]) -> Array:
    """(H, W) m: the highest cell of each column that may be this storey's ceiling; nan where none is."""
    high = np.full(shape, -np.inf)
    if np.isfinite(ceiling):
        near = (z > base + 2.0) & (z < ceiling + 1.0)
        np.maximum.at(high, (ix[near], iy[near]), z[near])
    return np.where(np.isfinite(high), high, np.nan)


def _plan(
    occupied: Array, crossed: Array, origin: Array, cell: float, floor: float, ceiling: float, height: Array, sliced: bool
) -> Plan:
    bands = _observed(occupied)
    body, walls = _mask(*BODY), _mask(*WALL) & bands
    need = max(int(np.ceil(FILLED * int(walls).bit_count())), 1)
    own = _count(occupied & np.uint32(walls))
    around = _count(_spread(occupied) & np.uint32(walls))
    wall = (own >= need) | ((own >= max(need - 1, 1)) & (around >= need + 1)) if need > 1 else own >= 1
    standing = (occupied & np.uint32(body)) > 0
    shut = (occupied & np.uint32(_mask(0, 3) | _mask(BODY[1], 32))) > 0
    rays = _count(crossed & np.uint32(body)) >= max(int(body & bands).bit_count() // 2, 1)
    if sliced:
        wall &= ~_small(wall, cell)
    free = ~standing & (rays | (shut & (not sliced)))
    return Plan(origin, cell, wall, free, standing & ~wall, floor, ceiling, occupied, int(bands), height, sliced)


def _small(mask: Array, cell: float) -> Array:
    """Groups of columns that are too short for a wall: legs and chairs."""
    label, _ = ndimage.label(ndimage.binary_dilation(mask, np.ones((3, 3))), np.ones((3, 3)))
    boxes = ndimage.find_objects(label)
    size = np.array([0.0] + [np.hypot(*(s.stop - s.start for s in box)) * cell for box in boxes])
    small: Array = mask & (size[label] < SHORT)
    return small


def _mask(first: int, last: int) -> int:
    return (1 << last) - (1 << first)


def _observed(bits: Array) -> int:
    """Bands that hold enough to say that the map looked there."""
    many = np.array([int(((bits >> np.uint32(k)) & UNIT).sum()) for k in range(*BODY)])
    kept = np.flatnonzero(many >= OBSERVED * max(int(many.max()), 1)) + BODY[0]
    return int(sum(1 << int(k) for k in kept)) if many.max() else 0


def _count(bits: Array) -> Array:
    """Number of bits set in each column."""
    out: Array = np.bitwise_count(bits)
    return out


def _spread(bits: Array) -> Array:
    """Bits of each column or any of its four neighbours: a noisy wall is spread over columns."""
    out = bits.copy()
    out[1:] |= bits[:-1]
    out[:-1] |= bits[1:]
    out[:, 1:] |= bits[:, :-1]
    out[:, :-1] |= bits[:, 1:]
    return out
