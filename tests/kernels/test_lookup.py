"""The brick lookup equals a dictionary."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.grids import COMPILED, cell_lists, grids, random_grid, row_of
from topomerge.kernels import stencil, voxels
from topomerge.types import VoxelGrid

ANYWHERE = st.integers(-40, 60)


@COMPILED
@given(grids(), st.lists(st.tuples(ANYWHERE, ANYWHERE, ANYWHERE), max_size=30))
def test_rows_inside_and_outside(grid, queries):
    queries += [tuple(c) for c in grid.cells[:10].tolist()]
    row_of_cell = row_of(grid)
    cells = np.array(queries, np.int64).reshape(-1, 3)
    assert grid.find_rows(cells).tolist() == [row_of_cell.get(q, -1) for q in queries]
    assert np.array_equal(grid.contains(cells), grid.find_rows(cells) >= 0)


def test_rows_of_all_cells_of_a_volume():
    grid = random_grid()
    assert np.array_equal(grid.find_rows(grid.cells), np.arange(len(grid)))
    cells = np.argwhere(np.ones(np.add(grid.shape, 16), bool)) - 8  # beyond every face, also inside the last bricks
    rows = grid.find_rows(cells)
    assert np.array_equal(cells[rows >= 0][np.argsort(rows[rows >= 0])], grid.cells)


@pytest.mark.parametrize("far", [-(2**40), 2**40, 2**62])
def test_far_cells_are_empty(far):
    grid = VoxelGrid.from_cells(np.array([[0, 0, 0]]))
    assert grid.find_rows(np.array([[far, 0, 0], [0, far, 0], [0, 0, far]])).tolist() == [-1, -1, -1]


def test_bricks_are_the_third_level_in_morton_order():
    grid = random_grid()
    table, bricks = grid._bricks
    octants = np.unique(grid.codes >> np.uint64(9))
    assert len(bricks) == len(octants)
    for brick, code in zip(bricks, octants, strict=True):
        assert np.array_equal(np.sort(brick[brick >= 0]), np.flatnonzero(grid.codes >> np.uint64(9) == code))
    assert np.array_equal(np.sort(table[table >= 0]), np.arange(len(octants)))


@COMPILED
@given(cell_lists(min_size=1))
def test_columns_are_bits_of_bricks(cells):
    grid = VoxelGrid.from_cells(np.array(cells))
    _, bricks = grid._bricks
    bits = (stencil.build_columns(grid.cells, *grid._bricks)[:, :, None] >> np.arange(8)) & 1
    assert np.array_equal(bits.astype(bool), (bricks >= 0).reshape(-1, 64, 8))


def test_empty_grid():
    grid = VoxelGrid.from_cells(np.zeros((0, 3), np.int32))
    assert grid.find_rows(np.array([[0, 0, 0], [-1, 5, 2]])).tolist() == [-1, -1]
    assert grid.find_rows(np.zeros((0, 3), np.int64)).shape == (0,)


def test_volume_too_large():
    with pytest.raises(ValueError, match="too large"):
        voxels.build(np.array([[0, 0, 0]], np.int32), (1 << 20, 1 << 20, 64))
