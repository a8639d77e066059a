"""Sparse voxel octree: range, radius and level-of-detail queries on a voxel grid (seeds 2.2.1)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from topomerge.kernels import morton, octree
from topomerge.types import VoxelGrid

Array = NDArray[Any]
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

    def codes(self, level: int) -> Array:
        """(m,) uint64 Morton codes of a level's octants, 0 <= level <= depth: a parent's is a child's without its 3 low bits."""
        if not 0 <= level <= self.depth:
            raise ValueError(f"the octree has levels 0..{self.depth}, not {level}")
        first = self._nodes.first
        return self._nodes.codes[first[level - 1] : first[level]] if level else self.grid.codes

    def range(self, low: Array, high: Array) -> Array:
        """(m,) int64 rows of the cells of a box, low <= cell < high along each axis; both (3,) integers."""
        low, high = np.asarray(low, np.int64), np.asarray(high, np.int64)
        if low.shape != (3,) or high.shape != (3,):
            raise ValueError(f"a box needs two cells (3,), not {low.shape} and {high.shape}")
        return octree.in_box(self.grid.cells, self._nodes, low, high)

    def radius(self, centre: Array, r: float) -> Array:
        """(m,) int64 rows of the cells whose centroids lie within r m of a centre (see `radius_many`)."""
        centre = np.asarray(centre)
        if centre.shape != (3,):
            raise ValueError(f"a centre must be (3,), not {centre.shape}")
        return self.radius_many(centre[None], r)[1]

    def radius_many(self, centres: Array, r: float) -> tuple[Array, Array]:
        """Radius queries around many centres at once, on all cores; up to 64 stay on the core that asks.

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
        return octree.in_balls(self.grid.cells, self._nodes, table, in_cells, r / self.grid.edge + RADIUS_SLACK)

    def level_of_detail(self, k: int) -> VoxelGrid:
        """The grid k levels up, edge * 2**k, with the property ``count``: occupied cells in each octant; k in 0..21.

        Above the root, of which there is but one, the octants grow until they hold the whole volume.
        """
        if not 0 <= k <= morton.BITS:
            raise ValueError(f"a level of detail must lie in 0..{morton.BITS}, not {k}")
        if k == 0 or not len(self.grid):
            codes, count = self.grid.codes, np.ones(len(self.grid), np.int64)
        elif k < self.depth:
            nodes, levels = self._nodes, slice(*self._nodes.first[k - 1 : k + 1])
            codes, count = nodes.codes[levels], np.diff(nodes.span[levels], axis=1)[:, 0]
        else:
            codes, count = self.grid.codes[:1] >> np.uint64(3 * k), np.array([len(self.grid)])
        x, y, z = (-(-s >> k) for s in self.grid.shape)
        cells = morton.decode(codes)
        return VoxelGrid(cells, self.grid.origin, self.grid.edge * 2**k, (x, y, z), {"count": count})
