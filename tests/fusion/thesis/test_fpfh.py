"""Point features against a count by hand."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.fusion.thesis.fpfh import ANGLE_BINS, fpfh
from topomerge.types import Sim3


def test_two_points_by_hand():
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    histograms = fpfh(points, normals, 2.0)
    # Both normals are across the line between them: the three angles are 0, in the middle bin of each.
    expected = np.zeros(3 * ANGLE_BINS)
    expected[[ANGLE_BINS // 2 + ANGLE_BINS * k for k in range(3)]] = 100
    assert np.allclose(histograms, [expected, expected])


def test_a_right_angle_by_hand():
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    first = fpfh(points, normals, 2.0)[0]
    # From the first point: across = z x x = y, so alpha = y . y = 1; from the second one: y x -x = z, alpha = z . z = 1.
    assert first[ANGLE_BINS - 1] == pytest.approx(100) and first[:ANGLE_BINS].sum() == pytest.approx(100)


def test_features_do_not_change_when_all_is_turned():
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(0, 3, (300, 3)), rng.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turn = Sim3(1.0, (3.0, -2.0, 1.0))
    there = fpfh(turn.apply(points), Sim3(1.0).apply(normals), 0.8)
    same = np.isclose(there, fpfh(points, normals, 0.8), atol=1e-6).all(axis=1)
    assert same.mean() > 0.98  # an angle on the border of two bins may fall on either side


def test_lonely_points_have_no_features():
    assert not fpfh(np.array([[0.0, 0, 0], [9.0, 0, 0]]), np.eye(3)[:2], 1.0).any()
    assert fpfh(np.zeros((0, 3)), np.zeros((0, 3)), 1.0).shape == (0, 3 * ANGLE_BINS)
