"""What is weighed before a link is believed: its own two maps, other pairs, rival placements, and walls on free floor."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fusion.atlas.votes import TRUE, WRONG, Pair, Votes, between, claim, odds
from topomerge.fusion.atlas.link_evidence import CLOSING_GAIN, Link, LinkEvidence, compute_shares, weigh
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3

HALF_TURN = Sim3(np.pi, (1.0, 2.0, 0.0))


def two_places(i: int, j: int, p: float, rest: float = 0.0, off: Sim3 = WRONG) -> tuple[PoseHypothesis, ...]:
    """The true pose of a pair with probability p, and a rival with what is left but for `rest`."""
    ranked = (*claim(i, j, p), *claim(i, j, 1 - p - rest, off))
    return tuple(sorted(ranked, key=lambda h: -h.probability))


def scored(others: tuple[int, ...], claims: dict[Pair, tuple[PoseHypothesis, ...]], votes: Votes, p: float = 0.5) -> Link:
    """The true link of maps 0 and 1, of this probability by itself, where other maps lie right in the component of map 0."""
    link = claim(0, 1, p)[0]
    evidence = LinkEvidence(range(5), {(0, 1): (link,), **claims}, votes)  # type: ignore[arg-type]
    chosen = next(h for h in evidence.hypotheses[0, 1] if np.allclose(h.transform.matrix, between(0, 1).matrix))
    return evidence.score_link({k: TRUE[k] for k in (0, *others)}, {1: Sim3()}, (0, 1), chosen)


@pytest.mark.parametrize("p", [0.5, 0.757, 0.93])
@pytest.mark.parametrize("rest", [0.0, 0.02])
def test_of_two_maps_alone_a_link_is_as_probable_as_their_registration(p, rest):
    assert scored((), {(0, 1): two_places(0, 1, p, rest)}, Votes()).probability == pytest.approx(p)
    assert scored((), {}, Votes(), p).probability == pytest.approx(p)


@pytest.mark.parametrize(("said", "adds"), [(3.0, 0.0), (-1.9, 0.0), (-2.5, -2.5)])
def test_its_own_two_maps_only_count_where_they_contradict_a_link(said, adds):
    assert scored((), {}, Votes({(0, 1): said})).log_odds == pytest.approx(adds)


@pytest.mark.parametrize(("said", "adds"), [(1.0, 1.0), (3.0, CLOSING_GAIN), (-1.0, -1.0), (-5.0, -5.0)])
def test_the_walls_of_another_map_count_for_and_against(said, adds):
    link = scored((2,), {}, Votes({(1, 2): said}))
    assert link.log_odds == pytest.approx(adds) and link.against == ((1, 2) if said < 0 else None)
    assert link.probability == pytest.approx(1 / (1 + np.exp(-adds)))


def test_no_support_makes_up_for_a_contradiction_and_the_pair_with_the_most_against_it_is_named():
    link = scored((2, 3, 4), {}, Votes({(1, 2): 3.0, (1, 3): -5.0, (1, 4): -1.0}))
    assert link.against == (1, 3) and link.log_odds == pytest.approx(CLOSING_GAIN - 5.0)  # one place, as both lie in the middle


def test_a_place_that_several_pairs_show_counts_once_and_places_apart_add_up():
    votes = Votes({(1, 2): -1.0, (1, 3): -1.2, (1, 4): -0.5})
    at = {2: (0.0, 0.0, 0.0), 3: (2.0, 0.0, 0.0), 4: (9.0, 0.0, 0.0)}  # in the common frame
    votes.conflicts = {(1, k): between(1, 0).apply(np.array([spot]))[0] for k, spot in at.items()}
    assert scored((2, 3, 4), {}, votes).log_odds == pytest.approx(-1.2 - 0.5)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_look_alike_that_all_maps_share_is_no_evidence(count):
    """Each pair names the true place with .6 and one rival with .4, the same for all: however many pairs, it stays .6, but for
    the tenth of the rest that is kept for places that no pair names."""
    others = tuple(range(2, 2 + count))
    claims = {(0, 1): two_places(0, 1, 0.6)} | {(1, k): shared_rival(1, k, 0.6) for k in others}
    assert scored(others, claims, Votes()).probability == pytest.approx(0.6, abs=0.02)
    surest = claims | {(1, 2): shared_rival(1, 2, 0.757)}
    assert scored(others, surest, Votes()).probability == pytest.approx(0.757, abs=0.02)


def shared_rival(i: int, j: int, p: float) -> tuple[PoseHypothesis, ...]:
    """Maps 1 and j: where map j lies in map 1 if that is moved as the rival of maps 0 and 1 says."""
    rival = (WRONG @ between(0, 1)).inverse() @ TRUE[j]
    return (*claim(i, j, p), PoseHypothesis(rival, probability=1 - p))


def test_a_way_round_in_a_symmetric_place_says_nothing():
    """Map 2 lies in neither component: by way of it both placements of maps 0 and 1 are about as good."""
    turned = Sim3(np.pi)

    def both(i: int, j: int, p: float) -> tuple[PoseHypothesis, ...]:
        pose = TRUE[i].inverse() @ turned @ TRUE[j]
        return (*claim(i, j, p), PoseHypothesis(pose, probability=1 - p))

    claims = {pair: both(*pair, p) for pair, p in (((0, 1), 0.7), ((0, 2), 0.6), ((1, 2), 0.65))}
    assert scored((), claims, Votes()).probability == pytest.approx(0.7, abs=0.02)


def test_a_pair_that_sees_a_rival_and_names_only_the_link_rules_it_out():
    claims = {(0, 1): two_places(0, 1, 0.5, 0.05), (1, 2): claim(1, 2, 0.95)}
    link = scored((2,), claims, Votes(to_true={(1, 2): 1.0}, to_others={(1, 2): -3.0}))
    assert link.probability > 0.95
    unseen = scored((2,), claims, Votes(to_true={(1, 2): 1.0}))
    assert 0.9 < unseen.probability <= 0.97  # where it does not see the rival, by its own registration


def test_a_registration_of_the_same_place_supports_a_link_even_if_it_is_unsure():
    assert scored((2,), {(1, 2): claim(1, 2, 0.03)}, Votes()).log_odds == pytest.approx(odds(0.03) + 4.0)
    assert scored((2,), {(1, 2): claim(1, 2, 0.001)}, Votes()).log_odds == pytest.approx(0.0)


def test_a_rival_claim_counts_against_a_link_as_much_as_it_is_probable():
    for p in (0.6, 0.95):
        link = scored((2,), {(1, 2): claim(1, 2, p, WRONG)}, Votes(), 0.9)
        even = odds(0.9) - odds(p)  # against that place; and against none
        assert link.log_odds == pytest.approx(-np.logaddexp(-even, -odds(0.9))) and link.against == (1, 2)


def test_a_rival_claim_that_its_own_maps_contradict_counts_little():
    against = scored((2,), {(1, 2): claim(1, 2, 0.95, WRONG)}, Votes(), 0.9).log_odds
    contradicted = scored((2,), {(1, 2): claim(1, 2, 0.95, WRONG)}, Votes(to_others={(1, 2): -6.0}), 0.9).log_odds
    assert against < 0 and contradicted > 1.9


def test_shares_of_a_pair_sum_to_one_and_the_best_keeps_its_own():
    shares, none = compute_shares([PoseHypothesis(Sim3(), probability=p) for p in (0.6, 0.4, 0.4, 0.1)])
    assert shares[0] == 0.6 and sum(shares) + none == pytest.approx(1.0) and none == pytest.approx(0.04)
    assert shares[1] == shares[2] == pytest.approx(0.16)
    shares, none = compute_shares([PoseHypothesis(Sim3(), probability=p) for p in (0.6, 0.1)])
    assert shares == [0.6, 0.1] and none == pytest.approx(0.3)


def test_what_sources_say_together():
    """(log odds, names the other placement, sees it)"""
    assert weigh([]) == 0.0 and weigh([(-2.0, False, True)]) == 0.0
    assert weigh([(1.0, True, True), (2.0, True, True), (1.5, True, False)]) == 2.0  # a look-alike of all
    assert weigh([(1.0, False, True), (2.0, False, True)]) == 3.0  # they would name it
    assert weigh([(2.0, False, False), (1.0, False, False)]) == 3.0 and weigh([(2.0, False, False)] * 3) == 2.0 + CLOSING_GAIN
    assert weigh([(3.0, True, True), (2.0, False, True)]) == 5.0
