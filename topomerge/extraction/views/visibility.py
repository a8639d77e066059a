"""Visibility: which cells each view sees (seeds 2.5)."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from topomerge.extraction.octree import SparseVoxelOctree
from topomerge.kernels import raycast
from topomerge.types import Array, VoxelGrid

VIEW_TILE = 10.0  # m: views of one tile share a distance field, tiles are shared among the cores
VIEWS_AT_ONCE = 64  # whose cells in range are held at a time: some 20,000 each


@dataclass(frozen=True, eq=False)
class Visibility:
    """The cells that each of V views sees: sorted sets of rows as bits, 64 rows a word.

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
    grid: VoxelGrid, views: Array, radius: float, progress: Callable[[float, str], None] | None = None
) -> Visibility:
    """Cast a ray from every view to the centroid of every occupied cell within `radius` m (seeds 2.5).

    A cell is seen if the ray enters no other occupied cell before it. The cell that a view stands in never blocks. The octree
    finds the cells in range (seeds 2.2.1).

    Args:
        grid: occupied cells.
        views: (V, 3) positions, m.
        radius: range of the theoretical scanner, m.
        progress: called with the share done and a text.
    """
    octree = SparseVoxelOctree(grid)
    views = np.asarray(views, np.float64).reshape(-1, 3)
    tile = np.floor((views - grid.origin) / grid.edge / (VIEW_TILE / grid.edge)).astype(np.int64)
    tiles, tile_of = np.unique(tile, axis=0, return_inverse=True)
    groups = [np.flatnonzero(tile_of.ravel() == t) for t in range(len(tiles))]
    parts: list[tuple[Array, Array, Array, Array]] = []
    done = 0
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:  # the compiled loops let go of the interpreter
        cast = pool.map(lambda group: _cast_tile(octree, views[group], radius), groups)
        for group, part in zip(groups, cast, strict=True):
            parts.append((group, *part))
            done += len(group)
            if progress is not None:
                progress(done / len(views), "visibility")
    return _joined(parts, len(views), len(grid))


def _cast_tile(octree: SparseVoxelOctree, views: Array, radius: float) -> tuple[Array, Array, Array]:
    """Counts a view, words and masks for the views of one tile."""
    grid = octree.grid
    at, reach = (views - grid.origin) / grid.edge, radius / grid.edge
    margin = int(np.ceil(reach)) + 1
    view_cells = np.floor(at).astype(np.int64)
    low, high = view_cells.min(axis=0) - margin, view_cells.max(axis=0) + margin + 1
    window = grid.cells[octree.range(low, high)]
    if len(window):  # it need not be higher or wider than what is in it
        low = np.maximum(low, np.minimum(window.min(axis=0), view_cells.min(axis=0)))
        high = np.minimum(high, np.maximum(window.max(axis=0), view_cells.max(axis=0)) + 1)
    field = raycast.distance_field(window, low, (int(high[0] - low[0]), int(high[1] - low[1]), int(high[2] - low[2])))
    counts, words, masks = [], [], []
    for begin in range(0, len(at), VIEWS_AT_ONCE):
        block = slice(begin, begin + VIEWS_AT_ONCE)
        near, rows = octree.radius_many(views[block], radius)
        room = raycast.words_of(near, rows)
        indptr = np.concatenate([[0], np.cumsum(room)])
        word, mask = np.empty(indptr[-1], np.int32), np.empty(indptr[-1], np.uint64)
        count = raycast.cast(field, low, at[block], reach, grid.cells, near, rows, indptr, word, mask)
        used = np.arange(indptr[-1]) < np.repeat(indptr[:-1] + count, room)
        counts.append(count)
        words.append(word[used])
        masks.append(mask[used])
    return np.concatenate(counts), np.concatenate(words), np.concatenate(masks)


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
