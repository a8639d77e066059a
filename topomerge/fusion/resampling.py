"""Cells of a moved, perhaps bent map on the lattice of another one.

A cell of the lattice is occupied where its middle lies in a cell of the moved map, and where the middle of a cell of the moved
map lies in it. So no cell is lost, and a turned or bent floor or wall gets no holes.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from topomerge.extraction.cleaning import compute_cell_means
from topomerge.kernels import registration as kernel
from topomerge.kernels import run_in_slices, voxels
from topomerge.kernels.voxels import build, find_filled_cells, find_unique_rows
from topomerge.types import Array, Placement, Sim3, VoxelGrid, are_within, compute_extent
from topomerge.types.placement import BETWEEN_STOREYS, Deformation

RESAMPLED_AT_ONCE = 200_000  # cells
SLACK = 0.02  # of a bent cell, by which neighbours overlap: each is taken as linear by itself
JACOBIAN_STEP = 0.02  # m
FILLED_WEIGHT = 0.01  # of the points of a cell where they only fill a neighbour of the cell that they lie in
CODE_OFFSET = 1 << 20  # cells are counted from there, as Morton codes hold no negative ones
COPY_REACH = 0.25  # m between a wall and its copy, at most
AROUND = 8  # cells about the walls, of which free ones are asked for
LEAST_CELLS = 4096  # that a thread looks at
THINLY_SPREAD = 8  # columns of the cells' rectangle for each cell
Seen = tuple[Array, Array]


def resample_cells(grid: VoxelGrid, placement: Placement | Sim3, origin: Array, edge: float) -> tuple[Array, Array]:
    """Return cells (n, 3) int64 of a lattice that the moved cells of a grid fill, and the row (n,) of one that does.

    Args:
        placement: of the grid in the frame of the lattice.
        origin: (3,) m, corner of the lattice's cell (0, 0, 0); cells may be negative.
        edge: of the lattice's cells, m.
    """
    placement = Placement(placement) if isinstance(placement, Sim3) else placement
    offset = (grid.origin - origin) / edge
    aligned = abs(grid.edge - edge) < 1e-9 and np.allclose(offset, np.round(offset), atol=1e-6)
    if aligned and placement.bend is None and placement.pose == Sim3():
        return grid.cells + np.round(offset).astype(np.int64), np.arange(len(grid))
    if not len(grid):
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    parts = [
        _find_filled_cells(grid, slice(n, n + RESAMPLED_AT_ONCE), placement, origin, edge)
        for n in range(0, len(grid), RESAMPLED_AT_ONCE)
    ]
    cells, rows = (np.concatenate(p) for p in zip(*parts, strict=True))
    first = find_unique_rows(encode_cells(cells))
    return cells[first], rows[first]


def _find_filled_cells(grid: VoxelGrid, chosen: slice, placement: Placement, origin: Array, edge: float) -> tuple[Array, Array]:
    """Return what `resample_cells` does of some cells; cells may come twice."""
    pose, ratio = placement.pose, placement.pose.scale * grid.edge / edge
    wide = ratio * _find_stretch(placement.bend) * np.sqrt(0.5) + pose.scale * _find_slant(placement.bend, grid.edge) / edge
    places = grid.compute_centroids(grid.cells[chosen])
    bent, local = _linearise(placement.bend, grid.cells[chosen], places, grid)
    holding = np.floor((pose.apply(bent) - origin) / edge).astype(np.int64)  # the cells that the middles lie in
    back = pose.inverse().matrix
    matrix = np.column_stack([back[:3, :3] * edge, back[:3, :3] @ origin + back[:3, 3] - grid.origin]) / grid.edge
    slack = SLACK if len(local) else 0.0
    own, reach = grid.cells[chosen], (int(wide + 0.5), int(ratio / 2 + 0.5))

    def fill(first: int, last: int) -> tuple[Array, Array]:
        of = slice(first, last)
        cells, rows = find_filled_cells(own[of], holding[of], matrix, local[of], slack, *reach)
        return cells, rows + first

    cells, rows = (np.concatenate(part) for part in zip(*run_in_slices(fill, len(own), LEAST_CELLS), strict=True))
    return np.concatenate([cells, holding]), np.concatenate([rows, np.arange(len(holding))]) + chosen.start


def _linearise(bend: Deformation | None, cells: Array, places: Array, grid: VoxelGrid) -> tuple[Array, Array]:
    """Return where bending moves the middles (n, 3) of cells (n, 3) of a grid, and the bending about them as
    `kernels.voxels.find_filled_cells` takes it: (n, 8), or (0, 8) where nothing is bent. Of one storey it is the same for all
    cells of a column, and computed once."""
    if bend is None:
        return places, np.zeros((0, 8))
    if len(bend.fields) > 1:
        return _linearise_places(bend, places, grid)
    first, column = _find_columns(cells)
    moved, local = _linearise_places(bend, places[first], grid)
    bent = places.copy()
    bent[:, :2] = moved[column, :2]
    return bent, local[column]


def _linearise_places(bend: Deformation, places: Array, grid: VoxelGrid) -> tuple[Array, Array]:
    """Run `_linearise` place by place."""
    bent = bend.apply(places)
    steps = np.eye(3) * JACOBIAN_STEP
    x, y, z = ((bend.apply(places + step) - bent)[:, :2] / JACOBIAN_STEP for step in steps)
    area = x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]
    back = np.column_stack([y[:, 1], -y[:, 0], -x[:, 1], x[:, 0]]) / area[:, None]
    lean = np.column_stack([(back[:, 2 * k : 2 * k + 2] * z).sum(axis=1) for k in (0, 1)])
    return bent, np.column_stack([(bent - grid.origin)[:, :2] / grid.edge, back, lean])


def _find_columns(cells: Array) -> tuple[Array, Array]:
    """Return (c,) row of a cell (n, 3) of each column, and (n,) the column of each cell; each cell by itself where they are too
    thinly spread for a raster."""
    at = cells[:, :2].astype(np.int64)
    low, high = compute_extent(at)
    at -= low
    size = int(high[0] - low[0] + 1), int(high[1] - low[1] + 1)
    rows = np.arange(len(cells))
    if size[0] * size[1] > THINLY_SPREAD * len(cells):
        return rows, rows
    flat = at[:, 0] * size[1] + at[:, 1]
    first = np.full(size[0] * size[1], -1)
    first[flat] = rows
    columns = np.flatnonzero(first >= 0)
    number = np.zeros_like(first)
    number[columns] = np.arange(len(columns))
    return first[columns], number[flat]


def _find_stretch(bend: Deformation | None) -> float:
    """Return by what factor a length in the plane grows at most, the scale of the pose apart."""
    steep = 0.0
    for field in bend.fields if bend is not None else ():
        if field is not None:
            both = [np.linalg.norm(np.diff(field.shifts, axis=k), axis=-1).max(initial=0.0) for k in (0, 1)]
            steep = max(steep, float(max(both)) / field.step)
    return 1.0 + 1.4143 * steep


def _find_slant(bend: Deformation | None, edge: float) -> float:
    """Return the distance, m in the plane, by which the ends of a cell as high as `edge` part from its middle, between storeys
    that move apart."""
    if bend is None or len(bend.floors) < 2:
        return 0.0
    return 2 * bend.farthest * min(edge / (2 * BETWEEN_STOREYS), 1.0)


def transform_means(
    grid: VoxelGrid, placement: Placement, rows: Array, cells: Array, origin: Array, edge: float
) -> tuple[Array, Array]:
    """Return (n, 3) 0..1 where in the cells of a lattice the points of moved cells lie on average, and (n,) how many points say
    so.

    The mean of a moved cell that fills a neighbour, too, lies outside of that: there its nearest place in the cell is taken, and
    counts little. Of cells whose points are not known nothing is said.

    Args:
        rows: (n,) of the grid's cells that fill the cells (n, 3) of the lattice, as of `resample_cells`.
    """
    if "offset" not in grid.properties:
        return np.full((len(cells), 3), 0.5), np.zeros(len(cells))
    within = (placement.transform_points(compute_cell_means(grid))[rows] - origin) / edge - cells
    inside = np.clip(within, 0, 1)
    same = inside == within
    points = np.asarray(grid.properties.get("count", np.ones(len(grid))), np.float64)[rows]
    return inside, points * np.where(same[:, 0] & same[:, 1] & same[:, 2], 1.0, FILLED_WEIGHT)


def encode_cells(cells: Array) -> Array:
    """Return (n,) uint64, one code for each cell within a million of the origin."""
    return voxels.encode((cells + CODE_OFFSET).astype(np.int32))


def unite_codes(*codes: Array) -> Array:
    """Return all codes, ascending, each once."""
    every = np.concatenate(codes)
    united: Array = every[find_unique_rows(every)]
    return united


def decode_cells(codes: Array) -> Array:
    """Return (n, 3) int64, the cells of `encode_cells`."""
    cells: Array = voxels.decode(codes).astype(np.int64) - CODE_OFFSET
    return cells


def find_wall_copies(first: Seen, second: Seen, edge: float) -> Array:
    """Return (n,) int64 row of the cell of the first map's wall of which each cell of the second map is a copy, -1 none.

    Args:
        first, second: cells (n, 3) of one lattice that a map shows, and the free cells (m, 3), twice as long, of the lattice on
            the same corner.
        edge: m, of a cell.
    """
    reach = int(COPY_REACH / edge + 1e-6)
    flat = range(-reach, reach + 1)
    near = [(x, y) for x, y in product(flat, flat) if 0 < np.hypot(x, y) * edge <= COPY_REACH + 1e-6]
    if not near:
        return np.full(len(second[0]), -1, np.int64)
    offsets = np.array(sorted(near, key=lambda o: (o[0] ** 2 + o[1] ** 2, o)), np.int64)
    lows, highs = zip(compute_extent(first[0]), compute_extent(second[0]), strict=True)
    low = 2 * ((np.minimum(*lows) - AROUND) // 2)
    high = np.maximum(*highs) + AROUND + 1 - low
    tables = [_build_table(cells - low, high) for cells in (first[0], second[0])]
    tables += [_build_table(cells - low // 2, high // 2 + 1) for cells in (first[1], second[1])]
    cells = np.ascontiguousarray(second[0] - low)

    def find(first: int, last: int) -> Array:
        copies: Array = kernel.find_copied_cells(cells[first:last], offsets, *tables)
        return copies

    return np.concatenate(run_in_slices(find, len(cells), LEAST_CELLS))


def _build_table(cells: Array, size: Array) -> tuple[Array, Array]:
    """Build the look-up (`kernels.voxels.build`) of those cells that lie in a volume of so many cells."""
    inside = are_within(cells, 0, size)
    x, y, z = size.tolist()
    return build(np.ascontiguousarray(cells[inside]), (x, y, z))
