"""Many maps and where they lie -> one map: cells are fused one map after the other, rooms and doors found once, at the end.

Maps whose heights were assumed (slices and drawings, extruded) add only what no other map saw: what stands on the floor of a room
would become a wall that fills it. They still say that they saw the cells of others that lie in theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy import ndimage

from topomerge.errors import InputError
from topomerge.extraction.convolution import convolve, moore
from topomerge.extraction.extract import COARSEST, FINEST, PRESETS, extract
from topomerge.fusion.fuse import ALIKE, MOST, resampled
from topomerge.fusion.storey_plan import extruded
from topomerge.kernels import morton
from topomerge.types import Array, Sim3, TopometricMap, VoxelGrid

BESIDE = 0.3  # m around what other maps saw: there an extruded wall is one of theirs that is a little off
SHIFT = 1 << 20  # cells are counted from there, as codes hold no negative ones


class Several(Protocol):
    """Maps that are loaded when they are asked for."""

    def __getitem__(self, k: int, /) -> TopometricMap: ...


@dataclass(eq=False)
class _Whole:
    """What is joined so far: cells by their codes, ascending, and which maps saw them; codes of the free ones."""

    origin: Array
    edge: float
    codes: Array
    bits: Array
    free: Array

    def add(self, cells: Array, bits: Array) -> None:
        """Further cells (n, 3) and their bit sets."""
        codes = np.concatenate([self.codes, morton.encode((cells + SHIFT).astype(np.int32))])
        self.codes, owner = np.unique(codes, return_inverse=True)
        every = np.zeros(len(self.codes), np.uint32)
        np.bitwise_or.at(every, owner, np.concatenate([self.bits, bits]))
        self.bits = every

    def known(self, cells: Array) -> Array:
        """(n,) bool: is a cell there already?"""
        return np.isin(morton.encode((cells + SHIFT).astype(np.int32)), self.codes)

    def seen(self, cells: Array) -> Array:
        """(n,) bool: have the columns of cells, at the heights between the lowest and the highest of them, anything near?"""
        own = morton.decode(self.codes).astype(np.int64) - SHIFT
        low, high = cells[:, 2].min(), cells[:, 2].max()
        own = own[(own[:, 2] >= low - 3) & (own[:, 2] <= high + 3)]
        if not len(own):
            return np.zeros(len(cells), bool)
        corner = np.minimum(own.min(axis=0), cells.min(axis=0))[:2]
        shape = np.maximum(own.max(axis=0), cells.max(axis=0))[:2] - corner + 1
        mask = np.zeros(shape, bool)
        mask[tuple((own[:, :2] - corner).T)] = True
        mask = ndimage.binary_dilation(mask, iterations=max(round(BESIDE / self.edge), 1))
        found: Array = mask[tuple((cells[:, :2] - corner).T)]
        return found


def join_many(maps: Several, poses: Sequence[tuple[int, Sim3]]) -> TopometricMap:
    """The joined map in the frame of the first one.

    Args:
        maps: loaded one at a time.
        poses: which maps, with T_0k; the first is the identity.

    Raises:
        InputError: more maps than provenance can tell apart.
    """
    about = [_about(maps[k]) for k, _ in poses]
    starts = np.cumsum([0, *(count for _, count, _, _ in about)])
    if starts[-1] > MOST:
        raise InputError(f"{len(poses)} maps are joined of {starts[-1]}; at most {MOST} can be told apart in one")
    first = maps[poses[0][0]]
    none = np.zeros(0, np.uint64)
    whole = _Whole(first.grid.origin, _edge(about, poses), none, np.zeros(0, np.uint32), none)
    order = sorted(range(len(poses)), key=lambda n: about[n][3])  # what was assumed comes last
    for n in order:
        k, pose = poses[n]
        _fused(whole, maps[k], pose, int(starts[n]), about[n][3] and n != order[0])
    return _extracted(whole, min(usual for usual, _, _, _ in about), " + ".join(maps[k].source or "map" for k, _ in poses))


def _about(m: TopometricMap) -> tuple[float, int, float, bool]:
    """Usual number of neighbours of a cell, number of provenance bits, edge length, and whether heights were assumed."""
    bits = 1 if m.provenance is None else max(int(np.bitwise_or.reduce(m.provenance, initial=0)).bit_length(), 1)
    return _usual(m.grid), bits, m.grid.edge, extruded(m.grid)


def _edge(about: Sequence[tuple[float, int, float, bool]], poses: Sequence[tuple[int, Sim3]]) -> float:
    """m, of the joined cells: of the first map, unless another one's are clearly finer (as `fuse.fuse`)."""
    edge = about[0][2]
    for (_, _, own, assumed), (_, pose) in zip(about, poses, strict=True):
        if not assumed and pose.scale * own < ALIKE * edge:
            edge = pose.scale * own
    return float(np.clip(edge, FINEST, COARSEST))


def _fused(whole: _Whole, m: TopometricMap, pose: Sim3, start: int, assumed: bool) -> None:
    """Add a map whose first bit is `start`."""
    own = np.ones(len(m.grid), np.uint32) if m.provenance is None else m.provenance.astype(np.uint32)
    cells, rows = resampled(m.grid, pose, whole.origin, whole.edge)
    bits = own[rows] << np.uint32(start)
    if assumed and len(cells):
        kept = whole.known(cells) | ~whole.seen(cells)
        cells, bits = cells[kept], bits[kept]
    whole.add(cells, bits)
    if m.free is not None:
        free = resampled(m.free, pose, whole.origin, 2 * whole.edge)[0]
        whole.free = np.union1d(whole.free, morton.encode((free + SHIFT).astype(np.int32)))


def _extracted(whole: _Whole, usual: float, name: str) -> TopometricMap:
    """Rooms and doors of what was joined."""
    cells = morton.decode(whole.codes).astype(np.int64) - SHIFT
    base = 2 * (cells.min(axis=0) // 2)  # even: free cells are twice as long
    grid = VoxelGrid.from_cells(cells - base, whole.origin + base * whole.edge, whole.edge)
    provenance = np.zeros(len(grid), np.uint32)
    provenance[grid.rows(cells - base)] = whole.bits
    empty = morton.decode(whole.free).astype(np.int64) - SHIFT - base // 2
    empty = empty[((empty >= 0) & (empty < -(-np.array(grid.shape) // 2))).all(axis=1)]
    x, y, z = (-(-s // 2) for s in grid.shape)
    free = VoxelGrid.from_cells(empty, grid.origin, 2 * grid.edge, (x, y, z)) if len(whole.free) else None
    free = free and free.subset(~grid.coarser(2).contains(free.cells))
    noise = PRESETS["default"].noise * min(usual / max(_usual(grid), 1.0), 1.0)  # as `fuse._noise`, of many
    found = extract(grid, name=name, carve=free is None, noise=noise)
    rows = grid.rows(grid.locate(found.grid.centroids()))
    seen = np.where(rows >= 0, provenance[rows], 0).astype(np.uint32)
    return replace(found, provenance=seen, free=found.free if free is None else free)


def _usual(grid: VoxelGrid) -> float:
    """Median number of occupied neighbours of a cell."""
    return float(np.median(convolve(grid, moore()))) if len(grid) else 0.0
