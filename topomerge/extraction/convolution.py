"""Voxel convolution: a new value for each cell from its neighbourhood (seeds 2.3.1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from topomerge.kernels import stencil
from topomerge.types import VoxelGrid

Array = NDArray[Any]
LENGTH_SLACK = 1e-6  # cells: 0.3 m are three cells of 0.1 m, whatever the last bit of the quotient says


@dataclass(frozen=True, eq=False)
class Kernel:
    """A voxel grid with a weight for each voxel and an origin voxel (seeds 2.3.1).

    A cell of weight 0 takes no part in any function: for a sum this is the seeds' formula, for a maximum it means that
    an origin of weight 0 does not hold the result at 0 or above.

    Args:
        cells: (k, 3) int32, unique and not negative.
        weights: (k,) float64, finite.
        origin: (3,) int32, laid on the cell that is convolved; it need not be one of `cells`.
    """

    cells: Array
    weights: Array
    origin: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "cells", np.ascontiguousarray(self.cells, np.int32))
        object.__setattr__(self, "weights", np.ascontiguousarray(self.weights, np.float64))
        object.__setattr__(self, "origin", np.asarray(self.origin, np.int32))
        if self.cells.ndim != 2 or self.cells.shape[1] != 3 or not len(self.cells):
            raise ValueError(f"kernel cells must be (k, 3) with k > 0, not {self.cells.shape}")
        if self.weights.shape != (len(self.cells),) or not np.isfinite(self.weights).all():
            raise ValueError(f"a kernel of {len(self.cells)} cells must have as many finite weights")
        if self.origin.shape != (3,):
            raise ValueError(f"kernel origin must be (3,), not {self.origin.shape}")
        if self.cells.min() < 0 or len(np.unique(self.cells, axis=0)) != len(self.cells):
            raise ValueError("kernel cells must be unique and not negative")

    @staticmethod
    def from_offsets(offsets: Array, weights: Array | float = 1.0) -> Kernel:
        """Return a kernel from (k, 3) cells relative to the origin."""
        offsets = np.asarray(offsets, np.int32).reshape(-1, 3)
        origin = -offsets.min(axis=0, initial=0)
        return Kernel(offsets + origin, np.broadcast_to(np.asarray(weights, np.float64), len(offsets)), origin)

    def __len__(self) -> int:
        return len(self.cells)

    @cached_property
    def offsets(self) -> Array:
        """(k, 3) int64 cells relative to the origin."""
        return self.cells.astype(np.int64) - self.origin

    @cached_property
    def stencil(self) -> tuple[Array, Array]:
        """Offsets (m, 3) int64 and weights (m,) of the cells whose weight is not 0."""
        taking_part = self.weights != 0
        return np.ascontiguousarray(self.offsets[taking_part]), self.weights[taking_part]

    @cached_property
    def half(self) -> Array:
        """(m, 3) int64 offsets and their opposites, one of each two: a neighbour's neighbour, whichever way it is said."""
        offsets = self.stencil[0]
        both = np.unique(np.concatenate([offsets, -offsets]), axis=0)
        return np.asarray(both[[tuple(o) > (0, 0, 0) for o in both.tolist()]])

    @cached_property
    def runs(self) -> tuple[Array, Array]:
        """Upright runs of equal weight, nearest column first: (m, 4) int64 dx, dy, lowest, highest dz; (m,) weights."""
        offsets, weights = self.stencil
        if not len(offsets):
            return np.empty((0, 4), np.int64), weights
        order = np.lexsort(offsets.T[::-1])
        offsets, weights = offsets[order], weights[order]
        follows = (np.diff(offsets, axis=0) == (0, 0, 1)).all(axis=1) & (np.diff(weights) == 0)
        breaks = np.flatnonzero(~follows) + 1
        first, last = np.append(0, breaks), np.append(breaks, len(offsets)) - 1
        runs = np.column_stack([offsets[first], offsets[last, 2]])
        near = np.argsort(np.abs(runs[:, :2]).sum(axis=1), kind="stable")
        return np.ascontiguousarray(runs[near]), weights[first][near]


def _build_ball(radius: float, axes: int, edge: float, with_origin: bool) -> Kernel:
    if not (edge > 0 and 0 <= radius < np.inf):
        raise ValueError(f"a kernel needs a radius of 0 m or more and an edge above 0 m, not {radius} and {edge}")
    reach = int(np.floor(radius / edge + LENGTH_SLACK))
    steps = np.arange(-reach, reach + 1)
    offsets = np.stack(np.meshgrid(steps, steps, steps if axes == 3 else [0], indexing="ij"), -1).reshape(-1, 3)
    squared = (offsets**2).sum(axis=1)
    inside = squared <= (radius / edge + LENGTH_SLACK) ** 2
    return Kernel.from_offsets(offsets[inside & (with_origin | (squared > 0))])


def _count_layers(height: float, edge: float) -> int:
    """Count the cells that it takes to cover a length: sizes are rounded up, so that a body never fits where it should not."""
    if not (edge > 0 and 0 < height < np.inf):
        raise ValueError(f"sizes of a kernel must be above 0 m, not {height} with an edge of {edge}")
    return int(np.ceil(height / edge - LENGTH_SLACK))


