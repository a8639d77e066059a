"""Visibility from views: rays through a sparse voxel octree (seeds 2.5)."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from topomerge.kernels import octree, rays, voxels
from topomerge.types import Array, VoxelGrid, compute_extent

# Sparse voxel octree: range, radius and level-of-detail queries on a voxel grid (seeds 2.2.1).

RADIUS_SLACK = 1e-6  # cells: a cell that lies exactly at the radius counts, whatever the last bit of its distance says


@dataclass(frozen=True, eq=False)
class SparseVoxelOctree:
    """The octree of a grid: its Morton order in buckets of 8 codes, those again, until one is left: the root (seeds 2.2.1).

    A query goes down from the root, leaves out octants outside and takes those inside whole: an octant is a range of rows.
    Rows come out in ascending order. The thesis' views ask it: for the neighbours of a cell of the distance field within a
    radius (seeds 2.4.1) and for the cells in range of a view (seeds 2.5).
    """

    grid: VoxelGrid
    _nodes: octree.Nodes = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_nodes", octree.build(self.grid.cells, self.grid.codes))

    @property
    def depth(self) -> int:
        """Levels above the leaves; the last one holds only the root. 0 for an empty grid."""
        return len(self._nodes.first) - 1

    def compute_codes(self, level: int) -> Array:
        """Return (m,) uint64 Morton codes of a level's octants, 0 <= level <= depth: a parent's is a child's without its 3 low
        bits."""
        if not 0 <= level <= self.depth:
            raise ValueError(f"the octree has levels 0..{self.depth}, not {level}")
        first = self._nodes.first
        return self._nodes.codes[first[level - 1] : first[level]] if level else self.grid.codes

    def find_in_box(self, low: Array, high: Array) -> Array:
        """Return (m,) int64 rows of the cells of a box, low <= cell < high along each axis; both (3,) integers."""
        low, high = np.asarray(low, np.int64), np.asarray(high, np.int64)
        if low.shape != (3,) or high.shape != (3,):
            raise ValueError(f"a box needs two cells (3,), not {low.shape} and {high.shape}")
        return octree.find_in_box(self.grid.cells, self._nodes, low, high)

    def find_in_radius(self, centre: Array, r: float) -> Array:
        """Return (m,) int64 rows of the cells whose centroids lie within r m of a centre (see `find_in_radius_many`)."""
        centre = np.asarray(centre)
        if centre.shape != (3,):
            raise ValueError(f"a centre must be (3,), not {centre.shape}")
        return self.find_in_radius_many(centre[None], r)[1]

    def find_in_radius_many(self, centres: Array, r: float) -> tuple[Array, Array]:
        """Run radius queries around many centres at once, on all cores; up to 64 stay on the core that asks.

        Args:
            centres: (q, 3); integers are cells, of which the centroid is meant, floats are points in metres.
            r: m, 0 or more; the same for all. A cell exactly at r counts.

        Returns:
            indptr (q + 1,) int64 and rows: ``rows[indptr[i] : indptr[i + 1]]`` are the cells near centre i. Their number
            grows with q r**2 to q r**3: cut very many queries into blocks.

        Raises:
            ValueError: a radius below 0 or not finite, centres of another shape.
        """
        centres = np.asarray(centres)
        if centres.ndim != 2 or centres.shape[1] != 3:
            raise ValueError(f"centres must be (q, 3), not {centres.shape}")
        if not 0 <= r < np.inf:
            raise ValueError(f"a radius must be finite and not below 0 m, not {r}")
        if not np.issubdtype(centres.dtype, np.integer):
            centres = (centres.astype(np.float64) - self.grid.origin) / self.grid.edge - 0.5
        in_cells, table = np.ascontiguousarray(centres, np.float64), self.grid._bricks[0]
        return octree.find_in_balls(self.grid.cells, self._nodes, table, in_cells, r / self.grid.edge + RADIUS_SLACK)

    def build_level_of_detail(self, k: int) -> VoxelGrid:
        """Return the grid k levels up, edge * 2**k, with the property ``count``: occupied cells in each octant; k in 0..21.

        Above the root, of which there is but one, the octants grow until they hold the whole volume.
        """
        if not 0 <= k <= voxels.BITS:
            raise ValueError(f"a level of detail must lie in 0..{voxels.BITS}, not {k}")
        if k == 0 or not len(self.grid):
            codes, count = self.grid.codes, np.ones(len(self.grid), np.int64)
        elif k < self.depth:
            nodes, levels = self._nodes, slice(*self._nodes.first[k - 1 : k + 1])
            codes, count = nodes.codes[levels], np.diff(nodes.span[levels], axis=1)[:, 0]
        else:
            codes, count = self.grid.codes[:1] >> np.uint64(3 * k), np.array([len(self.grid)])
        x, y, z = (-(-s >> k) for s in self.grid.shape)
        cells = voxels.decode(codes)
        return VoxelGrid(cells, self.grid.origin, self.grid.edge * 2**k, (x, y, z), {"count": count})


# Visibility: which cells each view sees (seeds 2.5).

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

    def get_rows(self, view: int) -> Array:
        """Return ascending rows of the cells that one view sees."""
        part = slice(self.indptr[view], self.indptr[view + 1])
        bits = np.unpackbits(self.masks[part].astype("<u8").view(np.uint8).reshape(-1, 8), axis=1, bitorder="little")
        word, bit = np.nonzero(bits)
        return self.words[part][word].astype(np.int64) * 64 + bit

    def count_cells(self) -> Array:
        """Return (V,) int64 number of cells that each view sees."""
        running = np.concatenate([[0], np.cumsum(np.bitwise_count(self.masks), dtype=np.int64)])
        return np.diff(running[self.indptr])


def find_visible_cells(
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
    return _join_tiles(parts, len(views), len(grid))


def _cast_tile(octree: SparseVoxelOctree, views: Array, radius: float) -> tuple[Array, Array, Array]:
    """Return counts a view, words and masks for the views of one tile."""
    grid = octree.grid
    at, reach = (views - grid.origin) / grid.edge, radius / grid.edge
    margin = int(np.ceil(reach)) + 1
    view_cells = np.floor(at).astype(np.int64)
    first, last = compute_extent(view_cells)
    low, high = first - margin, last + margin + 1
    window = grid.cells[octree.find_in_box(low, high)]
    if len(window):  # it need not be higher or wider than what is in it
        lowest, highest = compute_extent(window)
        low = np.maximum(low, np.minimum(lowest, first))
        high = np.minimum(high, np.maximum(highest, last) + 1)
    field = rays.compute_distance_field(window, low, (int(high[0] - low[0]), int(high[1] - low[1]), int(high[2] - low[2])))
    counts, words, masks = [], [], []
    for begin in range(0, len(at), VIEWS_AT_ONCE):
        block = slice(begin, begin + VIEWS_AT_ONCE)
        near, rows = octree.find_in_radius_many(views[block], radius)
        room = rays.count_words(near, rows)
        indptr = np.concatenate([[0], np.cumsum(room)])
        word, mask = np.empty(indptr[-1], np.int32), np.empty(indptr[-1], np.uint64)
        count = rays.cast(field, low, at[block], reach, grid.cells, near, rows, indptr, word, mask)
        used = np.arange(indptr[-1]) < np.repeat(indptr[:-1] + count, room)
        counts.append(count)
        words.append(word[used])
        masks.append(mask[used])
    return np.concatenate(counts), np.concatenate(words), np.concatenate(masks)


def _join_tiles(parts: list[tuple[Array, Array, Array, Array]], views: int, cells: int) -> Visibility:
    """Join the tiles' results in the order of the views."""
    counts = np.zeros(views, np.int64)
    for group, count, _, _ in parts:
        counts[group] = count
    indptr = np.concatenate([[0], np.cumsum(counts)])
    words, masks = np.empty(indptr[-1], np.int32), np.empty(indptr[-1], np.uint64)
    for group, count, part_words, part_masks in parts:
        place = np.repeat(indptr[group] - (np.cumsum(count) - count), count) + np.arange(len(part_words))
        words[place], masks[place] = part_words, part_masks
    return Visibility(indptr, words, masks, cells)
