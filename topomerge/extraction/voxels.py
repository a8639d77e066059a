"""Points -> voxel grid (seeds 2.2): one chunk at a time, so that a cloud may be larger than memory."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from numbers import Real

import numpy as np

from topomerge.errors import InputError
from topomerge.extraction.cleaning import compute_box_volume, select_largest_place, select_without_strays
from topomerge.kernels import count_threads, voxels
from topomerge.kernels import occupied_cells as kernel
from topomerge.types import Array, PointCloud, VoxelGrid, are_within, compute_extent

# Lattice cells of a cloud that comes in chunks: 40 bytes a cell, and at most two and a half times that while runs are united.

RUN_RATIO = 4  # a run is united with the one before it unless that is more than so many times as long
FAR_RATIO = 2  # likewise for cells that no code numbers
BLOCK = 1_000_000  # cells that are looked at together
ORIGIN_POINTS = 10_000  # about the middle of which cells are numbered
_Cells = tuple[
    Array, Array, Array
]  # cells (n, 3) or their codes (n,), counts (n,), sums (n, 3): `kernels.occupied_cells.find_occupied_cells`


class LatticeCells:
    """Lattice cells of chunks that come one after the other, each with the number of its points and where they lie.

    Cells are numbered by Morton codes about the middle of the first chunk, which reach a million cells to all sides; the few
    beyond (strays) stand apart.

    Args:
        edge: of a cell, m.
        most: cells that are held; of a larger cloud there are none. 0: any number.
        twice: a lattice of cells twice as long, which takes in each chunk with this one: its cells are made of these.
    """

    def __init__(self, edge: float, most: int = 0, twice: LatticeCells | None = None) -> None:
        self.edge, self.most, self.twice = edge, most, twice
        self.too_many = False
        self._origin: Array | None = None
        self._runs: list[_Cells] = []  # by ascending codes, each run far longer than the next one
        self._far: list[_Cells] = []

    def add(self, chunk: PointCloud) -> None:
        """Take in the cells of a chunk."""
        shift = np.asarray(chunk.shift, np.float64)
        if self._origin is None:
            self._origin = _choose_origin(chunk.points, shift, self.edge)
            if self._origin is None:
                return
            if self.twice is not None:
                self.twice._origin = self._origin // 2
        if self.too_many:
            run = None
        else:
            run = kernel.find_occupied_codes(chunk.points, shift, self.edge, self._origin, self.twice is not None)
            if run is None:
                self._add_cells(*kernel.find_occupied_cells(chunk.points, shift, self.edge))
        if self.twice is not None:
            self.twice.add(chunk) if run is None else self.twice._add_run(kernel.double_cells(run))
        if run is not None:
            self._add_run((run[0], run[1], np.ascontiguousarray(run[2][:, :3])))

    def _add_cells(self, base: Array, cells: Array, counts: Array, sums: Array) -> None:
        """Take in cells (n, 3), in any order and at any place."""
        assert self._origin is not None
        cells += base
        numbers = cells - self._origin
        near = bool(numbers.min(initial=0) >= 0 and numbers.max(initial=0) < voxels.AXIS_LIMIT)
        if not near:
            inside = are_within(numbers, 0, voxels.AXIS_LIMIT)
            self._far.append((cells[~inside], counts[~inside], sums[~inside]))
            if sum(len(part[0]) for part in self._far[1:]) * FAR_RATIO > len(self._far[0][0]):
                self._far = [_unite_cells(self._far)]
            numbers, counts, sums = numbers[inside], counts[inside], sums[inside]
        codes = voxels.encode(numbers)
        order = voxels.find_unique_rows(codes)
        self._add_run((codes[order], counts[order], sums[order]))

    def _add_run(self, run: _Cells) -> None:
        """Take in cells by ascending codes."""
        self._runs.append(run)
        while len(self._runs) > 1 and len(self._runs[-2][0]) <= RUN_RATIO * len(self._runs[-1][0]):
            self._runs[-2:] = [kernel.unite_runs(self._runs[-2], self._runs[-1])]
        if self.most and len(self._runs[0][0]) > self.most:
            self.too_many, self._runs, self._far = True, [], []

    def get_cells(self) -> _Cells:
        """Return cells (n, 3), counts (n,) and sums (n, 3) of the places of points within them, in `OFFSET_STEPS` parts."""
        if self._origin is None:
            return np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros((0, 3), np.int64)
        codes, counts, sums = self._unite_runs()
        near = voxels.decode(codes) + self._origin, counts, sums
        if not self._far:
            return near
        cells, counts, sums = (np.concatenate(part) for part in zip(near, _unite_cells(self._far), strict=True))
        return cells, counts, sums

    def select_within(self, grid: VoxelGrid) -> VoxelGrid | None:
        """Return the cells in the box of a grid of whole multiples of them; None where they were too many."""
        if self.too_many or self._origin is None:
            return None
        codes, counts, sums = self._unite_runs()
        if self.most and len(codes) > self.most:
            return None
        base = np.rint(grid.origin / self.edge).astype(np.int64) - self._origin
        size = np.array(grid.shape) * round(grid.edge / self.edge)
        cells, offsets = [np.zeros((0, 3), np.int32)], [np.zeros((0, 3), np.uint8)]
        for first in range(0, len(codes), BLOCK):
            block = slice(first, first + BLOCK)
            numbers = voxels.decode(codes[block]) - base
            inside = are_within(numbers, 0, size)
            cells.append(numbers[inside].astype(np.int32))
            offsets.append(_compute_offsets(sums[block][inside], counts[block][inside]))
        shape = (int(size[0]), int(size[1]), int(size[2]))
        return VoxelGrid.from_cells(np.concatenate(cells), grid.origin, self.edge, shape, {"offset": np.concatenate(offsets)})

    def _unite_runs(self) -> _Cells:
        while len(self._runs) > 1:
            self._runs[-2:] = [kernel.unite_runs(self._runs[-2], self._runs[-1])]
        return self._runs[0]


def _choose_origin(points: Array, shift: Array, edge: float) -> Array | None:
    """Return (3,) cell far below the middle of a chunk, a multiple of 16; None of a chunk without a finite point."""
    for step in (max(len(points) // ORIGIN_POINTS, 1), 1):
        some = points[::step]
        some = some[np.isfinite(some).all(axis=1)]
        if len(some):
            middle = np.floor((np.median(some.astype(np.float64), axis=0) + shift) / edge).astype(np.int64)
            return (middle >> 4 << 4) - voxels.AXIS_LIMIT // 2
    return None


def _compute_offsets(sums: Array, counts: Array) -> Array:
    """Return (n, 3) uint8 means of sums (n, 3) over counts (n,), rounded half up: by floats, which are exact for whole numbers of
    this size, as processors divide these several times faster."""
    return ((sums + counts[:, None] // 2) / counts[:, None]).astype(np.uint8)


def _unite_cells(parts: list[_Cells]) -> _Cells:
    """Return the cells, which may be in several parts, each once."""
    cells, counts, sums = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    cells, row = np.unique(cells, axis=0, return_inverse=True)
    total = (np.bincount(row.ravel(), weights, len(cells)).astype(np.int64) for weights in (counts, *sums.T))
    number, *axes = total
    return cells, number, np.column_stack(axes)


log = logging.getLogger(__name__)


def voxelise(
    cloud: PointCloud | Array | Iterable[PointCloud],
    edge: float = 0.1,
    warnings: list[str] | None = None,
    fine: LatticeCells | None = None,
) -> VoxelGrid:
    """Return the occupied cells of a point cloud, with the properties ``count``, the number of points in each, and ``offset``,
    where in it they lie on average (`compute_cell_means`).

    V_min is a multiple of the edge length, so the cells of a cloud do not depend on what else is in the file or on its order.

    Args:
        cloud: a cloud, (N, 3) points in metres, or chunks of one cloud.
        edge: edge length of a cell, m.
        warnings: what the user should know is appended here.
        fine: takes in the same chunks.

    Raises:
        InputError: no finite point, or an extent that no building has.
    """
    if not (isinstance(edge, Real) and 0.001 <= edge <= 10):
        raise InputError(f"voxel size must be a number between 0.001 and 10 (m), not {edge!r}")
    if isinstance(cloud, PointCloud):
        chunks: Iterable[PointCloud] = [cloud]
    elif isinstance(cloud, np.ndarray):
        chunks = [PointCloud(cloud)]
    else:
        chunks = cloud
    lattice = LatticeCells(edge)
    if fine is not None and 2 * fine.edge == edge:
        fine.twice = lattice
        _add_chunks(chunks, [fine])
    else:
        _add_chunks(chunks, [lattice] if fine is None else [lattice, fine])
    cells, counts, sums = lattice.get_cells()
    if not len(cells):
        raise InputError("no finite point: nothing to voxelise")
    for separate in (select_without_strays, select_largest_place):
        kept, warning = separate(cells, counts, edge)
        if warning:
            warn(warnings, warning)
            cells, counts, sums = cells[kept], counts[kept], sums[kept]
    base, shape = _compute_box(cells)
    if (shape > voxels.AXIS_LIMIT).any() or compute_box_volume(cells) / 512 > voxels.MAX_BRICKS:
        extent = " x ".join(f"{s * edge:.0f}" for s in shape)
        check = "check --unit, --scale or --resolution, or crop the file"
        raise InputError(f"the points span {extent} m: too large for {edge:g} m voxels; {check}")
    size = (int(shape[0]), int(shape[1]), int(shape[2]))
    properties = {"count": counts, "offset": _compute_offsets(sums, counts)}
    return VoxelGrid.from_cells(cells - base, base * edge, edge, size, properties)


def _add_chunks(chunks: Iterable[PointCloud], lattices: Sequence[LatticeCells]) -> None:
    """Add chunks to lattices, each in a thread while the next chunk is read."""
    if count_threads() == 1:
        for chunk in chunks:
            for lattice in lattices:
                lattice.add(chunk)
        return
    with ThreadPoolExecutor(len(lattices)) as temporary:
        before: list[Future[None]] = []
        for chunk in chunks:
            for done in before:
                done.result()
            before = [temporary.submit(lattice.add, chunk) for lattice in lattices]
        for done in before:
            done.result()


def _compute_box(cells: Array) -> tuple[Array, Array]:
    low, high = compute_extent(cells)
    return low, high - low + 1


def warn(warnings: list[str] | None, message: str) -> None:
    """Keep a warning for the map that is being made, or log it where there is none."""
    if warnings is None:
        log.warning("%s", message)
    else:
        warnings.append(message)
