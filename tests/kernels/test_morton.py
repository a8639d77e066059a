"""Morton codes equal their bit-by-bit twin, and order cells by octants (seeds 2.2.1)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.grids import COMPILED, interleave
from topomerge.kernels import voxels

AXIS = st.integers(0, voxels.AXIS_LIMIT - 1)
CELL_ARRAYS = st.lists(st.tuples(AXIS, AXIS, AXIS), min_size=1, max_size=30).map(lambda c: np.array(c, np.int32))


@COMPILED
@given(CELL_ARRAYS)
def test_code_interleaves_the_bits(cells):
    assert voxels.encode(cells).tolist() == [interleave(c) for c in cells]


@COMPILED
@given(CELL_ARRAYS)
def test_round_trip(cells):
    decoded = voxels.decode(voxels.encode(cells))
    assert decoded.dtype == np.int32
    assert np.array_equal(decoded, cells)


@COMPILED
@given(CELL_ARRAYS, st.integers(0, voxels.BITS))
def test_prefix_is_the_octant(cells, level):
    assert np.array_equal(voxels.encode(cells) >> np.uint64(3 * level), voxels.encode(cells >> level))


@COMPILED
@given(CELL_ARRAYS, st.integers(1, voxels.BITS))
def test_order_keeps_octants_together(cells, level):
    order = np.argsort(voxels.encode(cells), kind="stable")
    octants = [tuple(c) for c in (cells[order] >> level).tolist()]
    changes = sum(a != b for a, b in pairwise(octants))
    assert changes == len(set(octants)) - 1


@COMPILED
@given(AXIS, AXIS, AXIS, st.integers(0, 2))
def test_code_grows_along_each_axis(x, y, z, axis):
    low, high = np.array([[x, y, z]]), np.array([[x, y, z]])
    high[0, axis] = voxels.AXIS_LIMIT - 1
    assert voxels.encode(low)[0] <= voxels.encode(high)[0]


def test_corners_of_the_range():
    cells = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [voxels.AXIS_LIMIT - 1] * 3])
    assert voxels.encode(cells).tolist() == [0, 1, 2, 4, 2**63 - 1]


@pytest.mark.parametrize("dtype", [np.int32, np.int64, np.uint32])
def test_empty_and_types(dtype):
    assert voxels.encode(np.zeros((0, 3), dtype)).shape == (0,)
    assert voxels.decode(np.zeros(0, np.uint64)).shape == (0, 3)
    assert voxels.encode(np.array([[3, 5, 6]], dtype))[0] == interleave((3, 5, 6))


@COMPILED
@given(st.lists(st.one_of(st.integers(0, 20), st.integers(0, 2**63 - 1)), max_size=60))
def test_unique_rows_is_the_index_of_numpy_unique(codes):
    array = np.array(codes, np.uint64)
    assert np.array_equal(voxels.find_unique_rows(array), np.unique(array, return_index=True)[1])


def test_unique_rows_of_many():
    codes = np.random.default_rng(0).integers(0, 2**27, 20000).astype(np.uint64)
    assert np.array_equal(voxels.find_unique_rows(codes), np.unique(codes, return_index=True)[1])
    ordered = np.unique(codes)
    assert np.array_equal(voxels.find_unique_rows(ordered), np.arange(len(ordered)))
