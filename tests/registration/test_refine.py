"""The fine registration, point to plane."""

from __future__ import annotations

import pytest

from tests.fusion.plans_of import grid_of, off, office
from topomerge.registration.refine import build_surface, refine_pose
from topomerge.types import Sim3


@pytest.fixture(scope="module")
def points():
    return office().points()


def test_point_to_plane_recovers_a_small_motion(points):
    grid = grid_of(points)
    true = Sim3(0.02, (0.12, -0.1, 0.08))
    found = refine_pose(build_surface(grid_of(points, true)), build_surface(grid), Sim3())
    metres, degrees = off(found.pose, true)
    assert metres < 0.02 and degrees < 0.05 and found.partners > 0.8
