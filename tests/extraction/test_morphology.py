"""Discs laid along lines give what distance transforms give."""

from __future__ import annotations

import edt
import numpy as np
import pytest

from topomerge.extraction.morphology import _find_closing_columns, _near, compute_horizontal_distance_field, is_surrounded
from topomerge.types import VoxelGrid


@pytest.mark.parametrize("radius", [1, 1.5, 2, 3.0000001, 4.7, 10])
def test_near_is_what_a_distance_transform_says(radius: float) -> None:
    mask = np.random.default_rng(1).random((90, 130)) < 0.02
    assert np.array_equal(_near(mask, radius), edt.edtsq((~mask).view(np.uint8)) <= radius**2)


def test_closing_is_the_same_in_tiles_and_at_once() -> None:
    """A gap across the border of two tiles is closed; a wider one is not."""
    x = np.concatenate([np.arange(200, 254), np.arange(258, 300), np.arange(310, 340)])
    floor = np.array([(i, j) for i in x for j in range(250, 265)])
    added = _find_closing_columns(floor, 3.0)
    assert set(added[:, 0].tolist()) == {254, 255, 256, 257} and set(added[:, 1].tolist()) <= set(range(250, 265))
    assert len(added) >= 4 * 13


@pytest.mark.parametrize("edge", [0.05, 0.1, 0.13])
def test_cells_on_all_sides_are_those_of_the_distance_field(edge: float) -> None:
    cells = np.unique(np.random.default_rng(2).integers(0, 30, (25_000, 3)), axis=0).astype(np.int32)
    grid = VoxelGrid.from_cells(cells, np.zeros(3), edge)
    field = compute_horizontal_distance_field(grid)
    for radius in range(4):
        assert np.array_equal(is_surrounded(grid, grid.cells, radius), field >= radius)
