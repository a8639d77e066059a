"""What tells the right place from one that is nearly alike: walls part by part, furniture, what hangs from ceilings."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fusion.plans_of import MOVE, grid_of, off, office, part
from tests.scenes import Scene
from topomerge.fusion.judge import Judge
from topomerge.fusion.registration import register
from topomerge.fusion.storey_plan import plans
from topomerge.fusion.verify import LEAD_VECTOR, POSE_VECTOR, WINNER_VECTOR, model, winner_vector
from topomerge.fusion.winner_features import winner_features
from topomerge.matching.plan_fields import PlanFields
from topomerge.types import Sim3


def storeys(points):
    return tuple(PlanFields(p) for p in plans(grid_of(points)))


def seen(a, b, pose=None):
    return winner_features(Judge(storeys(a), storeys(b)), pose or Sim3())


def stretched(points, beyond=14.0, by=1.6):
    """The same wing with an end that is longer: all beyond x is moved, and walls along x reach to it."""
    out = points.copy()
    far = out[:, 0] > beyond
    out[far, 0] = beyond + (out[far, 0] - beyond) * by
    return out


@pytest.fixture(scope="module")
def points():
    return office().points()


def test_a_map_on_itself_agrees_everywhere(points):
    found = seen(points, points)
    assert found["moved_walls"] < 0.01 and found["worst_ratio"] > 0.95 and found["bad_squares"] == 0
    assert found["tall_conflict"] == 0 and found["in_place"] == pytest.approx(found["pieces"], rel=0.1)
    assert found["by_chance"] < 0.4 * found["in_place"] and found["squares"] > 20


def test_a_longer_end_fits_only_when_it_is_moved(points):
    itself, twin = seen(points, points), seen(points, stretched(points))
    assert twin["moved_walls"] > 0.03 > itself["moved_walls"]
    assert twin["worst_ratio"] < itself["worst_ratio"] and twin["bad_squares"] > 0


def test_furniture_in_place_is_counted(points):
    empty = office(furnished=False).points()
    other = Scene().box(3, 4, 0, 4.4, 4.8, 0.75).box(21.5, 5, 0, 22.9, 5.8, 0.75).points()
    moved = np.concatenate([empty, other])
    assert seen(points, points)["in_place"] > 5 > seen(points, moved)["in_place"] + 4
    assert seen(points, empty)["pieces"] == pytest.approx(0, abs=0.5)  # what one map does not show at all says nothing


def test_what_hangs_from_the_ceiling_is_compared(points):
    lamps = Scene().box(2, 2, 2.2, 3.6, 2.3, 2.4).box(7, 3, 2.2, 8.6, 3.3, 2.4).box(9, 11, 2.2, 10.6, 11.3, 2.4).points()
    shifted = lamps + np.array([0, 1.2, 0], np.float32)
    with_lamps, others = np.concatenate([points, lamps]), np.concatenate([points, shifted])
    same, different = seen(with_lamps, with_lamps), seen(with_lamps, others)
    assert same["hanging"] > 2 and same["hanging_met"] == pytest.approx(same["hanging"], rel=0.1)
    assert different["hanging"] > 2 and different["hanging_met"] < 0.3
    assert seen(points, points)["hanging"] < 0.5


def test_both_ways_say_the_same(points):
    """Which map comes first decides nothing but rounding."""
    half = part(points, high=(17, 99))
    there, back = seen(points, half), seen(half, points)
    for name in there:
        assert there[name] == pytest.approx(back[name], rel=0.1, abs=0.1), name


def test_the_calibration_fits_its_features():
    found = model()
    assert found["names"] == [*POSE_VECTOR, *LEAD_VECTOR, *WINNER_VECTOR]
    for kind in ("solid", "flat"):
        winner, pose = (found[kind][which]["weight"] for which in ("winner", "pose"))
        assert len(winner) == len(found["names"]) and len(pose) == len(POSE_VECTOR)
    assert 0.5 <= found["threshold"] < 1


def test_little_evidence_is_no_praise():
    """Shares of nothing are drawn to what is usual: two walls that just touch must not beat a building that agrees."""
    known = dict.fromkeys(("tall_conflict", "crossing", "squares", "bad_squares", "in_place", "pieces", "by_chance"), 0.0)
    known |= {"moved_walls": 0.0, "worst_ratio": 0.5, "hanging": 0.0, "hanging_met": 0.0, "free": 0.0}
    assert np.isfinite(winner_vector(known)).all() and len(winner_vector(known)) == len(WINNER_VECTOR)


def test_amounts_grow_no_more_on_large_floors():
    """Ten times the floor with ten times the pieces out of place, lamps gone and high walls in the way says the same."""
    amounts = {"tall_conflict": 2.0, "pieces": 30.0, "in_place": 10.0, "by_chance": 1.0, "hanging": 9.0, "hanging_met": 4.0}
    shares = {"crossing": 20.0, "squares": 20.0, "bad_squares": 0.1, "moved_walls": 0.02, "worst_ratio": 0.7}
    names = [WINNER_VECTOR.index(n) for n in ("tall", "in_place", "out_of_place", "hanging", "fallen")]
    floors = [{**shares, **{k: m * v for k, v in amounts.items()}, "free": m * 2000.0} for m in (1.0, 10.0)]
    one, ten = (winner_vector(f)[names] for f in floors)
    assert np.allclose(one, ten, atol=0.1)
    small = winner_vector({**floors[0], "free": 20.0})[names]
    assert (small > one + 0.5).all()


def test_a_wing_with_another_end_is_not_believed(points):
    twin = stretched(office(furnished=False).points(), 10.0, 1.4)
    assert not register(grid_of(points), grid_of(twin, MOVE)).accepted


def test_rooms_without_a_partner_change_nothing(points):
    """A wing that the other map never saw is added: the pose stays."""
    wing = Scene().shell(30, 0, 41, 9).wall((35, 0), (35, 9), doors=(4.0,)).points()
    b = grid_of(part(points, low=(5, -99)), MOVE)
    alone = register(grid_of(points), b)
    more = register(grid_of(np.concatenate([points, wing])), b)
    for found in (alone, more):
        assert off(found.transform, MOVE.inverse(), tuple(MOVE.apply(np.array([[14.0, 7.0, 1.0]]))[0]))[0] < 0.03
    assert abs(alone.probability - more.probability) < 0.15


def test_the_alternatives_have_probabilities(points):
    found = register(grid_of(part(points, high=(16, 99))), grid_of(part(points, low=(5, -99)), MOVE))
    every = [a.probability for a in found.alternatives]
    assert every[0] == found.probability and every == sorted(every, reverse=True) and sum(every) <= 1.0
