"""The grid after the seeds' equations (2.2), and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.grids import COMPILED, cell_lists, grids, random_grid
from topomerge.kernels import voxels
from topomerge.types import VoxelGrid, are_within, compute_extent


@COMPILED
@given(grids(min_size=1))
def test_bounds_and_centroids_as_in_the_seeds(grid):
    low, high = grid.compute_cell_bounds(grid.cells)
    for v, v_min, v_max, v_c in zip(grid.cells, low, high, grid.compute_centroids(), strict=True):
        assert np.allclose(v_min, grid.origin + v * grid.edge, atol=1e-12)
        assert np.allclose(v_max, grid.origin + (v + 1) * grid.edge, atol=1e-12)
        assert np.allclose(v_c, (v_min + v_max) * 0.5, atol=1e-12)
    v_lowest, v_highest = grid.bounds
    assert np.array_equal(v_lowest, grid.origin)
    assert np.allclose((v_highest - v_lowest) / grid.edge, grid.shape)


@COMPILED
@given(grids(min_size=1), st.integers(0, 99))
def test_locate_finds_the_cell_that_holds_the_point(grid, seed):
    inside = grid.origin + (grid.cells + np.random.default_rng(seed).uniform(0.001, 0.999, (len(grid), 3))) * grid.edge
    assert np.array_equal(grid.locate(inside), grid.cells)
    assert np.array_equal(grid.locate(grid.compute_centroids()), grid.cells)
    assert np.array_equal(grid.find_rows(grid.locate(inside)), np.arange(len(grid)))


def test_locate_is_integer_division_from_v_min():
    grid = VoxelGrid.from_cells(np.array([[0, 0, 0]]), np.array([1.0, -2.0, 0.5]), 0.25, (8, 8, 8))
    points = np.array([[1.0, -2.0, 0.5], [1.25, -1.76, 0.74], [0.99, -2.01, 9.0]])
    assert np.array_equal(grid.locate(points), (points - grid.origin) // grid.edge)
    assert grid.locate(points).tolist() == [[0, 0, 0], [1, 0, 0], [-1, -1, 34]]


@COMPILED
@given(cell_lists())
def test_from_cells_sorts_keeps_first_mentions_and_is_idempotent(cells):
    array = np.array(cells, np.int64).reshape(-1, 3)
    grid = VoxelGrid.from_cells(array, properties={"mention": np.arange(len(array))})
    assert {tuple(c) for c in grid.cells.tolist()} == set(cells)
    assert (np.diff(grid.codes.astype(np.int64)) > 0).all()
    assert grid.properties["mention"].tolist() == [cells.index(tuple(c)) for c in grid.cells.tolist()]
    again = VoxelGrid.from_cells(grid.cells, grid.origin, grid.edge, grid.shape, grid.properties)
    assert np.array_equal(again.cells, grid.cells) and again.shape == grid.shape
    assert np.array_equal(again.properties["mention"], grid.properties["mention"])


def test_from_cells_does_not_depend_on_the_order():
    grid = random_grid()
    mixed = VoxelGrid.from_cells(np.random.default_rng(1).permutation(grid.cells), shape=grid.shape)
    assert np.array_equal(mixed.cells, grid.cells) and np.array_equal(mixed.codes, grid.codes)


def test_subset_with_cells_and_with_properties():
    grid = random_grid().assign_properties(height=np.arange(len(random_grid())))
    part = grid.select_cells(grid.cells[:, 2] > 3)
    assert part.shape == grid.shape and (part.properties["height"] == grid.find_rows(part.cells)).all()
    more = grid.assign_properties(twice=grid.properties["height"] * 2)
    assert set(more.properties) == {"height", "twice"} and set(grid.properties) == {"height"}
    assert np.array_equal(more.find_rows(grid.cells), np.arange(len(grid)))
    other = grid.replace_cells(np.array([[5, 5, 5], [1, 1, 1]]))
    assert other.cells.tolist() == [[1, 1, 1], [5, 5, 5]] and other.shape == grid.shape and not other.properties


TWO_CELLS = np.array([[0, 0, 0], [1, 0, 0]], np.int32)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"edge": 0.0}, "edge length"),
        ({"edge": np.nan}, "edge length"),
        ({"origin": np.zeros(2)}, "origin"),
        ({"origin": np.array([0, np.inf, 0])}, "origin"),
        ({"cells": TWO_CELLS.astype(np.int64)}, "int32"),
        ({"cells": TWO_CELLS[:, :2]}, r"\(n, 3\)"),
        ({"cells": TWO_CELLS[::-1]}, "Morton order"),
        ({"cells": TWO_CELLS[[0, 0]]}, "unique"),
        ({"cells": TWO_CELLS - 1}, "outside"),
        ({"shape": (1, 1, 1)}, "outside"),
        ({"shape": (2, 0, 1)}, "shape"),
        ({"shape": (voxels.AXIS_LIMIT + 1, 1, 1)}, "shape"),
        ({"properties": {"count": np.zeros(3)}}, "count"),
    ],
)
def test_grid_refuses(arguments, message):
    valid = {"cells": TWO_CELLS, "origin": np.zeros(3), "edge": 0.1, "shape": (2, 1, 1)}
    VoxelGrid(**valid)
    with pytest.raises(ValueError, match=message):
        VoxelGrid(**{**valid, **arguments})


@pytest.mark.parametrize("cells", [[[0, 0, -1]], [[0, 0, 0], [voxels.AXIS_LIMIT, 0, 0]], [[2**32, 0, 0]], [[0.5, 0, 0]]])
def test_from_cells_refuses(cells):
    with pytest.raises(ValueError, match="cells"):
        VoxelGrid.from_cells(np.array(cells))


def test_codes_are_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    counted: list[int] = []
    encode = voxels.encode
    monkeypatch.setattr(voxels, "encode", lambda cells: counted.append(len(cells)) or encode(cells))
    grid = VoxelGrid.from_cells(np.array([[1, 2, 3], [0, 0, 1], [1, 2, 3]]))
    some = grid.assign_properties(count=np.array([1, 2])).select_cells(np.array([True, False]))
    assert counted == [3] and some.cells.tolist() == [[0, 0, 1]] and some.properties["count"].tolist() == [1]
    loaded = VoxelGrid.from_codes(grid.codes, grid.origin, grid.edge, grid.shape)
    assert counted == [3] and loaded.cells.tolist() == grid.cells.tolist()
    with pytest.raises(ValueError, match="in Morton order"):
        grid.select_cells(np.array([1, 0]))


@given(cell_lists(min_size=1))
def test_extent_and_cells_within_it(cells):
    cells = np.array(cells)
    low, high = compute_extent(cells)
    assert np.array_equal(low, cells.min(axis=0)) and np.array_equal(high, cells.max(axis=0)) and low.dtype == cells.dtype
    for first, last in ((0, high), (low + 1, high + 1), (2, 5)):
        assert np.array_equal(are_within(cells, first, last), ((cells >= first) & (cells < last)).all(axis=1))
    assert are_within(np.zeros((2, 0, 3)), 0, 1).shape == (2, 0)
