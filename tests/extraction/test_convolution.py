"""Voxel convolution equals a loop over a dictionary (seeds 2.3.1)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.grids import COMPILED, grids, random_grid, row_of
from topomerge.extraction import convolution as conv
from topomerge.extraction.convolution import Kernel, convolve, count_at, is_any_at
from topomerge.types import VoxelGrid

KERNELS = {
    "von_neumann": conv.build_von_neumann(),
    "moore": conv.build_moore(with_origin=True),
    "sphere": conv.build_sphere(0.2, 0.1),
    "circle": conv.build_circle(0.3, 0.1, with_origin=False),
    "stick": conv.build_stick(0.25, 0.3, 1.75, 0.1),
    "aside": Kernel(np.array([[0, 0, 0], [0, 0, 1], [0, 0, 2], [9, 0, 12]]), np.array([2, 2, -1, 3]), np.array([4, -2, 3])),
}


@st.composite
def kernels(draw, lowest=-2):
    axis = st.integers(0, 5)
    cells = sorted(draw(st.sets(st.tuples(axis, axis, axis), min_size=1, max_size=25)))
    weights = draw(st.lists(st.integers(lowest, 2), min_size=len(cells), max_size=len(cells)))
    return Kernel(np.array(cells), np.array(weights, float), np.array(draw(st.tuples(axis, axis, axis))))


def neighbours(grid, cell, kernel):
    """(weight, row) of the cells of K_v that are occupied and take part."""
    known = row_of(grid)
    for v, weight in zip(kernel.cells, kernel.weights, strict=True):
        row = known.get(tuple((v + cell - kernel.origin).tolist()), -1)
        if row >= 0 and weight:
            yield float(weight), row


def twin(grid, kernel, function, values):
    out = []
    for i, cell in enumerate(grid.cells.astype(int)):
        found = list(neighbours(grid, cell, kernel))
        if function == "most_common":
            votes = {}
            for weight, row in found:
                if values[row] >= 0:
                    votes[int(values[row])] = votes.get(int(values[row]), 0) + weight
            winners = sorted(k for k, v in votes.items() if v == max(votes.values()))
            out.append(-1 if not winners else int(values[i]) if values[i] in winners else winners[0])
        else:
            start = np.full(values.shape[1:], 0.0 if function == "sum" else -np.inf)
            parts = [start, *(weight * values[row] for weight, row in found)]
            out.append((np.sum if function == "sum" else np.max)(parts, axis=0))
    return np.array(out).reshape(len(grid), *values.shape[1:])


@pytest.mark.longer
@COMPILED
@given(grids(size=9), kernels(), st.sampled_from(["sum", "max"]), st.sampled_from([(), (1,), (3,), (2, 2)]))
def test_sum_and_max(grid, kernel, function, shape):
    values = np.random.default_rng(0).integers(-5, 6, (len(grid), *shape))
    result = convolve(grid, kernel, function, values)
    assert result.shape == values.shape and result.dtype == np.float64
    assert np.array_equal(result, twin(grid, kernel, function, values))


@pytest.mark.longer
@COMPILED
@given(grids(size=9), kernels(lowest=0), st.integers(0, 99), st.sampled_from([np.int32, np.int64, np.int8]))
def test_most_common(grid, kernel, seed, dtype):
    labels = np.random.default_rng(seed).integers(-1, 4, len(grid)).astype(dtype)
    result = convolve(grid.assign_properties(room=labels), kernel, "most_common", "room")
    assert result.dtype == dtype
    assert np.array_equal(result, twin(grid, kernel, "most_common", labels))


@pytest.mark.longer
@COMPILED
@given(grids(size=9), kernels())
def test_occupancy(grid, kernel):
    ones = np.ones(len(grid))
    for function in ("sum", "max"):
        assert np.array_equal(convolve(grid, kernel, function), twin(grid, kernel, function, ones))


@pytest.mark.longer
@COMPILED
@given(grids(size=20), kernels(), st.lists(st.tuples(*[st.integers(-12, 30)] * 3), max_size=20))
def test_count_and_any_at_cells_that_may_be_empty(grid, kernel, cells):
    places = np.array(cells, np.int64).reshape(-1, 3)
    found = [list(neighbours(grid, p, kernel)) for p in places]
    assert count_at(grid, places, kernel).tolist() == [sum(w for w, _ in f) for f in found]
    assert is_any_at(grid, places, kernel).tolist() == [bool(f) for f in found]


@pytest.mark.parametrize("name", KERNELS)
def test_named_kernels_on_a_larger_grid(name):
    grid, kernel = random_grid(600, (40, 21, 30)), KERNELS[name]
    every = np.argwhere(np.ones(np.add(grid.shape, 6), bool)) - 3
    counted = count_at(grid, every, kernel)
    padded = np.zeros(np.add(grid.shape, 80), bool)
    padded[tuple((grid.cells + 40).T)] = True
    places, occupied = every + 40, np.zeros(len(every), int)
    total = np.zeros(len(every))
    for offset, weight in zip(kernel.offsets, kernel.weights, strict=True):
        hit = padded[tuple((places + offset).T)]
        total, occupied = total + weight * hit, occupied + (hit & (weight != 0))
    assert np.array_equal(counted, total)
    assert np.array_equal(is_any_at(grid, every, kernel), occupied > 0)
    assert np.array_equal(convolve(grid, kernel), count_at(grid, grid.cells, kernel))
    runs, weights = kernel.runs
    assert ((runs[:, 3] - runs[:, 2] + 1) * weights).sum() == kernel.weights.sum()


def offsets_of(kernel):
    return {tuple(o) for o in kernel.offsets.tolist()}


def test_neighbourhoods():
    steps = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    faces = {s for s in steps if sum(map(abs, s)) == 1}
    assert offsets_of(conv.build_von_neumann()) == faces
    assert offsets_of(conv.build_von_neumann(with_origin=True)) == faces | {(0, 0, 0)}
    assert offsets_of(conv.build_moore()) == set(steps) - {(0, 0, 0)}
    assert offsets_of(conv.build_moore(with_origin=True)) == set(steps)


@pytest.mark.parametrize("k", range(1, 8))
def test_round_kernels(k):
    reach = range(-k, k + 1)
    disc = {(x, y, 0) for x in reach for y in reach if x * x + y * y <= k * k}
    ball = {(x, y, z) for x in reach for y in reach for z in reach if x * x + y * y + z * z <= k * k}
    for edge in (0.1, 0.05, 0.3, 1.0):
        assert offsets_of(conv.build_circle(k * edge, edge)) == disc
        assert offsets_of(conv.build_sphere(k * edge, edge)) == ball
        assert offsets_of(conv.build_sphere(k * edge, edge, with_origin=False)) == ball - {(0, 0, 0)}


def test_stick_of_the_thesis():
    kernel = conv.build_stick(0.25, 0.3, 0.75, 0.1)  # a stem of 3 cells, a body of 3 x 3 x 8
    weight = dict(zip(map(tuple, kernel.offsets.tolist()), kernel.weights.tolist(), strict=True))
    assert weight.pop((0, 0, 0)) == 0
    assert set(weight.values()) == {1}
    body = {(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in range(4, 12)}
    assert set(weight) == body | {(0, 0, z) for z in (1, 2, 3)}
    assert {o[2] for o in offsets_of(conv.build_stick(0.0, 0.4, 0.1, 0.1))} == {0, 1}


def test_stick_leaves_room_for_a_step_but_not_for_a_table():
    floor = np.argwhere(np.ones((20, 20, 1), bool))
    grid = VoxelGrid.from_cells(np.concatenate([floor, [[5, 5, 2]], [[12, 12, 7]]]))
    kernel = conv.build_stick(0.25, 0.3, 1.75, 0.1)
    free = ~is_any_at(grid, grid.cells, kernel)
    blocked = {tuple(c) for c in grid.cells[~free].tolist()}
    assert blocked == {(5, 5, 0)} | {(x, y, 0) for x in (11, 12, 13) for y in (11, 12, 13)}
    assert np.array_equal(free, convolve(grid, kernel) == 0)


def test_ties_keep_the_label_of_the_cell_else_the_smallest():
    grid = VoxelGrid.from_cells(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]]))
    pair = Kernel.from_offsets(np.array([[-1, 0, 0], [1, 0, 0]]))
    assert convolve(grid, pair, "most_common", np.array([4, 9, 2])).tolist() == [9, 2, 9]
    assert convolve(grid, pair, "most_common", np.array([4, 4, 2])).tolist() == [4, 4, 4]
    assert convolve(grid, pair, "most_common", np.array([-1, 3, -1])).tolist() == [3, -1, 3]


def test_empty_neighbourhoods_and_grids():
    grid = VoxelGrid.from_cells(np.array([[3, 3, 3]]))
    assert convolve(grid, conv.build_moore(), "max").tolist() == [-np.inf]
    assert convolve(grid, conv.build_moore()).tolist() == [0]
    assert convolve(grid, conv.build_moore(), "most_common", np.array([5])).tolist() == [-1]
    nothing = Kernel.from_offsets(np.array([[0, 0, 0]]), 0.0)
    assert not is_any_at(grid, grid.cells, nothing).any() and convolve(grid, nothing).tolist() == [0]
    empty = grid.select_cells(np.zeros(1, bool))
    assert convolve(empty, conv.build_moore(), "max", np.zeros((0, 3))).shape == (0, 3)
    assert is_any_at(empty, np.array([[0, 0, 0]]), conv.build_moore()).tolist() == [False]


def test_wrong_arguments():
    grid, ball = random_grid(10), conv.build_sphere(0.2, 0.1)
    labels = np.zeros(len(grid), np.int32)
    minus = Kernel.from_offsets(np.array([[0, 0, 1]]), -1.0)
    for call, message in (
        (lambda: convolve(grid, ball, "median"), "median"),
        (lambda: convolve(grid, ball, "sum", "colour"), "colour"),
        (lambda: convolve(grid, ball, "sum", labels[1:]), "one row a cell"),
        (lambda: convolve(grid, ball, "most_common", labels.astype(float)), "integers"),
        (lambda: convolve(grid, ball, "most_common", np.zeros((len(grid), 2), int)), "integers"),
        (lambda: convolve(grid, minus, "most_common", labels), "votes"),
        (lambda: conv.build_sphere(-0.1, 0.1), "radius"),
        (lambda: conv.build_circle(0.1, 0.0), "edge"),
        (lambda: conv.build_stick(0.2, 0.3, np.nan, 0.1), "above 0"),
        (lambda: Kernel(np.zeros((0, 3)), np.zeros(0), np.zeros(3)), "k > 0"),
        (lambda: Kernel(np.zeros((2, 3)), np.ones(2), np.zeros(3)), "unique"),
        (lambda: Kernel(np.zeros((1, 3)) - 1, np.ones(1), np.zeros(3)), "negative"),
        (lambda: Kernel(np.zeros((1, 3)), np.ones(2), np.zeros(3)), "weights"),
        (lambda: Kernel(np.zeros((1, 3)), np.array([np.nan]), np.zeros(3)), "weights"),
        (lambda: Kernel(np.zeros((1, 3)), np.ones(1), np.zeros(2)), "origin"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