def build_von_neumann(with_origin: bool = False) -> Kernel:
    """Return the 6 cells that share a face with the origin; the origin itself only if asked for."""
    return _build_ball(1.0, 3, 1.0, with_origin)


def build_moore(with_origin: bool = False) -> Kernel:
    """Return the 26 cells that share a face, an edge or a corner with the origin; the origin itself only if asked for."""
    return _build_ball(1.75, 3, 1.0, with_origin)  # sqrt(3) = 1.73 is the corner, 2 the next cell


def build_sphere(radius: float, edge: float, with_origin: bool = True) -> Kernel:
    """Return cells whose centres are within `radius` m of the origin's."""
    return _build_ball(radius, 3, edge, with_origin)


def build_circle(radius: float, edge: float, with_origin: bool = True) -> Kernel:
    """Return cells of the horizontal plane (x, y: z is up here) within `radius` m of the origin (seeds 2.4.1)."""
    return _build_ball(radius, 2, edge, with_origin)


def build_stick(stem_height: float, body_width: float, body_height: float, edge: float) -> Kernel:
    """Return the room that somebody needs who stands on the origin (seeds 2.3.1; Gorte et al. 2019).

    A stem one cell wide stands on the origin, beside it there is room for a step; above it a square body. Heights are
    rounded up to whole cells and the width to an odd number of them. Every weight is 1 except the origin's, which is 0.

    Args:
        stem_height, body_width, body_height: m; a stem of 0 m leaves the body on the origin.
        edge: edge length of a cell, m.
    """
    stem = _count_layers(stem_height, edge) if stem_height else 0
    half = _count_layers(body_width, edge) // 2
    side, up = np.arange(-half, half + 1), np.arange(stem + 1, stem + 1 + _count_layers(body_height, edge))
    body = np.stack(np.meshgrid(side, side, up, indexing="ij"), -1).reshape(-1, 3)
    offsets = np.concatenate([np.arange(stem + 1)[:, None] * (0, 0, 1), body])
    return Kernel.from_offsets(offsets, offsets.any(axis=1).astype(np.float64))


def convolve(
    grid: VoxelGrid,
    kernel: Kernel,
    function: Literal["sum", "max", "most_common"] = "sum",
    property: str | Array | None = None,
) -> Array:
    """Convolve a property of every cell: K_f({weight(v) * property(v) | v in K_v, v occupied}) (seeds 2.3.1).

    Args:
        function: ``sum``; ``max``, -inf where no neighbour is occupied; ``most_common``, the label with the largest sum
            of weights. Of several such labels it is the cell's own, else the smallest. Negative labels do not vote; -1
            where nobody does.
        property: a property's name or an (n, ...) array; None is occupancy, 1 for each cell. ``most_common`` takes (n,)
            signed integers.

    Returns:
        (n, ...) float64, also of integers; for ``most_common`` the dtype of the labels.

    Raises:
        ValueError: an unknown function or property, a property of the wrong length, labels that are no integers,
            weights below 0 as votes.
    """
    if function not in ("sum", "max", "most_common"):
        raise ValueError(f"function must be sum, max or most_common, not {function!r}")
    if function == "sum" and property is None:
        return count_at(grid, grid.cells, kernel)
    values = _get_values(grid, property)
    cells = grid.cells.astype(np.int64)
    if function == "most_common":
        if values.ndim != 1 or not np.issubdtype(values.dtype, np.signedinteger):
            raise ValueError(f"labels must be (n,) signed integers, not {values.dtype} of shape {values.shape}")
        if (kernel.weights < 0).any():
            raise ValueError("weights are votes: they must not be negative")
        return stencil.vote(grid._bricks, cells, kernel.stencil, values.astype(np.int64)).astype(values.dtype)
    flat = np.ascontiguousarray(values, np.float64).reshape(len(values), int(np.prod(values.shape[1:])))
    return stencil.weigh(grid._bricks, cells, kernel.stencil, flat, function == "max").reshape(values.shape)


def _get_values(grid: VoxelGrid, property: str | Array | None) -> Array:
    if property is None:
        return np.ones(len(grid), np.int64)
    if isinstance(property, str):
        if property not in grid.properties:
            raise ValueError(f"the grid has no property {property!r}, only {sorted(grid.properties)}")
        property = grid.properties[property]
    values = np.asarray(property)
    if values.shape[:1] != (len(grid),):
        raise ValueError(f"a property must have one row a cell ({len(grid)}), not shape {values.shape}")
    return values


def count_at(grid: VoxelGrid, cells: Array, kernel: Kernel) -> Array:
    """Return (m,) float64 sum of occupancy under the kernel placed at any (m, 3) cells, also empty ones or outside."""
    return stencil.count(grid._bricks[0], grid._columns, _convert_cells(cells), *kernel.runs)


def is_any_at(grid: VoxelGrid, cells: Array, kernel: Kernel) -> Array:
    """Return (m,) bool: is any cell of weight other than 0 occupied, with the kernel placed at each of (m, 3) cells?

    For weights above 0 this is ``count_at(...) > 0``, but it stops at the first occupied cell.
    """
    return stencil.is_any_occupied(grid._bricks[0], grid._columns, _convert_cells(cells), kernel.runs[0])


def _convert_cells(cells: Array) -> Array:
    return np.ascontiguousarray(cells, np.int64).reshape(-1, 3)
