"""Whether a pose is believed, and what amounts do to it."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fusion.plans_of import MOVE, grid_of, off, office, part
from tests.scenes import Scene
from topomerge.fusion.registration import register
from topomerge.fusion.verify import LEAD_VECTOR, POSE_VECTOR, WINNER_VECTOR, model, winner_vector


@pytest.fixture(scope="module")
def points():
    return office().points()


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
