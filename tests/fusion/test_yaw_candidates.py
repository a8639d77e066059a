"""Turns under which walls are parallel."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from topomerge.fusion.yaw_candidates import yaw_candidates
from topomerge.matching.plan_fields import direction_profile


def test_yaw_candidates_of_a_pentagon():
    angles = 2 * np.pi * np.arange(6) / 5
    corners = 10 * np.column_stack([np.cos(angles), np.sin(angles)])
    walls = np.concatenate([p + (q - p) * np.linspace(0, 1, 120)[:, None] for p, q in pairwise(corners)])
    turn = np.radians(23.0)
    c, s = np.cos(turn), np.sin(turn)
    found = yaw_candidates(direction_profile(walls @ np.array([[c, s], [-s, c]]), 0.1), direction_profile(walls, 0.1))
    assert min(abs(np.degrees(y) - 23.0) for y in found) < 1.0
