"""Whether a pose is believed, and what amounts do to it."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fusion.plans_of import MOVE, grid_of, off, office, part
from tests.scenes import Scene
from topomerge.matching.poses import PoseHypothesis
from topomerge.registration.pipeline import register
from topomerge.registration.posterior import FEW, KINDS, POSTERIOR
from topomerge.registration.verify import (
    AMOUNT_COUNTS,
    BELIEF_VECTOR,
    BENT_POSE_VECTOR,
    MARGIN_CAP,
    PLAN_VECTOR,
    POSE_VECTOR,
    WINNER_VECTOR,
    compute_bent_pose_vector,
    compute_furniture_log_odds,
    compute_lead,
    compute_plan_odds,
    compute_plan_vector,
    compute_pose_vector,
    compute_quality_lag,
    compute_verdict,
    compute_winner_vector,
    load_model,
    score_bent,
    score_plausibility,
)
from topomerge.types import Sim3


@pytest.fixture(scope="module")
def points():
    return office().points()


def test_the_calibration_fits_its_features():
    found = load_model()
    assert tuple(found["names"]) == BELIEF_VECTOR
    for kind in ("solid", "flat"):
        sizes = {"pose": len(POSE_VECTOR), "bent": len(BENT_POSE_VECTOR), "winner": len(BELIEF_VECTOR)}
        assert all(len(found[kind][which]["weight"]) == size for which, size in sizes.items())
        assert np.shape(found[kind]["kinds"]["weight"]) == (len(KINDS), len(BELIEF_VECTOR))
        assert len(found[kind]["plan"]["weight"]) == len(PLAN_VECTOR) and min(found[kind]["plan"]["weight"]) > 0
    assert 0.5 <= found["threshold"] < 1
    thresholds, false = np.array(found["risk"]).T
    assert (np.diff(thresholds) > 0).all() and (np.diff(false) <= 0).all()


def test_nothing_at_all_gives_numbers():
    known = dict.fromkeys(("tall_conflict", "crossing", "squares", "bad_squares", "in_place", "pieces", "by_chance"), 0.0)
    known |= {"moved_walls": 0.0, "worst_ratio": 0.5, "hanging": 0.0, "hanging_met": 0.0, "free": 0.0}
    assert np.isfinite(compute_winner_vector(known)).all() and len(compute_winner_vector(known)) == len(WINNER_VECTOR)


def test_amounts_grow_no_more_on_large_floors():
    """Ten times the floor with ten times the pieces out of place, lamps gone and high walls in the way says the same."""
    amounts = {"tall_conflict": 2.0, "pieces": 30.0, "in_place": 10.0, "by_chance": 1.0, "hanging": 9.0, "hanging_met": 4.0}
    shares = {"crossing": 20.0, "squares": 20.0, "bad_squares": 0.1, "moved_walls": 0.02, "worst_ratio": 0.7}
    names = [WINNER_VECTOR.index(n) for n in ("tall", "in_place", "out_of_place", "hanging", "fallen")]
    floors = [{**shares, **{k: m * v for k, v in amounts.items()}, "free": m * 2000.0} for m in (1.0, 10.0)]
    one, ten = (compute_winner_vector(f)[names] for f in floors)
    assert np.allclose(one, ten, atol=0.1)
    small = compute_winner_vector({**floors[0], "free": 20.0})[names]
    assert (small > one + 0.5).all()


@pytest.mark.longer
def test_rooms_without_a_partner_change_nothing(points):
    """A wing that the other map never saw is added: the pose stays."""
    wing = Scene().shell(30, 0, 41, 9).wall((35, 0), (35, 9), doors=(4.0,)).points()
    b = grid_of(part(points, low=(5, -99)), MOVE)
    alone = register(grid_of(points), b)
    more = register(grid_of(np.concatenate([points, wing])), b)
    for found in (alone, more):
        assert off(found.transform, MOVE.inverse(), tuple(MOVE.apply(np.array([[14.0, 7.0, 1.0]]))[0]))[0] < 0.03
    assert abs(alone.probability - more.probability) < 0.15


@pytest.mark.longer
def test_the_alternatives_have_probabilities(points):
    found = register(grid_of(part(points, high=(16, 99))), grid_of(part(points, low=(5, -99)), MOVE))
    every = [a.probability for a in found.alternatives]
    assert every[0] == found.probability and every == sorted(every, reverse=True) and sum(every) <= 1.0


FEATURES = {
    "ratio": 0.8, "walls": 20.0, "conflict": 2.0, "conflict_share": 0.09, "worst_conflict": 0.12, "free": 150.0, "opposed": 0.03,
    "met": 0.6, "chance": 0.1, "clutter": 9.0, "share": 0.7, "sliced": 0.0, "level": 0.05, "ceilings": 0.08, "ceiling_area": 60.0,
}  # fmt: skip


PLACES = {"place_mean": 1.5, "place_worst": 0.5, "place_area": 100.0}
QUIET = {
    "tall_conflict": 0.0, "crossing": 30.0, "worst_ratio": 0.95, "squares": 60.0, "bad_squares": 0.0, "in_place": 20.0,
    "strain": 0.1, "bent": 0.02, "doubted": 0.0, "pieces": 20.0, "by_chance": 1.0, "moved_walls": 0.0, "hanging": 9.0,
    "hanging_met": 9.0, "repeats": 0.0,
}  # fmt: skip
GOOD = {
    **FEATURES, **PLACES, "conflict_share": 0.0, "worst_conflict": 0.0, "conflict": 0.0, "met": 0.95, "walls": 80.0, "free":
400.0, }  # fmt: skip


def seen(**changes: float) -> dict[str, float]:
    """The vector of features by name."""
    return dict(zip(POSE_VECTOR, compute_pose_vector({**FEATURES, **changes}).tolist(), strict=True))


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


def test_places_count_by_their_mean_their_number_and_the_worst():
    by_name = dict(zip(BENT_POSE_VECTOR, compute_bent_pose_vector({**FEATURES, **PLACES}).tolist(), strict=True))
    assert by_name["place_mean"] == 1.5 and by_name["place_worst"] == 0.5
    assert by_name["place_total"] == pytest.approx(1.5 * np.log1p(100 / 20))


def test_the_lead_over_rivals_by_hand():
    scores, one = np.array([5.0, 4.0, 1.0]), np.ones(len(BENT_POSE_VECTOR))
    features = [{**FEATURES, **PLACES, **more} for more in ({}, {"walls": 7.0}, {"walls": 5.0, "ratio": 0.9})]
    vectors = np.array([compute_bent_pose_vector(f) for f in features])
    margin, ahead, alone, share = compute_lead(scores, vectors, one, 2 * one)
    of_odds = 1 / (1 + np.exp(-1) + np.exp(-4))
    assert margin == 1.0 and alone == pytest.approx(np.log(of_odds / (1 - of_odds + 1e-3)))
    names = ("ratio", "conflict", "worst", "opposed", "lift", "sliced_conflict", "level", "ceilings", "place_mean", "place_worst")
    quality = [sum(v[BENT_POSE_VECTOR.index(n)] / 2 for n in names) for v in vectors]
    assert ahead == pytest.approx(quality[0] - quality[1])  # the third explains too little to be a rival
    # The amounts of the second count in part. The third explains too little, and counts as it scores.
    near = AMOUNT_COUNTS * -1.0 + (1 - AMOUNT_COUNTS) * min(quality[1] - quality[0], 0.0)
    assert share == pytest.approx(1 / (1 + np.exp(max(near, -1.0)) + np.exp(-4))) and share < of_odds
    assert compute_lead(scores[:1], vectors[:1], one, one)[:3] == (MARGIN_CAP, MARGIN_CAP, pytest.approx(MARGIN_CAP))


def test_a_rival_explains_enough_and_ratios_speak_for_it():
    ranked = [PoseHypothesis(Sim3(), 0.0, features={**FEATURES, **m}) for m in ({}, {"ratio": 0.7}, {"walls": 5.0, "ratio": 0.9})]
    lag = compute_quality_lag(ranked)
    assert lag[0] == 0 and 0 <= lag[1] < np.inf and lag[2] == np.inf


def test_the_probability_is_at_most_the_share_of_the_odds():
    """A second pose that is as good halves what the first may be believed; the rest share as their odds do."""
    alone = compute_verdict([GOOD], {**GOOD, **QUIET})
    assert alone.each[0] > 0.8 and len(alone.each) == 1 and sum(alone.posterior.values()) == pytest.approx(1.0)
    worse = {**GOOD, "walls": 60.0, "free": 300.0}
    halved = compute_verdict([GOOD, GOOD, worse], {**GOOD, **QUIET})
    behind = np.exp(score_bent(worse) - score_bent(GOOD))
    for same in ("building", "storey"):  # whatever is known of the maps, two places are as good
        assert compute_verdict([GOOD, GOOD, worse], {**GOOD, **QUIET}, same).each[0] <= 1 / (2 + behind) + 1e-12
    assert halved.each[0] <= 1 / (2 + behind) and halved.each[1] == pytest.approx(halved.each[0])
    assert halved.each[2] == pytest.approx(halved.each[0] * behind)
    assert tuple(halved.posterior) == POSTERIOR and halved.posterior["here"] == halved.each[0]


def test_what_the_user_knows_never_lowers_a_merge():
    for first in (GOOD, {**GOOD, "walls": 9.0, "free": 30.0}):
        each = [
            compute_verdict([first], {**first, **QUIET, "moved_walls": 0.02}, known).each[0]
            for known in ("nothing", "building", "storey")
        ]
        assert each == sorted(each) and each[0] < each[2]


def test_more_evidence_for_the_same_place_never_lowers_it():
    """A room that fits: more walls, more floor, more places, furniture in place."""
    few = {**GOOD, "walls": 12.0, "free": 60.0, "place_area": 60.0}
    more = {**few, "walls": 20.0, "free": 90.0, "place_area": 90.0, "place_worst": 0.6, "share": 0.75}
    winners = {**QUIET, "squares": 12.0, "crossing": 5.0}, {**QUIET, "squares": 16.0, "crossing": 8.0}
    one, two = (compute_verdict([f], {**f, **w}).each[0] for f, w in zip((few, more), winners, strict=True))
    assert two >= one


def test_one_square_metre_abstains():
    little = {**GOOD, "walls": 0.9, "free": 400.0}
    assert compute_verdict([little], {**little, **QUIET}).each[0] <= FEW
    assert compute_verdict([{**GOOD, "free": 3.0}], {**GOOD, **QUIET, "free": 3.0}).posterior["here"] <= FEW


@pytest.mark.parametrize(
    "change", [{"conflict_share": 0.3, "worst_conflict": 0.3, "conflict": 8.0}, {"met": 0.2}, {"free": 10.0}]
)
def test_what_speaks_against_a_pose_makes_it_less_plausible(change):
    assert score_plausibility({**FEATURES, **change}) < score_plausibility(FEATURES)
    assert score_plausibility({**FEATURES, "sliced": 1.0}) != score_plausibility(
        FEATURES
    )  # slices are judged by models of their own


def test_furniture_tells_places_of_one_plan_and_nothing_does_where_none_is_seen():
    def odds(pieces: float, in_place: float, by_chance: float) -> float:
        return compute_furniture_log_odds({"pieces": pieces, "in_place": in_place, "by_chance": by_chance})

    assert odds(0.0, 0.0, 0.0) == pytest.approx(0.0)
    assert odds(10.0, 1.0, 1.0) < -1 < 1 < odds(10.0, 8.0, 1.0)
    assert odds(20.0, 2.0, 2.0) < odds(10.0, 1.0, 1.0) < odds(2.0, 0.2, 0.2) < 0  # more pieces say more
    assert abs(odds(10.0, 8.0, 7.0)) < 0.5 < odds(10.0, 8.0, 1.0)  # in a crowded room much meets by chance
    rising = [odds(10.0, k, 1.0) for k in range(11)]
    assert (np.diff(rising) > 0).all()


def test_a_place_of_the_same_plan_gains_by_what_speaks_for_it_alone():
    fitted = {"mean": [0.0, 0.0], "scale": [1.0, 1.0], "weight": [2.0, 1.0], "bias": 1.0}
    nothing, against, in_favour = compute_plan_odds(fitted, np.array([[0.0, 0.0], [-1.0, 0.0], [1.5, 0.0]]))
    assert nothing == in_favour == 0 and against == pytest.approx(np.exp(1.0) - np.exp(-1.0))
    solid = {"pieces": 10.0, "in_place": 1.0, "by_chance": 1.0, "sliced": 0.0}
    told, sliced = compute_plan_vector(solid), compute_plan_vector({**solid, "sliced": 1.0})
    assert told[1] == sliced[0] == 0 and told[0] == sliced[1] < -1


def test_furniture_that_stands_elsewhere_on_both_sides_is_refused_however_much_walls_agree():
    same = {**GOOD, **QUIET, "pieces": 12.0, "in_place": 9.0, "by_chance": 1.0}
    other = {**same, "in_place": 1.2}
    believed, refused = (compute_verdict([f], f) for f in (same, other))
    assert believed.posterior["here"] > 0.9 and refused.posterior["here"] < 0.4
    assert refused.posterior["storey"] + refused.posterior["half"] > 0.5
    known = compute_verdict([other], other, "storey")
    assert known.posterior["storey"] == 0 and known.posterior["here"] > refused.posterior["here"]


@pytest.mark.parametrize(
    ("pieces", "in_place", "by_chance"), [(10.0, 10.0, 10.0), (0.3, 0.4, 0.9), (50.0, 0.0, 50.0), (1e-9, 0.0, 0.0)]
)
def test_odds_of_furniture_are_numbers_however_crowded_a_room_is(pieces, in_place, by_chance):
    odds = compute_furniture_log_odds({"pieces": pieces, "in_place": in_place, "by_chance": by_chance})
    assert np.isfinite(odds) and abs(odds) < 30
