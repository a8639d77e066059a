"""Whether a pose is believed, and what amounts do to it."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fusion.plans_of import MOVE, grid_of, off, office, part
from tests.scenes import Scene
from topomerge.fusion.registration import register
from topomerge.fusion.verify import (
    BEND_VECTOR,
    LEAD_VECTOR,
    MARGIN_CAP,
    POSE_VECTOR,
    WINNER_VECTOR,
    lead,
    model,
    plausibility,
    probability,
    vector,
    winner_vector,
)
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3


@pytest.fixture(scope="module")
def points():
    return office().points()


def test_the_calibration_fits_its_features():
    found = model()
    assert found["names"] == [*POSE_VECTOR, *LEAD_VECTOR, *WINNER_VECTOR, *BEND_VECTOR]
    for kind in ("solid", "flat"):
        winner, pose = (found[kind][which]["weight"] for which in ("winner", "pose"))
        assert len(winner) == len(found["names"]) and len(pose) == len(POSE_VECTOR)
    assert 0.5 <= found["threshold"] < 1


def test_nothing_at_all_gives_numbers():
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


FEATURES = {
    "ratio": 0.8, "walls": 20.0, "conflict": 2.0, "conflict_share": 0.09, "worst_conflict": 0.12, "free": 150.0, "opposed": 0.03,
    "met": 0.6, "chance": 0.1, "clutter": 9.0, "share": 0.7, "sliced": 0.0, "level": 0.05, "ceilings": 0.08, "ceiling_area": 60.0,
}  # fmt: skip


def seen(**changes: float) -> dict[str, float]:
    """The vector of features by name."""
    return dict(zip(POSE_VECTOR, vector({**FEATURES, **changes}).tolist(), strict=True))


def test_the_vector_of_a_pose_by_hand():
    found = seen()
    assert (found["ratio"], found["opposed"], found["share"], found["sliced"], found["level"]) == (0.8, 0.03, 0.7, 0.0, 0.05)
    assert found["walls"] == pytest.approx(np.log(20.1)) and found["free"] == pytest.approx(np.log(151.0))
    assert found["conflict"] == pytest.approx(np.log((0.09 * 22 + 0.15) / 23 + 0.01))
    assert found["worst"] == pytest.approx(np.log((0.12 * 22 + 0.15) / 23 + 0.01))
    assert found["lift"] == pytest.approx(0.5 * np.sqrt(0.9)) and found["met"] == pytest.approx(np.log1p(5.4))
    assert found["missed"] == pytest.approx(np.log1p(3.6)) and found["ceilings"] == pytest.approx(np.log(0.1) + 2.7)
    assert found["sliced_conflict"] == 0.0 and seen(sliced=1.0)["sliced_conflict"] == pytest.approx(found["conflict"])


def test_shares_of_little_are_drawn_to_what_is_usual():
    """No conflict of next to nothing says less than no conflict of 50 m2."""
    little, much = (seen(walls=w, conflict=0.0, conflict_share=0.0, worst_conflict=0.0)["conflict"] for w in (0.1, 50.0))
    assert little == pytest.approx(np.log(0.15 / 1.1 + 0.01)) and much < little - 2
    assert seen(ceiling_area=3.0)["ceilings"] == pytest.approx(0.1 * seen()["ceilings"])
    assert seen(level=3.0)["level"] == 0.5


def test_the_lead_over_rivals_by_hand():
    scores, one = np.array([5.0, 4.0, 1.0]), np.ones(len(POSE_VECTOR))
    vectors = np.array([vector(FEATURES), vector({**FEATURES, "walls": 7.0}), vector({**FEATURES, "walls": 5.0, "ratio": 0.9})])
    margin, ahead, alone, share = lead(scores, vectors, one, 2 * one)
    assert margin == 1.0 and share == pytest.approx(1 / (1 + np.exp(-1) + np.exp(-4)))
    assert alone == pytest.approx(np.log(share / (1 - share + 1e-3)))
    names = ("ratio", "conflict", "worst", "opposed", "lift", "sliced_conflict", "level", "ceilings")
    quality = [sum(v[POSE_VECTOR.index(n)] / 2 for n in names) for v in vectors]
    assert ahead == pytest.approx(quality[0] - quality[1])  # the third explains too little to be a rival
    assert lead(scores[:1], vectors[:1], one, one)[:3] == (MARGIN_CAP, MARGIN_CAP, pytest.approx(MARGIN_CAP))


def test_the_probability_is_at_most_the_share_of_the_odds():
    """A second hypothesis that is as good halves what the first may be believed; the rest share as their odds do."""
    quiet = {"tall_conflict": 0.0, "crossing": 30.0, "worst_ratio": 0.95, "squares": 60.0, "bad_squares": 0.0, "in_place": 20.0}
    quiet |= {"strain": 0.1, "bent": 0.02, "doubted": 0.0}
    quiet |= {"pieces": 20.0, "by_chance": 1.0, "moved_walls": 0.0, "hanging": 9.0, "hanging_met": 9.0}
    good = {**FEATURES, "conflict_share": 0.0, "worst_conflict": 0.0, "conflict": 0.0, "met": 0.95, "walls": 80.0, "free": 400.0}
    first, second, third = (PoseHypothesis(Sim3(), score, features=good) for score in (9.0, 9.0, 8.0))
    alone, every = probability([first], quiet)
    assert alone > 0.8 and every == [alone]
    halved, shares = probability([first, second, third], quiet)
    assert halved <= 1 / (2 + np.exp(-1)) and shares[1] == pytest.approx(shares[0]) == halved
    assert shares[2] == pytest.approx(halved * np.exp(-1))


@pytest.mark.parametrize(
    "change", [{"conflict_share": 0.3, "worst_conflict": 0.3, "conflict": 8.0}, {"met": 0.2}, {"free": 10.0}]
)
def test_what_speaks_against_a_pose_makes_it_less_plausible(change):
    assert plausibility({**FEATURES, **change}) < plausibility(FEATURES)
    assert plausibility({**FEATURES, "sliced": 1.0}) != plausibility(FEATURES)  # slices are judged by models of their own
