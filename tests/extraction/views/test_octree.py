"""Octree queries equal brute force (seeds 2.2.1)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.grids import COMPILED, grids, interleave, random_grid
from topomerge.extraction.views.visibility import SparseVoxelOctree
from topomerge.types import VoxelGrid

AXIS = st.integers(-5, 25)
CELL = st.tuples(AXIS, AXIS, AXIS)


def in_box(grid, low, high):
    return np.flatnonzero(((grid.cells >= low) & (grid.cells < high)).all(axis=1))


def in_ball(grid, centre, r):
    """Rows within r, and rows about which rounding may decide either way."""
    distance = np.linalg.norm(grid.compute_centroids() - centre, axis=1)
    return np.flatnonzero(distance <= r + 1e-6 * grid.edge), np.abs(distance - r - 1e-6 * grid.edge).min(initial=1) < 1e-12


@COMPILED
@given(grids(), CELL, CELL)
def test_range_equals_brute_force(grid, low, high):
    rows = SparseVoxelOctree(grid).find_in_box(np.array(low), np.array(high))
    assert rows.dtype == np.int64
    assert np.array_equal(rows, in_box(grid, low, high))


@COMPILED
@given(grids(size=40), CELL, st.sampled_from([0, 0.5, 1, 1.5, 2, 3, 5.2, 20, 100]))
def test_radius_around_cells_equals_brute_force(grid, cell, cells_away):
    centre, r = np.array(cell), cells_away * grid.edge
    rows = SparseVoxelOctree(grid).find_in_radius(centre, r)
    expected, doubtful = in_ball(grid, grid.compute_centroids(centre[None])[0], r)
    assert doubtful or np.array_equal(rows, expected)


@COMPILED
@given(grids(size=40), st.tuples(*[st.floats(-60, 60)] * 3), st.floats(0, 30))
def test_radius_around_points_equals_brute_force(grid, point, r):
    centre = np.array(point)
    expected, doubtful = in_ball(grid, centre, r)
    assert doubtful or np.array_equal(SparseVoxelOctree(grid).find_in_radius(centre, r), expected)


@pytest.mark.parametrize("cells_away", [0, 1, 2.5, 9, 40, 200])  # from the bricks, and from the root
def test_many_radii_equal_one_by_one_brute_force(cells_away):
    grid = random_grid()
    queries = np.concatenate([grid.cells[::19], [[-5, -5, -5], [300, 0, 0], [35, 25, 15]]]).astype(np.int64)
    indptr, rows = SparseVoxelOctree(grid).find_in_radius_many(queries, cells_away * grid.edge)
    assert indptr[0] == 0 and indptr[-1] == len(rows)
    for i, cell in enumerate(queries):
        near = np.flatnonzero(((grid.cells - cell) ** 2).sum(axis=1) <= cells_away**2)
        assert np.array_equal(rows[indptr[i] : indptr[i + 1]], near)


def test_a_cell_exactly_at_the_radius_counts():
    grid = VoxelGrid.from_cells(np.argwhere(np.ones((9, 1, 1), bool)), edge=0.1)
    for k in range(9):
        assert len(SparseVoxelOctree(grid).find_in_radius(np.array([0, 0, 0]), 0.1 * k)) == k + 1


def test_whole_grid_and_nothing():
    grid = random_grid()
    octree = SparseVoxelOctree(grid)
    assert np.array_equal(octree.find_in_box((0, 0, 0), grid.shape), np.arange(len(grid)))
    assert np.array_equal(octree.find_in_radius(np.array([0.0, 0, 0]), 1e6), np.arange(len(grid)))
    assert len(octree.find_in_box((5, 5, 5), (5, 9, 9))) == 0
    assert len(octree.find_in_box((9, 9, 9), (5, 5, 5))) == 0
    assert len(octree.find_in_radius(np.array([1e300, 0.0, -1e300]), 1.0)) == 0
    assert len(octree.find_in_radius_many(np.zeros((0, 3)), 1.0)[1]) == 0


@pytest.mark.parametrize("cell", [(0, 0, 0), (7, 0, 3), (1000, 2000, 3)])
def test_single_cell(cell):
    grid = VoxelGrid.from_cells(np.array([cell]))
    octree = SparseVoxelOctree(grid)
    assert octree.depth == 1
    assert octree.find_in_box(cell, np.add(cell, 1)).tolist() == [0]
    assert octree.find_in_box(np.subtract(cell, 1), cell).tolist() == []
    assert octree.find_in_radius(np.array(cell), 0.0).tolist() == [0]
    assert octree.find_in_radius(np.add(cell, (0, 0, 2)), 0.1).tolist() == []


def test_empty_grid():
    octree = SparseVoxelOctree(VoxelGrid.from_cells(np.zeros((0, 3), np.int32)))
    assert octree.depth == 0
    assert len(octree.find_in_box((0, 0, 0), (9, 9, 9))) == 0
    assert len(octree.find_in_radius(np.zeros(3), 5.0)) == 0
    assert len(octree.build_level_of_detail(2)) == 0


@COMPILED
@given(grids(min_size=1))
def test_levels_are_buckets_of_eight_until_one_is_left(grid):
    octree = SparseVoxelOctree(grid)
    level = [interleave(c) for c in grid.cells]
    for k in range(octree.depth + 1):
        assert octree.compute_codes(k).tolist() == level
        assert k == octree.depth or k == 0 or len(level) > 1
        level = sorted({code // 8 for code in level})
    assert len(octree.compute_codes(octree.depth)) == 1


@COMPILED
@given(grids(size=40), st.integers(0, 9))
def test_level_of_detail_counts_leaves(grid, k):
    coarse = SparseVoxelOctree(grid).build_level_of_detail(k)
    cells, count = np.unique(grid.cells >> k, axis=0, return_counts=True)
    assert dict(zip(map(tuple, coarse.cells.tolist()), coarse.properties["count"].tolist(), strict=True)) == dict(
        zip(map(tuple, cells.tolist()), count.tolist(), strict=True)
    )
    assert coarse.properties["count"].sum() == len(grid)
    assert coarse.edge == grid.edge * 2**k
    assert np.array_equal(coarse.origin, grid.origin)
    assert (coarse.bounds[1] >= grid.bounds[1] - 1e-9).all()


def test_wrong_arguments():
    octree = SparseVoxelOctree(random_grid(10))
    for call in (
        lambda: octree.find_in_radius(np.zeros(3), -1.0),
        lambda: octree.find_in_radius(np.zeros(3), np.inf),
        lambda: octree.find_in_radius(np.zeros((2, 3)), 1.0),
        lambda: octree.find_in_radius_many(np.zeros(3), 1.0),
        lambda: octree.find_in_box((0, 0), (1, 1)),
        lambda: octree.build_level_of_detail(-1),
        lambda: octree.build_level_of_detail(22),
        lambda: octree.compute_codes(octree.depth + 1),
    ):
        with pytest.raises(ValueError):
            call()
