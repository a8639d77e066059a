"""Voxelising: against a NumPy twin, in any order, in chunks, with bad and stray points."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from topomerge.errors import InputError
from topomerge.extraction.cleaning import add_means, coarsen_until_dense, compute_cell_means, label_groups
from topomerge.extraction.scan import Scan
from topomerge.extraction.slices import raise_slice
from topomerge.extraction.voxels import LatticeCells, _compute_offsets, voxelise
from topomerge.kernels import count_threads, set_thread_count, stencil
from topomerge.kernels import occupied_cells as kernel
from topomerge.types import PointCloud, VoxelGrid

RNG = np.random.default_rng(5)


def _block(corner, count: int, side: float) -> np.ndarray:
    """Points in a block 2.4 m high."""
    return np.asarray(corner, np.float64) + RNG.random((count, 3)) * (side, side, 2.4)


def twin(points: np.ndarray, edge: float) -> tuple[set[tuple[int, ...]], dict[tuple[int, ...], int]]:
    lattice = np.floor(points.astype(np.float64) / edge).astype(int)
    cells, counts = np.unique(lattice, axis=0, return_counts=True)
    keys = [tuple(c) for c in cells.tolist()]
    return set(keys), dict(zip(keys, counts.tolist(), strict=True))


def lattice_of(grid) -> list[tuple[int, ...]]:
    base = np.rint(grid.origin / grid.edge).astype(int)
    return [tuple(c) for c in (grid.cells + base).tolist()]


def test_equals_numpy_twin():
    points = np.random.default_rng(1).normal(0, 2, (5000, 3)).astype(np.float32)
    grid = voxelise(points, 0.13)
    cells, counts = twin(points, 0.13)
    assert set(lattice_of(grid)) == cells
    assert dict(zip(lattice_of(grid), grid.properties["count"].tolist(), strict=True)) == counts


@pytest.mark.longer
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 6))
def test_order_and_chunks_do_not_matter(seed, parts):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3, 3, (300, 3)).astype(np.float32)
    whole = voxelise(points)
    chunks = [PointCloud(p) for p in np.array_split(rng.permutation(points), parts)]
    again = voxelise(iter(chunks))
    assert (whole.cells == again.cells).all() and (whole.origin == again.origin).all()
    assert (whole.properties["count"] == again.properties["count"]).all()
    assert (whole.properties["offset"] == again.properties["offset"]).all()


def test_cells_know_where_their_points_lie_on_average():
    points = np.random.default_rng(5).normal(0, 1, (20_000, 3)).astype(np.float32)
    shift = np.array([85_000.0, 447_000.0, -3.0])
    grid = voxelise(PointCloud(points, shift), 0.25)
    rows = grid.find_rows(grid.locate(points + shift))
    mean = np.column_stack([np.bincount(rows, (points + shift)[:, k]) for k in range(3)]) / np.bincount(rows)[:, None]
    assert np.abs(compute_cell_means(grid) - mean).max() < 0.25 / 256  # in whole 256ths of a cell
    assert abs((compute_cell_means(grid) - mean).mean()) < 0.25 / 256 / 10
    assert np.abs(add_means(grid, points + shift).properties["offset"].astype(int) - grid.properties["offset"]).max() <= 1


def test_cells_that_are_joined_keep_the_mean_of_their_points():
    rng = np.random.default_rng(6)
    wall = np.column_stack([np.full(400, 3.137), rng.uniform(0, 6, 400), rng.uniform(0, 3, 400)])  # too few points for 0.1 m
    grid = coarsen_until_dense(voxelise(wall.astype(np.float32)), 7, [])
    assert grid.edge > 0.1 and np.abs(compute_cell_means(grid)[:, 0] - 3.137).max() < 0.002


def test_walls_of_a_slice_stand_where_its_points_are():
    room = np.concatenate([[(x, y, 0.4) for x in np.linspace(0.03, 6.03, 200)] for y in (0.03, 5.03)])
    room = np.concatenate([room, room[:, [1, 0, 2]]]).astype(np.float32)
    raised = raise_slice(Scan(voxelise(room))).grid
    walls = compute_cell_means(raised)[raised.cells[:, 2] > raised.cells[:, 2].min()]
    assert len(np.unique(raised.cells[:, 2])) > 10
    off = np.abs(walls[:, :2] - 0.03 - np.round(walls[:, :2] - 0.03)).min(axis=1)
    assert np.median(off) < 0.001 and off.max() < 0.05  # corners lie between two walls


def test_without_points_a_cell_lies_in_its_middle():
    grid = VoxelGrid.from_cells(np.array([[0, 0, 0], [4, 1, 2]]), np.array([1.0, 2.0, 3.0]), 0.2)
    assert (compute_cell_means(grid) == grid.compute_centroids()).all()
    assert np.abs(compute_cell_means(add_means(grid, np.zeros((0, 3)))) - grid.compute_centroids()).max() < 0.2 / 256


def test_many_chunks_give_what_one_gives():
    points = np.random.default_rng(3).uniform(0, 4, (4000, 3)).astype(np.float32)
    parts = [PointCloud(p) for p in np.array_split(points, 40)]
    grid, whole = voxelise(parts), voxelise(points)
    assert (grid.cells == whole.cells).all()
    for name in ("count", "offset"):
        assert (grid.properties[name] == whole.properties[name]).all()


@pytest.mark.parametrize("away", [0.0, 3e6])
def test_cells_of_chunks_are_those_of_numpy(away: float):
    rng = np.random.default_rng(4)
    chunks = [rng.uniform(-3, 3, (200, 3)) for _ in range(30)]
    chunks[20][:7] += away  # farther than codes reach
    held = LatticeCells(0.25)
    for chunk in chunks:
        held.add(PointCloud(chunk.astype(np.float32)))
    cells, counts, sums = held.get_cells()
    places = np.concatenate(chunks).astype(np.float32).astype(np.float64) / 0.25
    expected, row, number = np.unique(np.floor(places).astype(np.int64), axis=0, return_inverse=True, return_counts=True)
    order = np.lexsort(cells.T[::-1])
    assert (cells[order] == expected).all() and (counts[order] == number).all()
    parts = np.zeros((len(expected), 3), np.int64)
    np.add.at(parts, row.ravel(), np.floor((places - np.floor(places)) * kernel.OFFSET_STEPS).astype(np.int64))
    assert (sums[order] == parts).all()


def test_of_more_cells_than_are_wanted_there_are_none():
    rng = np.random.default_rng(5)
    held = LatticeCells(0.05, most=1000)
    for _ in range(4):
        held.add(PointCloud(rng.uniform(0, 4, (800, 3)).astype(np.float32)))
    assert held.select_within(voxelise(rng.uniform(0, 4, (800, 3)).astype(np.float32))) is None


@pytest.mark.parametrize(("away", "most"), [(0.0, 0), (3e6, 0), (0.0, 3000)])
def test_cells_twice_as_long_are_those_of_their_points(away: float, most: int):
    """To the bit, though no point is looked at again: also where codes do not reach, and where the shorter cells are too many."""
    rng = np.random.default_rng(6)
    shift = np.array([85_000.0, -447_000.0, -3.0])
    chunks = [rng.uniform(-3, 3, (400, 3)).astype(np.float32) for _ in range(30)]
    chunks[0][0] = np.nan
    chunks[20][:7] += np.float32(away)
    long, alone, short, short_alone = (LatticeCells(edge, most if edge < 0.1 else 0) for edge in (0.1, 0.1, 0.05, 0.05))
    short.twice = long
    for chunk in chunks:
        for held in (alone, short, short_alone):
            held.add(PointCloud(chunk, shift))
    assert short.too_many == short_alone.too_many == bool(most)
    for one, other in ((long, alone), (short, short_alone))[: 1 if most else 2]:
        both = [[part[np.lexsort(held[0].T)] for part in held] for held in (one.get_cells(), other.get_cells())]
        assert all(np.array_equal(a, b) for a, b in zip(*both, strict=True)) and len(both[0][0]) > 5000


def test_sums_in_cubes_are_those_of_numpy():
    points = np.random.default_rng(7).normal(0, 2, (3000, 3))
    points[:3] *= 1e7
    cubes = np.floor(points / 0.7)
    near = (np.abs(cubes) < stencil.CUBE_LIMIT).all(axis=1)
    _, of, number = np.unique(cubes[near], axis=0, return_inverse=True, return_counts=True)
    at = points[near] - (cubes[near] + 0.5) * 0.7
    columns = [np.bincount(of.ravel(), at[:, i]) for i in range(3)]
    columns += [np.bincount(of.ravel(), at[:, i] * at[:, j]) for i, j in stencil.MOMENTS]
    assert near.sum() == 2997 and np.array_equal(stencil.sum_in_cubes(points, 0.7), np.column_stack([number, *columns]))
    assert stencil.sum_in_cubes(np.zeros((0, 3)), 0.4).shape == (0, 10)


def test_shift_moves_the_origin_exactly():
    points = np.random.default_rng(0).uniform(0, 5, (1000, 3)).astype(np.float32)
    near, far = voxelise(PointCloud(points)), voxelise(PointCloud(points, np.array([85_000.0, 447_000.0, 0.0])))
    assert (near.cells == far.cells).mean() > 0.99
    np.testing.assert_allclose(far.origin - near.origin, (85_000, 447_000, 0), atol=1e-6)


def test_points_that_are_not_finite_are_left_out():
    points = np.array([[0, 0, 0], [np.nan, 1, 1], [1, np.inf, 1], [0.5, 0.5, 0.5]], np.float32)
    assert len(voxelise(points)) == 2
    with pytest.raises(InputError, match="no finite point"):
        voxelise(np.full((3, 3), np.nan, np.float32))
    with pytest.raises(InputError, match="no finite point"):
        voxelise(np.zeros((0, 3), np.float32))


@pytest.mark.parametrize("distance", [1e3, 1e5, 1e8])
def test_a_stray_point_is_dropped_and_reported(distance):
    points = np.random.default_rng(0).uniform(0, 20, (20_000, 3)).astype(np.float32) * (1, 1, 0.15)
    stray = np.array([[distance, -distance, distance]])
    warnings: list[str] = []
    grid = voxelise(np.concatenate([points, stray]).astype(np.float32), 0.1, warnings)
    assert max(grid.shape) < 400
    assert len(warnings) == 1 and warnings[0].startswith("1 stray point")
    assert int(grid.properties["count"].sum()) == 20_000


def test_a_thinly_scanned_wing_is_no_stray():
    rng = np.random.default_rng(0)
    hall, wing = rng.uniform(0, 20, (20_000, 3)), rng.uniform(0, 3, (50, 3)) + (60, 0, 0)
    warnings: list[str] = []
    grid = voxelise((np.concatenate([hall, wing]) * (1, 1, 0.15)).astype(np.float32), 0.1, warnings)
    assert not warnings and int(grid.properties["count"].sum()) == 20_050


def test_an_extent_that_no_building_has_is_refused():
    points = np.random.default_rng(0).uniform(-1e7, 1e7, (500, 3)).astype(np.float32)
    with pytest.raises(InputError, match="--unit"):
        voxelise(points, 0.1)


@pytest.mark.parametrize("size", [(800, 400, 260), (5000, 5, 3)])
def test_an_extent_between_table_and_sorting(size):
    """Too many bricks for one table: the median point's surroundings and the rest are joined."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(0, size, (2000, 3)), rng.uniform(0, 5, (2000, 3))]).astype(np.float32)
    cells, counts = twin(points, 0.1)
    base, found, number, _ = kernel.find_occupied_cells(points, np.zeros(3), 0.1)
    keys = [tuple(c) for c in (found + base).tolist()]
    assert set(keys) == cells and dict(zip(keys, number.tolist(), strict=True)) == counts


