"""What tells the right place from one that is nearly alike: walls part by part, furniture, what hangs from ceilings."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fusion.plans_of import MOVE, grid_of, office, part
from tests.scenes import Scene
from topomerge.matching.poses import PlanFields
from topomerge.registration.judge import Judge, compute_winner_features
from topomerge.registration.pipeline import register
from topomerge.registration.storeys import build_plans
from topomerge.types import Sim3


def storeys(points):
    return tuple(PlanFields(p) for p in build_plans(grid_of(points)))


def seen(a, b, pose=None):
    """Features of points, or of the storeys of points, upon others."""
    fields = (points if isinstance(points, tuple) else storeys(points) for points in (a, b))
    return compute_winner_features(Judge(*fields), pose or Sim3())


def stretched(points, beyond=14.0, by=1.6):
    """The same wing with an end that is longer: all beyond x is moved, and walls along x reach to it."""
    out = points.copy()
    far = out[:, 0] > beyond
    out[far, 0] = beyond + (out[far, 0] - beyond) * by
    return out


@pytest.fixture(scope="module")
def points():
    return office().points()


@pytest.fixture(scope="module")
def whole(points):
    return storeys(points)


def test_a_map_on_itself_agrees_everywhere(whole):
    found = seen(whole, whole)
    assert found["moved_walls"] < 0.01 and found["worst_ratio"] > 0.95 and found["bad_squares"] == 0
    assert found["tall_conflict"] == 0 and found["in_place"] == pytest.approx(found["pieces"], rel=0.1)
    assert found["by_chance"] < 0.4 * found["in_place"] and found["squares"] > 20


def test_a_longer_end_fits_only_when_it_is_moved(whole, points):
    itself, twin = seen(whole, whole), seen(whole, stretched(points))
    assert twin["moved_walls"] > 0.03 > itself["moved_walls"]
    assert twin["worst_ratio"] < itself["worst_ratio"] and twin["bad_squares"] > 0


def test_furniture_in_place_is_counted(whole):
    empty = office(furnished=False).points()
    other = Scene().box(3, 4, 0, 4.4, 4.8, 0.75).box(21.5, 5, 0, 22.9, 5.8, 0.75).points()
    moved = np.concatenate([empty, other])
    assert seen(whole, whole)["in_place"] > 5 > seen(whole, moved)["in_place"] + 4
    assert seen(whole, empty)["pieces"] == pytest.approx(0, abs=0.5)  # what one map does not show at all says nothing


def test_what_hangs_from_the_ceiling_is_compared(whole, points):
    lamps = Scene().box(2, 2, 2.2, 3.6, 2.3, 2.4).box(7, 3, 2.2, 8.6, 3.3, 2.4).box(9, 11, 2.2, 10.6, 11.3, 2.4).points()
    shifted = lamps + np.array([0, 1.2, 0], np.float32)
    with_lamps, others = np.concatenate([points, lamps]), np.concatenate([points, shifted])
    lit = storeys(with_lamps)
    same, different = seen(lit, lit), seen(lit, others)
    assert same["hanging"] > 2 and same["hanging_met"] == pytest.approx(same["hanging"], rel=0.1)
    assert different["hanging"] > 2 and different["hanging_met"] < 0.3
    assert seen(whole, whole)["hanging"] < 0.5


def test_both_ways_say_the_same(whole, points):
    """Which map comes first decides nothing but rounding."""
    half = storeys(part(points, high=(17, 99)))
    there, back = seen(whole, half), seen(half, whole)
    for name in there:
        assert there[name] == pytest.approx(back[name], rel=0.1, abs=0.1), name


@pytest.mark.longer
def test_a_wing_with_another_end_is_not_believed(points):
    twin = stretched(office(furnished=False).points(), 10.0, 1.4)
    assert not register(grid_of(points), grid_of(twin, MOVE)).accepted
