"""Two maps and where one lies in the other -> one map: cells are fused, rooms and doors found anew (seeds 3.3; method.md, 3).

Cells of b are resampled: a cell of the joined grid is occupied where its middle lies in a cell of b, and where the middle of a
cell of b lies in it. So no cell of b is lost, and a turned floor or wall gets no holes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from topomerge.errors import InputError
from topomerge.extraction.convolution import convolve, moore
from topomerge.extraction.extract import COARSEST, FINEST, PRESETS, extract
from topomerge.matching.consistency import matches_under, storey_map
from topomerge.matching.door_poses import Poses
from topomerge.matching.topdown import top_down
from topomerge.types import Array, Sim3, TopometricMap, VoxelGrid

ALIKE = 0.8  # edges of cells that differ by less keep those of a
AT_ONCE = 200_000  # cells that are resampled at once
MOST = 32  # maps that one bit set tells apart


@dataclass(frozen=True, eq=False)
class Fused:
    """Cells of two maps in the frame of the first.

    Args:
        grid: occupied in either.
        provenance: (n,) uint32 bit set of the maps that saw each cell: bit 0 for a, bit 1 for b; maps that are joined already
            keep their bits, those of b following those of a.
        free: cells known to be empty in one of the maps and occupied in none, of the same origin; None where neither knows any.
        contested: how many of the free cells of one map are occupied in the other. Occupied wins: what moves (doors, chairs,
            people) stands where it was seen, and is no evidence of empty space.
    """

    grid: VoxelGrid
    provenance: Array
    free: VoxelGrid | None
    contested: int = 0


def fuse(a: TopometricMap, b: TopometricMap, transform: Sim3) -> Fused:
    """Cells of both maps on the lattice of a, at the finer of the two edge lengths.

    Args:
        transform: T_ab.

    Raises:
        InputError: more maps together than a bit set holds.
    """
    edge = _edge(a, b, transform)
    moved = [resampled(m.grid, pose, a.grid.origin, edge) for m, pose in ((a, Sim3()), (b, transform))]
    every = np.concatenate([cells for cells, _ in moved])
    base = 2 * (every.min(axis=0) // 2) if len(every) else np.zeros(3, np.int64)  # even: free cells are twice as long
    origin = a.grid.origin + base * edge
    grid = VoxelGrid.from_cells(every - base, origin, edge)
    provenance = np.zeros(len(grid), np.uint32)
    for (cells, rows), bits in zip(moved, _bits(a, b), strict=True):
        provenance[grid.rows(cells - base)] |= bits[rows]
    free, contested = _free(a, b, transform, grid)
    return Fused(grid, provenance, free, contested)


def join(a: TopometricMap, b: TopometricMap, transform: Sim3) -> TopometricMap:
    """The joined map in a's frame: cells fused, rooms and doors extracted again.

    Args:
        transform: T_ab.
    """
    fused = fuse(a, b, transform)
    name = f"{a.source or 'a'} + {b.source or 'b'}"
    found = extract(fused.grid, name=name, carve=fused.free is None, noise=_noise(a, b, fused.grid))
    # Floors that the extraction assumes under slices are cells that no map saw.
    rows = fused.grid.rows(fused.grid.locate(found.grid.centroids()))
    provenance = np.where(rows >= 0, fused.provenance[rows], 0).astype(np.uint32)
    return replace(found, provenance=provenance, free=found.free if fused.free is None else fused.free)


def rooms_in_common(a: TopometricMap, b: TopometricMap, transform: Sim3) -> tuple[Array, Array]:
    """(M, 2) rooms of a and of b that are one room under a transform, and (M,) 0..1 how much of their floor they share.

    A room that is cut in two in the other map is in two rows.
    """
    if not len(a.rooms) or not len(b.rooms):
        return np.zeros((0, 2), np.int64), np.zeros(0)
    plans = (top_down(a), top_down(b))
    pose = Poses(np.array([transform.yaw]), np.array([transform.translation]), np.array([transform.scale]), np.ones(1))
    return matches_under(transform, plans, storey_map(pose, plans[0].floors, plans[1].floors)[0])


def room_of_rooms(part: TopometricMap, joined: TopometricMap, pose: Sim3) -> Array:
    """(R,) room of the joined map in which most of the floor of each room of a part lies, -1 none.

    Args:
        pose: of the part in the joined map.
    """
    found = np.full(len(part.rooms), -1, np.int64)
    inside = part.navigable_room >= 0
    cells = joined.navigable.locate(pose.apply(part.navigable.centroids(part.navigable.cells[inside])))
    room = np.full(len(cells), -1, np.int64)
    for up in (0, 1, -1, 2, -2):  # floors of two maps are seldom at one height to a cell
        rows = joined.navigable.rows(cells + (0, 0, up))
        unknown = (room < 0) & (rows >= 0)
        room[unknown] = joined.navigable_room[rows[unknown]]
    for i, own in enumerate(np.split(*_by_room(part.navigable_room[inside], room, len(part.rooms)))[: len(part.rooms)]):
        own = own[own >= 0]
        if len(own):
            found[i] = np.bincount(own).argmax()
    return found


def _by_room(owner: Array, values: Array, count: int) -> tuple[Array, Array]:
    """Values sorted by their owner, and where each next owner begins."""
    order = np.argsort(owner, kind="stable")
    return values[order], np.cumsum(np.bincount(owner, minlength=count))


def resampled(grid: VoxelGrid, pose: Sim3, origin: Array, edge: float) -> tuple[Array, Array]:
    """Cells (n, 3) int64 of a lattice that the moved cells of a grid fill, and the row (n,) of one that does.

    Args:
        pose: of the grid in the frame of the lattice.
        origin: (3,) m, corner of the lattice's cell (0, 0, 0); cells may be negative.
        edge: of the lattice's cells, m.
    """
    offset = (grid.origin - origin) / edge
    if pose == Sim3() and abs(grid.edge - edge) < 1e-9 and np.allclose(offset, np.round(offset), atol=1e-6):
        return grid.cells + np.round(offset).astype(np.int64), np.arange(len(grid))
    parts = list(_resampled(grid, pose, origin, edge))
    if not parts:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    cells = np.concatenate([c for c, _ in parts])
    rows = np.concatenate([r for _, r in parts])
    _, first = np.unique(_codes(cells), return_index=True)
    return cells[first], rows[first]


def _resampled(grid: VoxelGrid, pose: Sim3, origin: Array, edge: float) -> Iterator[tuple[Array, Array]]:
    ratio = pose.scale * grid.edge / edge
    wide, tall = int(ratio * np.sqrt(0.5) + 0.5), int(ratio / 2 + 0.5)  # how far a cell reaches from the one its middle is in
    flat = range(-wide, wide + 1)
    around = np.array(list(product(flat, flat, range(-tall, tall + 1))))
    back = pose.inverse()
    for start in range(0, len(grid), AT_ONCE):
        at = pose.apply(grid.centroids(grid.cells[start : start + AT_ONCE]))
        own = np.floor((at - origin) / edge).astype(np.int64)
        cells = (own[:, None] + around).reshape(-1, 3)
        cells = cells[np.unique(_codes(cells), return_index=True)[1]]
        rows = grid.rows(grid.locate(back.apply(origin + (cells + 0.5) * edge)))
        yield cells[rows >= 0], rows[rows >= 0]
        yield own, np.arange(start, start + len(own))


def _codes(cells: Array) -> Array:
    """(n,) int64, one number for each cell within a million of the origin."""
    x, y, z = (cells + (1 << 20)).T
    codes: Array = (x << 42) | (y << 21) | z
    return codes


def _edge(a: TopometricMap, b: TopometricMap, transform: Sim3) -> float:
    """m, of the joined cells."""
    other = transform.scale * b.grid.edge
    return float(np.clip(a.grid.edge if other >= ALIKE * a.grid.edge else other, FINEST, COARSEST))


def _noise(a: TopometricMap, b: TopometricMap, joined: VoxelGrid) -> float:
    """The preset's share of the usual number of neighbours below which a cell is noise, for the joined cells: where both maps saw
    a place cells are dense, and floors that only the sparser one saw must not count as noise beside them."""
    usual = [float(np.median(convolve(grid, moore()))) if len(grid) else 0.0 for grid in (a.grid, b.grid, joined)]
    return PRESETS["default"].noise * min(min(usual[:2]) / max(usual[2], 1.0), 1.0)


def _bits(a: TopometricMap, b: TopometricMap) -> tuple[Array, Array]:
    """(n,) uint32 bit sets of the cells of both maps, so that no map of one has the bit of a map of the other."""
    own = [np.ones(len(m.grid), np.uint32) if m.provenance is None else m.provenance.astype(np.uint32) for m in (a, b)]
    count = [max(int(np.bitwise_or.reduce(bits, initial=0)).bit_length(), 1) for bits in own]
    if sum(count) > MOST:
        raise InputError(f"{a.source} and {b.source}: are joined of {sum(count)} maps; at most {MOST} can be told apart in one")
    return own[0], own[1] << np.uint32(count[0])


def _free(a: TopometricMap, b: TopometricMap, transform: Sim3, grid: VoxelGrid) -> tuple[VoxelGrid | None, int]:
    """Free cells of both, twice as long as the occupied ones, and how many of them are occupied in the other map."""
    edge = 2 * grid.edge
    parts = [resampled(m.free, pose, grid.origin, edge)[0] for m, pose in ((a, Sim3()), (b, transform)) if m.free is not None]
    if not parts:
        return None, 0
    every = np.concatenate(parts)
    shape = tuple(-(-s // 2) for s in grid.shape)
    every = every[((every >= 0) & (every < shape)).all(axis=1)]
    free = VoxelGrid.from_cells(every, grid.origin, edge, (shape[0], shape[1], shape[2]))
    taken = grid.coarser(2).contains(free.cells)
    return free.subset(~taken), int(taken.sum())
