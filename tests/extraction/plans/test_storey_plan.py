"""The one type of plans, and the rule for walls."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.extraction.plans.storey_plan import (
    HeightBands,
    StoreyPlan,
    WallRule,
    build_band_stack,
    detect_wall_columns,
    is_observed_band,
)

BANDS = HeightBands(step=0.25, below=2, count=32)


def filled(*numbers: int) -> np.ndarray:
    """(6, 1, n) bands of a row of columns, of which each fills so many from below."""
    return np.arange(6)[:, None, None] < np.array(numbers)[None, None]


def test_masks_of_heights():
    assert BANDS.build_mask(0.5, 2.0) == 0b111111 << 4
    assert BANDS.build_mask(-0.5, 0.25) == 0b111
    assert HeightBands(0.1, 4, 64).build_mask(0.0, 0.01) == 1 << 4  # one band at least


def test_four_of_six_bands_are_a_wall():
    assert detect_wall_columns(filled(0, 0, 4, 0, 0, 3, 0, 0), WallRule()).tolist() == [[False, False, True] + [False] * 5]


@pytest.mark.parametrize(("rule", "walls"), [(WallRule(), False), (WallRule(lacking=2), True)])
def test_a_column_may_lack_bands_beside_a_full_one(rule, walls):
    assert bool(detect_wall_columns(filled(2, 6), rule)[0, 0]) is walls
    assert detect_wall_columns(filled(3, 6), rule)[0, 0]


def test_bands_that_nobody_looked_at_do_not_count():
    bands = filled(2, 2, 2)
    seen = bands[is_observed_band(bands)]
    assert len(seen) == 2 and detect_wall_columns(seen, WallRule()).all()
    assert not detect_wall_columns(seen, WallRule(least_bands=3)).any()
    assert not is_observed_band(np.zeros((6, 3, 3), bool)).any()


def test_what_a_plan_derives():
    profile = np.array([[0b111111 << 4, 1 << 4, 0, 1 << 11]], np.uint32)
    wall, inside = np.array([[True, False, False, False]]), np.array([[False, True, True, True]])
    ceiling = np.array([[np.nan, 2.5, 2.5, np.nan]])
    plan = StoreyPlan(np.zeros(2), 0.1, wall, inside, profile, BANDS, np.full((1, 4), 3.0), ceiling, levels=(np.nan, 5.5))
    assert plan.clutter.tolist() == [[False, True, False, False]] and plan.free.tolist() == [[False, False, True, True]]
    assert plan.explored.all() and plan.floor_guess == pytest.approx(2.8)
    assert plan.ceiling_height[0, 1] == 5.5 and np.isnan(plan.ceiling_height[0, 3])
    assert build_band_stack(profile, BANDS).sum(axis=0).tolist() == [[6, 1, 0, 0]]
    assert plan.compute_points(wall).tolist() == [[0.05, 0.05]]
