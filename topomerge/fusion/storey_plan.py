"""Map -> plans: what each storey shows from above. Walls, empty space and clutter are what registration goes by (method 3).

A *wall* column is filled at most of the heights between 0.5 and 2.0 m above the floor; a *free* one has a floor or a ceiling and
nothing between, or rays crossed it; the rest of the occupied ones are *clutter*. Works for scans, extruded drawings, and slices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from topomerge.errors import InputError
from topomerge.kernels.plan import column_bits, on_lines
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
LEVELS = 12  # of one size: a map of lines that were given walls has as many, at least
LAYER = 0.1  # share of the cells that a layer of a map of slices holds at least
NOMINAL = (2.7, 0.3, 1.375)  # m: floor to ceiling; a slice's height above the floor; and the height at which slices are drawn
FLAT = 1.5  # m, radius over which the floor may rise and fall
STRAIGHT = 1.2  # m; what a slice shows in no straight run of this length is furniture
BESIDE = 0.35  # m from such a run, and on one side of it at least, hardly anything stands
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
        high, low: (H, W) float32, heights of the ceiling (nan: none) and of the floor (a guess where it was not seen), m.
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
    high: Array
    low: Array
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
    if extruded(grid):
        grid, free = _lines(grid)
    cell = max(cell, grid.edge)
    points = cell_middles(grid)
    corner = grid.origin[:2]  # columns are those of the cells: on another lattice some get two rows of cells, and some none
    low = np.floor((points[:, :2].min(axis=0) - corner) / cell + 1e-6).astype(np.int64)
    columns = np.floor((points[:, :2] - corner) / cell + 1e-6).astype(np.int64) - low
    corner = corner + low * cell
    shape = tuple((columns.max(axis=0) + 1).tolist())
    ix, iy = np.ascontiguousarray(columns.T)
    empty = None if free is None or not len(free) else _crossed(free, corner, cell)
    layers, found = slices(grid), []
    storeys = [(z - NOMINAL[1], np.nan, z - NOMINAL[2]) for z in layers] if layers else levels(grid)
    for floor, ceiling, base in storeys:
        z, crossing = points[:, 2], empty
        if layers:  # all that is near the layer is drawn at one height
            level = base + NOMINAL[2]
            z = np.where(np.abs(z - level) <= SLICE / 2, level, np.nan)
            crossing = empty and (*empty[:2], np.where(np.abs(empty[2] - level) <= SLICE / 2, level, np.nan))
        heights = np.full(shape, base)
        if np.isfinite(floor) and not layers:
            heights = _local_floor(ix, iy, z, heights)
        occupied = column_bits(ix, iy, z, heights, LOW, BAND)
        crossed = column_bits(*crossing, heights, LOW, BAND) if crossing else np.zeros(shape, np.uint32)
        high = _ceiling(ix, iy, z, base, ceiling, shape)
        found.append(_plan(occupied, crossed, corner, cell, floor, ceiling, (high, heights), bool(layers)))
    return found


def _crossed(free: VoxelGrid, corner: Array, cell: float) -> tuple[Array, Array, Array]:
    """Columns ix, iy and heights, m, of empty cells; one that is wider than a column is in several."""
    side = max(round(free.edge / cell), 1)
    at = free.centroids()
    steps = (np.arange(side) - (side - 1) / 2) * free.edge / side
    parts = [np.floor((at[:, :2] + (dx, dy) - corner) / cell + 1e-6).astype(np.int64) for dx in steps for dy in steps]
    ix, iy = np.ascontiguousarray(np.concatenate(parts).T)
    return ix, iy, np.tile(at[:, 2], side**2)


def cell_middles(grid: VoxelGrid) -> Array:
    """(n, 3) float64: the mean of the points of each cell where the grid has it (property ``mean``), else the centroids."""
    mean = grid.properties.get("mean")
    return grid.centroids() if mean is None else np.asarray(mean, np.float64)


def with_means(grid: VoxelGrid, points: Array) -> VoxelGrid:
    """The grid with the property ``mean``, the middle of the points (N, 3), m, of each cell: heights of ceilings and the fine
    registration gain from it (cells alone are known to half an edge)."""
    rows = grid.rows(grid.locate(points))
    points, rows = np.asarray(points, np.float64)[rows >= 0], rows[rows >= 0]
    many = np.bincount(rows, minlength=len(grid))[:, None]
    total = np.column_stack([np.bincount(rows, points[:, k], len(grid)) for k in range(3)])
    return grid.with_properties(mean=np.where(many > 0, total / np.maximum(many, 1), grid.centroids()))


def extruded(grid: VoxelGrid) -> bool:
    """Was a map made from lines, which were given walls? Then all of its levels but the lowest hold the same columns."""
    if not len(grid):
        return False
    level = grid.cells[:, 2] - grid.cells[:, 2].min()
    many = np.bincount(level)[1:]
    if len(many) < LEVELS or (many != many[0]).any():
        return False
    first = grid.cells[level == 1, :2]
    return all(np.array_equal(grid.cells[level == k, :2], first) for k in range(2, len(many) + 1))


def _lines(grid: VoxelGrid) -> tuple[VoxelGrid, VoxelGrid]:
    """The lines of such a map at the height of the floor that it was given, where its sensor looked; and that floor, over which
    it looked."""
    level = grid.cells[:, 2] - grid.cells[:, 2].min()
    lines, floor = grid.cells[level == 1] - (0, 0, 1), grid.cells[level == 0]
    kept = VoxelGrid.from_cells(lines, grid.origin, grid.edge, grid.shape)
    return kept, VoxelGrid.from_cells(floor[~kept.contains(floor)], grid.origin, grid.edge, grid.shape)


def slices(grid: VoxelGrid) -> list[float]:
    """Heights of the layers of a map that was seen at one height a storey only, lowest first; none for other maps.

    Nearly all cells lie in a few thin layers, and these show lines, where floors and ceilings would show areas.
    """
    z = cell_middles(grid)[:, 2]
    if float(np.ptp(z)) + grid.edge <= SLICE:
        return [] if _filled(grid.cells, grid.edge) else [float(np.median(z))]
    thick = max(round(SLICE / 2 / grid.edge), 1)
    many = np.convolve(np.bincount(grid.cells[:, 2], minlength=grid.shape[2]), np.ones(thick), "same")
    layers: list[int] = []
    for k in np.argsort(-many, kind="stable"):
        if many[k] < LAYER * len(grid):
            break
        if all(abs(int(k) - other) * grid.edge >= GAP for other in layers):
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
        found = _closed(grid, bottom, top)
        if found:
            return found
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
    level = np.bincount(grid.cells[:, 2], minlength=grid.shape[2])
    near, far = round(0.3 / grid.edge), round(1.6 / grid.edge)
    for z in np.argsort(-area, kind="stable"):
        if area[z] < least:
            break
        # An upper side of a ceiling, as a map shows that lacks all that is low, has hardly anything standing on it.
        hollow = level[z + near : z + far].sum() < 0.5 * level[max(z - far, 0) : max(z - near, 0)].sum()
        if not hollow and all(abs(int(z) - f) * grid.edge >= GAP for f in floors):
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
    lowest = np.full(heights.shape, np.inf)
    np.minimum.at(lowest, (ix[near], iy[near]), z[near])
    seen = np.isfinite(lowest)
    many = seen.astype(np.float32)
    total = np.where(seen, lowest - heights, 0.0).astype(np.float32)
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
    occupied: Array,
    crossed: Array,
    origin: Array,
    cell: float,
    floor: float,
    ceiling: float,
    heights: tuple[Array, Array],
    sliced: bool,
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
        wall = _straight(wall, cell)
    free = ~standing & (rays | (shut & (not sliced)))
    high, low = (h.astype(np.float32) for h in heights)
    return Plan(origin, cell, wall, free, standing & ~wall, floor, ceiling, occupied, int(bands), high, low, sliced)


def _straight(mask: Array, cell: float) -> Array:
    """What a slice shows of walls: straight runs beside which little stands. Legs and chairs are as dense, but stand in heaps."""
    angles = np.pi * np.arange(24) / 24
    long = max(round(STRAIGHT / cell), 3)
    found: Array = on_lines(mask, np.cos(angles), np.sin(angles), long, long - 1, max(round(BESIDE / cell), 2))
    return found


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
