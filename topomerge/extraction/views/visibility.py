"""Visibility: which cells each view sees (seeds 2.5)."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from topomerge.kernels import raycast
from topomerge.types import Array, VoxelGrid

TILE = 10.0  # m: views of one tile share a distance field, tiles are shared among the cores


@dataclass(frozen=True, eq=False)
class Visibility:
    """The cells that each of V views sees: sorted sets of rows, kept as bits, 64 rows a word.

    Rows stand in Morton order, so neighbours in space share words: a set of ten thousand cells takes about 5 kB.
    """

    indptr: Array  # (V + 1,) int64
    words: Array  # (k,) int32, ascending within a view
    masks: Array  # (k,) uint64
    cells: int  # number of cells of the grid

    def __len__(self) -> int:
        return len(self.indptr) - 1

    def rows(self, view: int) -> Array:
        """Ascending rows of the cells that one view sees."""
        part = slice(self.indptr[view], self.indptr[view + 1])
        bits = np.unpackbits(self.masks[part].astype("<u8").view(np.uint8).reshape(-1, 8), axis=1, bitorder="little")
        word, bit = np.nonzero(bits)
        return self.words[part][word].astype(np.int64) * 64 + bit

    def sizes(self) -> Array:
        """(V,) int64 number of cells that each view sees."""
        running = np.concatenate([[0], np.cumsum(np.bitwise_count(self.masks), dtype=np.int64)])
        return np.diff(running[self.indptr])

    def matrix(self) -> sparse.csr_array:
        """(V, n) sparse matrix of ones where a view sees a cell."""
        rows = [self.rows(v) for v in range(len(self))]
        indptr = np.concatenate([[0], np.cumsum([len(r) for r in rows])])
        indices = np.concatenate(rows) if rows else np.zeros(0, np.int64)
        return sparse.csr_array((np.ones(len(indices), np.int64), indices, indptr), shape=(len(self), self.cells))


def visible_cells(
    grid: VoxelGrid,
    views: Array,
    radius: float,
    tolerance: float = 0.0,
    progress: Callable[[float, str], None] | None = None,
) -> Visibility:
    """Cast a ray from every view to the centroid of every occupied cell within `radius` m (seeds 2.5).

    A cell is seen if the ray enters no other occupied cell before it. The cell that a view stands in never blocks.

    Args:
        grid: occupied cells.
        views: (V, 3) positions, m.
        radius: range of the theoretical scanner, m.
        tolerance: occupied cells entered at most this far (m, along the ray's main axis) before the target's centre don't
            block it. A noisy wall is several cells thick: without this its far side is never seen.
        progress: called with the share done and a text.
    """
    at = (np.asarray(views, np.float64).reshape(-1, 3) - grid.origin) / grid.edge
    reach, slack = radius / grid.edge, tolerance / grid.edge
    table = grid._bricks[0]
    starts = np.concatenate([np.flatnonzero(np.diff(grid.codes >> np.uint64(9), prepend=~np.uint64(0))), [len(grid)]])
    tile = np.floor(at / (TILE / grid.edge)).astype(np.int64)
    tiles, of_view = np.unique(tile, axis=0, return_inverse=True)
    of_view = of_view.ravel()
    parts: list[tuple[Array, Array, Array, Array]] = []
    done = 0
    groups = [np.flatnonzero(of_view == t) for t in range(len(tiles))]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:  # the compiled loops let go of the interpreter
        cast = pool.map(lambda group: _cast_tile(grid.cells, table, starts, at[group], reach, slack), groups)
        for group, part in zip(groups, cast, strict=True):
            parts.append((group, *part))
            done += len(group)
            if progress is not None:
                progress(done / len(at), "visibility")
    return _joined(parts, len(at), len(grid))


def _cast_tile(cells: Array, table: Array, starts: Array, views: Array, reach: float, slack: float) -> tuple[Array, Array, Array]:
    """Counts a view, words and masks for the views of one tile."""
    margin = int(np.ceil(reach)) + 1
    view_cells = np.floor(views).astype(np.int64)
    low = view_cells.min(axis=0) - margin
    high = view_cells.max(axis=0) + margin + 1
    middle = (low + high) / 2
    found = raycast.bricks_in_range(table, middle, float(np.linalg.norm(high - low) / 2))
    if len(found):
        rows = np.concatenate([np.arange(starts[b], starts[b + 1]) for b in found])
        near = cells[rows]
        near = near[((near >= low) & (near < high)).all(axis=1)]
        if len(near):  # the window need not be higher or wider than what is in it
            low = np.maximum(low, np.minimum(near.min(axis=0), view_cells.min(axis=0)))
            high = np.minimum(high, np.maximum(near.max(axis=0), view_cells.max(axis=0)) + 1)
    size = (int(high[0] - low[0]), int(high[1] - low[1]), int(high[2] - low[2]))
    field = raycast.distance_field(found, starts, cells, low, size)
    room = raycast.room_for_words(views, reach, starts, table)
    indptr = np.concatenate([[0], np.cumsum(room)])
    words, masks = np.empty(indptr[-1], np.int32), np.empty(indptr[-1], np.uint64)
    counts = raycast.cast(field, low, views, reach, slack, cells, starts, table, indptr, words, masks)
    used = np.arange(indptr[-1]) < np.repeat(indptr[:-1] + counts, room)
    return counts, words[used], masks[used]


def _joined(parts: list[tuple[Array, Array, Array, Array]], views: int, cells: int) -> Visibility:
    """Tiles' results in the order of the views."""
    counts = np.zeros(views, np.int64)
    for group, count, _, _ in parts:
        counts[group] = count
    indptr = np.concatenate([[0], np.cumsum(counts)])
    words, masks = np.empty(indptr[-1], np.int32), np.empty(indptr[-1], np.uint64)
    for group, count, part_words, part_masks in parts:
        place = np.repeat(indptr[group] - (np.cumsum(count) - count), count) + np.arange(len(part_words))
        words[place], masks[place] = part_words, part_masks
    return Visibility(indptr, words, masks, cells)
