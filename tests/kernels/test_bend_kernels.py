"""Loops of bending against slow twins."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from topomerge.kernels.bend import blend_moves, compute_wall_gain


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
