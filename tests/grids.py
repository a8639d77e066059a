"""Voxel grids for tests: drawn by hypothesis, or plain random ones."""

from __future__ import annotations

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

from topomerge.types import Array, VoxelGrid

# compiled code is slow the first time, and a busy machine always
settings.register_profile("compiled", deadline=None, max_examples=40, derandomize=True)
COMPILED = settings.get_profile("compiled")


def cell_lists(size: int = 20, min_size: int = 0) -> st.SearchStrategy[list[tuple[int, int, int]]]:
    """Lists of cells in 0 .. size - 1, some of them repeated."""
    axis = st.integers(0, size - 1)
    return st.lists(st.tuples(axis, axis, axis), min_size=min_size, max_size=60)


@st.composite
def grids(draw: st.DrawFn, size: int = 20, min_size: int = 0) -> VoxelGrid:
    """Sparse or, now and then, dense grids; origin and edge vary."""
    cells = np.array(draw(cell_lists(size, min_size)), np.int32).reshape(-1, 3)
    if draw(st.booleans()):
        block = np.argwhere(np.ones((5, 4, 3), bool)) + draw(st.integers(0, size - 5))
        cells = np.concatenate([cells, block.astype(np.int32)])
    origin = np.array(draw(st.sampled_from([(0.0, 0.0, 0.0), (-3.7, 12.25, 0.4)])))
    return VoxelGrid.from_cells(cells, origin, draw(st.sampled_from([0.1, 0.05, 1.0])), (size, size, size))


def random_grid(n: int = 1500, shape: tuple[int, int, int] = (70, 50, 30), seed: int = 0) -> VoxelGrid:
    """Random cells with a floor below them: several levels deep, octants full and sparse."""
    rng = np.random.default_rng(seed)
    floor = np.argwhere(np.ones(shape[:2], bool))
    floor = np.column_stack([floor, np.full(len(floor), 3)])
    return VoxelGrid.from_cells(np.concatenate([rng.integers(0, shape, (n, 3)), floor]), shape=shape)


def row_of(grid: VoxelGrid) -> dict[tuple[int, ...], int]:
    """Cell -> row, as plainly as it can be said."""
    return {tuple(c): i for i, c in enumerate(grid.cells.tolist())}


def interleave(cell: Array | tuple[int, int, int]) -> int:
    """Morton code, bit by bit."""
    code = 0
    for bit in range(21):
        for axis in range(3):
            code |= ((int(cell[axis]) >> bit) & 1) << (3 * bit + axis)
    return code
