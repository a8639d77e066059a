"""Standing room, dilation, components and the distance field: against slow twins."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csgraph

from topomerge.extraction.convolution import Kernel, build_circle, build_moore, build_stick, build_von_neumann, convolve
from topomerge.extraction.morphology import (
    bridge_gaps,
    compute_horizontal_distance_field,
    dilate_upwards,
    label_components,
    select_unobstructed,
    spread_labels,
)
from topomerge.extraction.navigable import select_floor_components, select_largest_component
from topomerge.extraction.storeys import remove_ceilings
from topomerge.extraction.views.view_rooms import find_local_maxima, raise_views
from topomerge.types import VoxelGrid


def cells_of(grid: VoxelGrid) -> set[tuple[int, ...]]:
    return {tuple(c) for c in grid.cells.tolist()}


def random_grid(rng: np.random.Generator, n: int, size: int) -> VoxelGrid:
    return VoxelGrid.from_cells(rng.integers(0, size, (n, 3)).astype(np.int32))


def slab(x: int, y: int, z: int = 0, holes=()) -> VoxelGrid:
    cells = [(i, j, z) for i in range(x) for j in range(y) if (i, j) not in set(holes)]
    return VoxelGrid.from_cells(np.array(cells, np.int32), edge=0.1, shape=(x + 5, y + 5, 60))


def test_unobstructed_is_sum_zero():
    grid = random_grid(np.random.default_rng(0), 400, 9)
    kernel = build_stick(0.25, 0.3, 0.75, 0.1)
    assert cells_of(select_unobstructed(grid, kernel)) == cells_of(grid.select_cells(convolve(grid, kernel) == 0))


def test_dilation_adds_the_cells_above():
    grid = VoxelGrid.from_cells(np.array([(0, 0, 0), (3, 3, 8)], np.int32), edge=0.1, shape=(4, 4, 10))
    assert cells_of(dilate_upwards(grid, 0.25)) == {(0, 0, 0), (0, 0, 1), (0, 0, 2), (3, 3, 8), (3, 3, 9)}
    assert cells_of(dilate_upwards(grid, 0.2)) == cells_of(dilate_upwards(grid, 0.25))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["von_neumann", "moore"]))
def test_components_equal_a_dense_graph(seed, name):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, 150, 8)
    kernel = {"von_neumann": build_von_neumann(), "moore": build_moore()}[name]
    group = rng.integers(-1, 2, len(grid))
    component = label_components(grid, kernel, group)
    offset = grid.cells[:, None] - grid.cells[None]
    near = (np.abs(offset).sum(axis=-1) if name == "von_neumann" else np.abs(offset).max(axis=-1)) == 1
    adjacent = near & (group[:, None] == group[None]) & (group >= 0)
    label = csgraph.connected_components(adjacent, directed=False)[1]
    expected = sorted(np.flatnonzero(label == c).tolist() for c in np.unique(label[group >= 0]))
    found = sorted(np.flatnonzero(component == c).tolist() for c in range(component.max() + 1))
    assert found == expected and (component[group < 0] == -1).all()
    assert (np.diff([np.flatnonzero(component == c)[0] for c in range(component.max() + 1)]) > 0).all()


def test_a_neighbourhood_said_one_way_is_meant_both_ways():
    grid = VoxelGrid.from_cells(np.array([(0, 0, 0), (1, 0, 0)], np.int32))
    for step in ((1, 0, 0), (-1, 0, 0)):
        assert label_components(grid, Kernel.from_offsets(np.array([step]))).tolist() == [0, 0]


def test_spread_takes_the_nearest_label():
    line = VoxelGrid.from_cells(np.column_stack([np.arange(10), np.zeros((10, 2))]).astype(np.int32))
    labels = np.full(10, -1)
    labels[line.find_rows(np.array([[0, 0, 0]]))] = 5
    labels[line.find_rows(np.array([[9, 0, 0]]))] = 7
    spread = spread_labels(line, labels)
    assert [spread[line.find_rows(np.array([[x, 0, 0]]))[0]] for x in range(10)] == [5] * 5 + [7] * 5
    assert (spread_labels(line, labels, steps=2) == -1).sum() == 4


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_distance_field_is_the_seeds_growing_circle(seed):
    rng = np.random.default_rng(seed)
    plan = rng.random((24, 24)) < 0.93
    grid = VoxelGrid.from_cells(np.argwhere(plan[:, :, None] & (rng.random((1, 1, 2)) < 0.8)).astype(np.int32))
    if not len(grid):
        return
    expected = np.zeros(len(grid), int)
    growing = np.ones(len(grid), bool)
    for radius in range(1, 30):
        kernel = build_circle(radius, 1.0)
        growing &= convolve(grid, kernel) == len(kernel)
        expected[growing] = radius
        if not growing.any():
            break
    assert (compute_horizontal_distance_field(grid) == expected).all()


def test_local_maxima_equal_brute_force():
    rng = np.random.default_rng(4)
    grid = random_grid(rng, 500, 12)
    value = rng.integers(0, 6, len(grid))
    centre = grid.compute_centroids()
    near = np.linalg.norm(centre[:, None] - centre[None], axis=-1) <= 0.25 + 1e-9
    expected = [i for i in range(len(grid)) if value[i] >= value[near[i]].max()]
    assert find_local_maxima(grid, value, 0.25).tolist() == expected


def test_views_are_raised_out_of_the_floor():
    np.testing.assert_allclose(raise_views(slab(10, 10), np.array([[2, 5, 0]]), 1.6)[0], [0.25, 0.55, 1.65])


def test_gaps_in_the_floor_are_bridged_but_not_under_obstacles():
    holes = {(10, y) for y in range(20)} | {(x, 10) for x in range(20)} | {(11, y) for y in range(20)}
    grid = slab(20, 20, holes=holes)
    body = build_stick(0.25, 0.3, 1.5, 0.1)
    bridged = bridge_gaps(grid, select_unobstructed(grid, body), body, 0.3)
    assert {(10, 5, 0), (11, 5, 0), (5, 10, 0)} <= cells_of(bridged)
    wall = grid.replace_cells(
        np.concatenate([grid.cells, [(10, y, z) for y in range(20) for z in range(1, 25)]]).astype(np.int32)
    )
    bridged = bridge_gaps(wall, select_unobstructed(wall, body), body, 0.3)
    assert not any(c[0] in (9, 10, 11) and c[2] == 0 for c in cells_of(bridged))


def test_a_ceiling_is_no_floor_but_an_open_upper_storey_is():
    body = build_stick(0.25, 0.3, 1.5, 0.1)
    floor, ceiling = slab(40, 40), slab(40, 40, 25)
    room = floor.replace_cells(np.concatenate([floor.cells, ceiling.cells]))
    standing = remove_ceilings(room, select_unobstructed(room, body))
    assert set(standing.cells[:, 2].tolist()) == {0}
    ring = [(x, y, z) for x in range(40) for y in range(40) if x in (0, 39) or y in (0, 39) for z in range(26, 45)]
    above = room.replace_cells(np.concatenate([room.cells, ring]).astype(np.int32))
    assert set(remove_ceilings(above, select_unobstructed(above, body)).cells[:, 2].tolist()) >= {0, 25}


def test_the_ceiling_of_rooms_that_are_hardly_wider_than_their_walls_is_no_floor():
    """Of 42 x 42 columns two thirds lie over walls or beside them: what is hollow below are the rooms between."""
    ceiling, floor = slab(42, 42, 25), slab(42, 42)
    walls = [(x, y, z) for x in range(42) for y in range(42) if x % 10 < 2 or y % 10 < 2 for z in range(1, 25)]
    flat = floor.replace_cells(np.concatenate([floor.cells, ceiling.cells, walls]).astype(np.int32))
    standing = remove_ceilings(flat, select_unobstructed(flat, build_stick(0.25, 0.3, 1.5, 0.1)))
    assert set(standing.cells[:, 2].tolist()) == {0}


def test_largest_component_and_floors():
    big, small = slab(30, 30), slab(12, 12)
    both = np.concatenate([big.cells, small.cells + (40, 0, 0), [(60, y, 20) for y in range(40)], [(70, 0, 0)]])
    grid = VoxelGrid.from_cells(both.astype(np.int32))
    assert len(select_largest_component(grid)) == 900
    assert len(select_floor_components(grid)) == 900 + 144  # a strip one cell wide is the top of a wall, a single cell a scrap


def test_a_table_top_is_no_floor():
    top = slab(14, 8, 7).cells + (10, 10, 0)
    grid = slab(40, 40).replace_cells(np.concatenate([slab(40, 40).cells, top]).astype(np.int32))
    assert set(select_floor_components(grid).cells[:, 2].tolist()) == {0}
    platform = slab(38, 38, 7)  # as large as the floor: no furniture
    grid = grid.replace_cells(np.concatenate([slab(40, 40).cells, platform.cells]))
    assert set(select_floor_components(grid).cells[:, 2].tolist()) == {0, 7}
