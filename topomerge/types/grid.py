"""The occupied cells of a regular grid (seeds 2.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from topomerge.kernels import lookup, morton, stencil
from topomerge.types.arrays import Array, require


def _extent(cells: Array) -> tuple[Array, Array]:
    columns = cells.T  # a reduction along the rows is four times slower
    return np.array([c.min() for c in columns]), np.array([c.max() for c in columns])


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """Occupied cells of a regular grid with properties (seeds 2.2).

    Cells are unique, not negative and stand in Morton order; ``origin`` is the seeds' V_min and ``edge`` their e_l.

    Args:
        cells: (n, 3) int32, sorted by Morton code (see `from_cells` for cells in any order).
        origin: (3,) float64, the corner of cell (0, 0, 0).
        edge: edge length of a cell, m.
        shape: number of cells along each axis; V_max = origin + shape * edge.
        properties: name -> (n, ...) array.
    """

    cells: Array
    origin: Array
    edge: float
    shape: tuple[int, int, int]
    properties: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require(self.edge > 0 and np.isfinite(self.edge), f"edge length must be above 0 m, not {self.edge}")
        require(np.shape(self.origin) == (3,) and bool(np.isfinite(self.origin).all()), f"origin must be (3,), not {self.origin}")
        require(self.cells.ndim == 2 and self.cells.shape[1] == 3, f"cells must be (n, 3), not {self.cells.shape}")
        require(self.cells.dtype == np.int32, f"cells must be int32, not {self.cells.dtype}")
        require(all(0 < s <= morton.AXIS_LIMIT for s in self.shape), f"grid shape {self.shape} is outside 1..{morton.AXIS_LIMIT}")
        if len(self.cells):
            low, high = _extent(self.cells)
            require(bool((low >= 0).all() and (high < self.shape).all()), f"cells {low}..{high} outside {self.shape}")
            require(bool((self.codes[1:] > self.codes[:-1]).all()), "cells must be unique and in Morton order")
        for name, values in self.properties.items():
            require(len(values) == len(self.cells), f"property {name} must have one row a cell")

    @staticmethod
    def from_cells(
        cells: Array,
        origin: Array | None = None,
        edge: float = 0.1,
        shape: tuple[int, int, int] | None = None,
        properties: Mapping[str, Array] | None = None,
    ) -> VoxelGrid:
        """A grid from cells in any order; a repeated cell comes once, with the properties of their first mention."""
        cells = np.asarray(cells).reshape(-1, 3)
        if len(cells):  # before the codes: they hold 21 bits an axis, and a cell beyond would take the place of another
            require(np.issubdtype(cells.dtype, np.integer), f"cells must be integers, not {cells.dtype}")
            low, high = _extent(cells)
            inside = bool((low >= 0).all() and (high < morton.AXIS_LIMIT).all())
            require(inside, f"cells {low}..{high} not in 0..{morton.AXIS_LIMIT}")
        cells = np.ascontiguousarray(cells, np.int32)
        first = morton.unique_rows(morton.encode(cells))
        unique_cells = np.ascontiguousarray(cells[first])
        if shape is None:
            shape = tuple(int(s) + 1 for s in high) if len(unique_cells) else (1, 1, 1)  # type: ignore[assignment]
        assert shape is not None
        origin = np.zeros(3) if origin is None else np.asarray(origin, np.float64)
        return VoxelGrid(unique_cells, origin, edge, shape, {k: v[first] for k, v in (properties or {}).items()})

    def __len__(self) -> int:
        return len(self.cells)

    @cached_property
    def codes(self) -> Array:
        """(n,) uint64 Morton codes, ascending."""
        return morton.encode(self.cells)

    @cached_property
    def _bricks(self) -> tuple[Array, Array]:
        return lookup.build(self.cells, self.shape)

    @cached_property
    def _columns(self) -> Array:
        return stencil.columns(self.cells, *self._bricks)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """V_min and V_max, m."""
        return self.origin, self.origin + np.asarray(self.shape) * self.edge

    def cell_bounds(self, cells: Array) -> tuple[Array, Array]:
        """Corners v_min and v_max of cells, m."""
        low = self.origin + np.asarray(cells) * self.edge
        return low, low + self.edge

    def centroids(self, cells: Array | None = None) -> Array:
        """(n, 3) float64 centres v_c of the given cells, or of all."""
        return self.origin + (np.asarray(self.cells if cells is None else cells) + 0.5) * self.edge

    def locate(self, points: Array) -> Array:
        """(n, 3) int64 cells v_p that hold the given points; outside the bounds they are negative or beyond `shape`."""
        return np.floor((np.asarray(points, np.float64) - self.origin) / self.edge).astype(np.int64)

    def rows(self, cells: Array) -> Array:
        """(m,) int64 row of each given cell, -1 where it is not occupied."""
        return lookup.rows(*self._bricks, np.ascontiguousarray(cells, np.int64).reshape(-1, 3))

    def contains(self, cells: Array) -> Array:
        """(m,) bool: is the cell occupied?"""
        return self.rows(cells) >= 0

    def subset(self, mask: Array) -> VoxelGrid:
        """The same volume with only the masked cells (bool mask or ascending row numbers)."""
        cells = np.ascontiguousarray(self.cells[mask])
        return replace(self, cells=cells, properties={k: v[mask] for k, v in self.properties.items()})

    def with_cells(self, cells: Array, properties: Mapping[str, Array] | None = None) -> VoxelGrid:
        """Other cells (any order) of the same volume."""
        return VoxelGrid.from_cells(cells, self.origin, self.edge, self.shape, properties)

    def coarser(self, factor: int) -> VoxelGrid:
        """The cells, `factor` times as long, in which one or more of these lie; without properties."""
        x, y, z = (-(-s // factor) for s in self.shape)
        return VoxelGrid.from_cells(self.cells // factor, self.origin, self.edge * factor, (x, y, z))

    def with_properties(self, **properties: Array) -> VoxelGrid:
        """The same cells with more properties."""
        grid = replace(self, properties={**self.properties, **properties})
        for index in ("_bricks", "_columns"):  # of the cells, which stay: don't make it twice
            if index in self.__dict__:
                grid.__dict__[index] = self.__dict__[index]
        return grid
