"""Turns under which walls are parallel."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from topomerge.registration.search import find_yaw_candidates, select_distinct_yaws
from topomerge.structure.directions import compute_direction_profile


def test_yaw_candidates_of_a_pentagon():
    angles = 2 * np.pi * np.arange(6) / 5
    corners = 10 * np.column_stack([np.cos(angles), np.sin(angles)])
    walls = np.concatenate([p + (q - p) * np.linspace(0, 1, 120)[:, None] for p, q in pairwise(corners)])
    turn = np.radians(23.0)
    c, s = np.cos(turn), np.sin(turn)
    found = find_yaw_candidates(
        compute_direction_profile(walls @ np.array([[c, s], [-s, c]]), 0.1), compute_direction_profile(walls, 0.1)
    )
    assert min(abs(np.degrees(y) - 23.0) for y in found) < 1.0


def test_yaws_that_are_nearly_one_are_tried_once():
    yaws = np.radians([10.0, 190.0, 10.3, -170.4, 100.0, 11.0, 370.1])
    assert select_distinct_yaws(yaws.tolist()) == pytest.approx(np.radians([10.0, 190.0, 100.0, 11.0]))