@pytest.mark.parametrize("edge", [0.0, -1.0, float("nan"), 1e-5, 50.0])
def test_absurd_voxel_size_is_refused(edge):
    with pytest.raises(InputError, match="voxel size"):
        voxelise(np.zeros((1, 3), np.float32), edge)


def test_table_and_sorting_agree(monkeypatch):
    points = np.random.default_rng(2).uniform(-5, 5, (3000, 3)).astype(np.float32)
    base, cells, counts, sums = kernel.find_occupied_cells(points, np.zeros(3), 0.1)
    other_base, other_cells, other_counts, other_sums = kernel._split(points, np.zeros(3), 0.1)
    order, other = np.lexsort((cells + base).T), np.lexsort((other_cells + other_base).T)
    assert ((cells + base)[order] == (other_cells + other_base)[other]).all()
    assert (counts[order] == other_counts[other]).all() and (sums[order] == other_sums[other]).all()


def test_slabs_of_points_and_threads_count_what_numpy_counts():
    points = np.random.default_rng(3).uniform(-9, 9, (kernel.SLAB + 50_000, 3)).astype(np.float32)
    points[[5, -5]] = np.nan
    edge = 1.0  # a few thousand cells, so that NumPy is done soon
    lattice = np.floor(points[np.isfinite(points).all(axis=1)].astype(np.float64))
    parts = np.floor((points[np.isfinite(points).all(axis=1)].astype(np.float64) - lattice) * kernel.OFFSET_STEPS).astype(
        np.int64
    )
    code = (lattice.astype(np.int64) + 16) @ [1024, 32, 1]  # numbers are sorted sooner than rows
    codes, row, number = np.unique(code, return_inverse=True, return_counts=True)
    cells = np.column_stack([codes // 1024, codes // 32 % 32, codes % 32]) - 16
    sums = np.column_stack([np.bincount(row.ravel(), parts[:, k], len(cells)) for k in range(3)])
    before = count_threads()
    for threads in (1, 2):
        set_thread_count(threads)
        base, found, counts, added = kernel.find_occupied_cells(points, np.zeros(3), edge)
        order = np.lexsort((found + base).T[::-1])
        assert ((found + base)[order] == cells).all() and (counts[order] == number).all() and (added[order] == sums).all()
    set_thread_count(before)


def test_dust_between_strays_joins_nothing():
    warnings: list[str] = []
    points = np.concatenate([_block((0, 0, 0), 40_000, 10.0), RNG.uniform(-150, 150, (1500, 3)) * (1, 1, 0.2)])
    grid = voxelise(points.astype(np.float32), 0.1, warnings)
    assert max(grid.shape) < 400
    assert len(warnings) == 1 and "stray points lie more than 10 m" in warnings[0]


@pytest.mark.parametrize(("count", "step"), [(2, (0, 1, 0)), (3, (1, -1, 0))])
def test_large_places_far_apart_are_refused_with_where_they_lie(count, step):
    places = [_block(np.array(step) * 4000.0 * k, 20_000, 6.0) for k in range(count)]
    with pytest.raises(InputError, match=rf"{count} places more than 100 m apart .* crop the file"):
        voxelise(np.concatenate(places), 0.1)


def test_a_small_place_far_off_is_left_out_and_named():
    warnings: list[str] = []
    points = np.concatenate([_block((0, 0, 0), 40_000, 12.0), _block((6000, 0, 0), 500, 3.0)])
    grid = voxelise(points, 0.1, warnings)
    assert max(grid.shape) <= 121
    assert len(warnings) == 1 and re.search(r"500 points lie more than 100 m .* around 600[12], [12], 1 m", warnings[0])


def test_two_buildings_of_one_campus_stay_together():
    warnings: list[str] = []
    grid = voxelise(np.concatenate([_block((0, 0, 0), 9000, 9.0), _block((150, 40, 0), 9000, 9.0)]), 0.1, warnings)
    assert grid.shape[0] > 1500 and not warnings


@pytest.mark.parametrize("density", [0.02, 0.1, 0.4])
def test_groups_are_those_of_a_dense_raster(density: float):
    dense = RNG.random((14, 9, 11)) < density
    cells = np.argwhere(dense)
    labels, count = ndimage.label(dense, np.ones((3, 3, 3)))
    group = label_groups(cells * 7 + RNG.integers(0, 7, cells.shape) - 30 * 7, 7)
    assert group.max() + 1 == count
    assert len(set(zip(group.tolist(), labels[dense].tolist(), strict=True))) == count


def test_offsets_are_means_of_whole_numbers_rounded_half_up() -> None:
    counts = np.array([1, 2, 3, 7, 2_000_000_000, 10**12])
    for part in (0, 1, 128, 254, 255):
        sums = np.column_stack([counts * part, np.minimum(counts * part + counts // 2, counts * 255), counts * part // 2])
        assert np.array_equal(_compute_offsets(sums, counts), (sums + counts[:, None] // 2) // counts[:, None])
