"""Loops of bending against slow twins.

The inverse on the entries of a factor is the inverse.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.spatial import cKDTree

from topomerge.kernels.bend import blend_moves, compute_wall_gain, sum_shifted_values
from topomerge.registration.bend.graph import _factor, _invert_factor


def test_gain_is_that_of_the_table_less_what_is_lost_where_something_is_known() -> None:
    rng = np.random.default_rng(0)
    level, seen = rng.integers(0, 256, (3, 9, 7), np.uint8), rng.random((9, 7)) < 0.5
    table, lost = rng.normal(size=256).astype(np.float32), rng.random((9, 7)).astype(np.float32)
    expected = np.where(seen | (table[level] > 0), table[level] - lost, 0)
    assert np.array_equal(compute_wall_gain(level, table, lost, seen), expected)


def test_blended_moves_are_means_weighed_by_nearness() -> None:
    rng, reach = np.random.default_rng(1), 2.5
    points, anchors, moves = rng.uniform(0, 20, (50, 2)), rng.uniform(0, 20, (8, 2)), 0.2 * rng.normal(size=(8, 4))
    distance, nearest = cKDTree(anchors).query(points, 5)
    slow = np.zeros((50, 2))
    for p, point in enumerate(points):
        weights, shifts = [], []
        for k in nearest[p]:
            x, y, turn, size = moves[k]
            turned = np.exp(size) * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            shifts.append(anchors[k] + (x, y) + turned @ (point - anchors[k]) - point)
            weights.append(np.exp(-((point - anchors[k]) ** 2).sum() / (2 * reach**2)))
        slow[p] = np.average(shifts, axis=0, weights=weights)
    assert blend_moves(points, distance, nearest, anchors, moves, reach) == pytest.approx(slow)


@pytest.mark.parametrize("count", [1, 5, 60, 300])
def test_it_is_the_inverse_wherever_the_matrix_has_entries(count: int) -> None:
    half = sparse.random(count, count, 0.02, random_state=count)
    matrix = half @ half.T + 0.5 * sparse.eye(count)
    inverse = _invert_factor(_factor(matrix)).toarray()
    there = inverse != 0
    assert (there >= (matrix.toarray() != 0)).all() and (inverse == inverse.T).all()
    np.testing.assert_allclose(inverse[there], np.linalg.inv(matrix.toarray())[there], atol=1e-12)


def test_sums_of_moved_points() -> None:
    """Each owner's points on a raster, as NumPy sums them; what falls beside it counts nothing."""
    rng = np.random.default_rng(0)
    points, weights, owner = rng.uniform(-1, 5, (200, 2)), rng.uniform(0, 1, 200), rng.integers(0, 3, 200)
    values, shifts = rng.uniform(0, 1, (40, 30)), rng.uniform(-1, 1, (4, 2))
    sums = sum_shifted_values(points, weights, owner, 3, shifts, values, np.array([0.2, 0.1]), 0.1)
    for shift, row in zip(shifts, sums, strict=True):
        cells = np.floor((points + shift - (0.2, 0.1)) / 0.1).astype(int)
        inside = ((cells >= 0) & (cells < values.shape)).all(axis=1)
        gained = np.where(inside, values[tuple(np.where(inside[:, None], cells, 0).T)] * weights, 0.0)
        np.testing.assert_allclose(row, np.bincount(owner, gained, 3))
