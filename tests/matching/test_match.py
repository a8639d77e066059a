"""Matching: exact answers on maps made by hand, and what must change nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.embedding.test_descriptors import permuted
from tests.matching.turned_maps import turned, uneven
from tests.scenes_map import building
from topomerge.embedding.quarter_turns import YawProbability
from topomerge.errors import InputError
from topomerge.matching.consistency import compute_match_probability, find_voted_pose
from topomerge.matching.match import GrowingLimits, format_turns, match, select_marginal_matches, weigh_turns
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3


def test_transform_and_rooms_are_found_exactly():
    b, true = turned(uneven(), (7.0, -3.0, 1.5))
    found = match(uneven(), b)
    assert found.transform is not None
    corners = b.rooms["centroid"]
    assert any(np.allclose(h.transform.apply(corners), true.apply(corners), atol=0.05) for h in found.alternatives)
    right = next(h for h in found.alternatives if np.allclose(h.transform.apply(corners), true.apply(corners), atol=0.05))
    assert [tuple(p) for p in right.rooms.tolist()] == [(i, i) for i in range(4)]


def test_attention_matches_rooms_and_their_doors_give_the_pose():
    b, true = turned(uneven(), (7.0, -3.0, 1.5))
    result = match(uneven(), b, method="attention")
    assert result.rooms.tolist() == [[k, k] for k in range(4)] and (result.probability > 0.9).all()
    corners = b.rooms["centroid"]
    assert result.transform is not None and result.transform.apply(corners) == pytest.approx(true.apply(corners), abs=1e-6)
    other_way = match(b, uneven(), method="attention")
    assert other_way.probability == pytest.approx(result.probability, abs=0.01)


@pytest.mark.parametrize("scale_free", [False, True])
def test_attention_needs_the_embedder_that_ships(scale_free):
    b, _ = turned(uneven(), (7.0, -3.0, 1.5))
    with pytest.raises(InputError, match="method attention needs the embedder that ships; take method consistent"):
        match(uneven(), b, "engineered", "attention", scale_free=scale_free)


@pytest.mark.longer
def test_attention_at_unknown_scale():
    b, true = turned(uneven(), (7.0, -3.0, 1.5), 1.3)
    result = match(uneven(), b, method="attention", scale_free=True)
    assert {tuple(pair) for pair in result.rooms.tolist()} <= {(k, k) for k in range(4)} and len(result.rooms) >= 3
    assert result.transform is not None and result.transform.scale == pytest.approx(true.scale, rel=0.03)


def test_attention_without_a_likely_match_gives_no_pose():
    assert find_voted_pose(uneven(), building(2), np.zeros((4, 5))) is None


def test_unknown_scale():
    a = building(2)
    b, true = turned(a, (7.0, -3.0, 1.5), 1.3)
    found = match(a, b, scale_free=True)
    assert any(h.transform.scale == pytest.approx(true.scale, rel=0.02) for h in found.alternatives[:3])


def test_rooms_that_look_alike_keep_alternatives():
    a = building(2)  # the same from both ends
    b, _ = turned(a, (7.0, -3.0, 1.5))
    found = match(a, b)
    yaws = sorted(round(np.degrees(h.transform.yaw)) % 180 for h in found.alternatives[:2])
    assert len(found.alternatives) > 1 and yaws == [90, 90]
    assert found.alternatives[0].probability < 0.7 and found.alternatives[1].probability > 0.2


@pytest.mark.parametrize("method", ["consistent", "attention", "assignment"])
def test_a_plan_that_is_the_same_from_both_ends_fits_at_two_turns(method):
    b, _ = turned(building(2), (7.0, -3.0, 1.5))
    found = match(building(2), b, method=method)
    assert sorted(round(np.degrees(yaw)) for yaw, _ in found.fitting_turns) == [-90, 90]
    assert sum(p for _, p in found.turns) == pytest.approx(1.0)
    assert format_turns(found)[-1] == "two turns fit (-90 and 90 degrees)"
    if method == "attention":  # each room may be one or the other, but for the corridor in the middle
        assert (found.probability[:4] < 0.9).all() and found.probability[4] > 0.9


@pytest.mark.parametrize("method", ["consistent", "attention"])
def test_a_plan_without_symmetry_fits_at_one_turn(method):
    b, true = turned(uneven(), (7.0, -3.0, 1.5))
    (fitting,) = match(uneven(), b, method=method).fitting_turns
    assert np.degrees(fitting.yaw) == pytest.approx(np.degrees(true.yaw), abs=1.0) and fitting.probability > 0.9
    assert match(uneven(), b, "engineered").turns == ()


def test_walls_have_a_say_in_turns():
    turns = (YawProbability(0.0, 0.5), YawProbability(np.pi, 0.4), YawProbability(np.pi / 2, 0.1))
    ranked = [PoseHypothesis(Sim3(yaw), probability=p) for yaw, p in ((np.pi, 0.7), (-np.pi + 0.05, 0.2), (1.0, 0.04))]
    weight = np.array([0.5 * 0.02, 0.4 * 0.92, 0.1 * 0.02])  # what is left, .06, is shared
    found = weigh_turns(turns, ranked)
    assert found[0].yaw == np.pi and [p for _, p in found] == pytest.approx(np.sort(weight / weight.sum())[::-1])
    assert weigh_turns(turns, []) == turns and weigh_turns((), ranked) == ()


def test_order_of_rooms():
    b, _ = turned(uneven(), (7.0, -3.0, 1.5))
    order = np.array([2, 0, 3, 1])
    plain, mixed = match(uneven(), b), match(permuted(uneven(), order), b)
    back = {(int(order[i]), j) for i, j in mixed.rooms.tolist()}
    assert back == {tuple(p) for p in plain.rooms.tolist()}


@pytest.mark.parametrize("method", ["growing", "assignment", pytest.param("thesis", marks=pytest.mark.slow)])
def test_other_methods_run(method: str):
    b, _ = turned(uneven(), (7.0, -3.0, 1.5))
    found = match(uneven(), b, method=method)
    assert len(found.rooms) and ((found.probability >= 0) & (found.probability <= 1)).all()


def _numbered(m):
    """Descriptors that tell rooms by their number."""
    return 10.0 * np.arange(len(m.rooms))[:, None]


def test_growing_gives_the_pose_of_b_in_a():
    b, true = turned(uneven(), (7.0, -3.0, 1.5))
    grown = match(uneven(), b, _numbered, "growing")
    assert grown.rooms.tolist() == [[k, k] for k in range(4)]
    places = b.rooms["centroid"]
    assert np.allclose(grown.transform.apply(places), true.apply(places), atol=0.05)
    assert sum(h.probability for h in grown.alternatives) == pytest.approx(1.0)


def test_larger_hypotheses_of_growing_are_likelier_by_the_square():
    ranked = match(
        uneven(), turned(uneven(), (7.0, -3.0, 1.5))[0], _numbered, "growing", growing=GrowingLimits(cost=-1.0)
    ).alternatives
    assert [h.probability for h in ranked] == pytest.approx([0.25] * 4)  # nothing is cheap enough: each seed is alone


def test_the_assignment_leaves_alone_what_costs_too_much():
    b, _ = turned(uneven(), (7.0, -3.0, 1.5))

    def moved(m):  # the last room of b looks 4 times as unlike its partner as the others
        return _numbered(m) + (np.array([[1.0], [1.0], [1.0], [4.0]]) if m is b else 0.0)

    assert match(uneven(), b, moved, "assignment").rooms.tolist() == [[0, 0], [1, 1], [2, 2]]
    assert match(uneven(), b, moved, "assignment", largest_cost=5.0).rooms.tolist() == [[k, k] for k in range(4)]


def test_probabilities_of_matches_sum_over_hypotheses():
    """A match that the best hypothesis lacks is taken if most of the others have it and it excludes none of the best one's."""
    a, b = building(2), building(2)
    sets = ([[0, 0]], [[0, 0], [1, 1], [2, 3]], [[1, 1], [0, 2]])
    ranked = tuple(
        PoseHypothesis(Sim3(), probability=p, rooms=np.array(r), fit=np.ones(len(r)))
        for p, r in zip((0.4, 0.35, 0.25), sets, strict=True)
    )
    rooms, probability = select_marginal_matches(a, b, ranked)
    one = compute_match_probability(a, b, np.array([[0, 0]]), np.ones(1))[0]  # alike for all: rooms of one size that fit
    assert rooms.tolist() == [[0, 0], [1, 1]] and probability == pytest.approx([0.75 * one, 0.6 * one], rel=0.02)
    assert select_marginal_matches(a, b, ())[0].shape == (0, 2)


def test_bad_input():
    a = building(1)
    nothing = replace(a, rooms=a.rooms[:0], edges=a.edges[:0], room=a.room * 0 - 1, navigable_room=a.navigable_room * 0 - 1)
    with pytest.raises(InputError, match="same map"):
        match(a, a)
    with pytest.raises(InputError, match="no rooms"):
        match(nothing, building(2))
    with pytest.raises(InputError, match="method"):
        match(a, building(2), method="best")
