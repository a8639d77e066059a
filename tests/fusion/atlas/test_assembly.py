"""Who is heard before a link is believed: its own two maps, the votes of others, and claims that contradict it."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.fusion.atlas.assembly import BACKING, HEAVIEST_WALLS, Assembler, Link
from topomerge.fusion.atlas.cycles import across
from topomerge.fusion.atlas.pairs import Check
from topomerge.fusion.atlas.pose_graph import residual
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3

LIMIT = 2.0  # log odds
PLACE = np.array([[0.0, 0, 0], [3, 0, 0], [-3, 0, 0], [0, 3, 0], [0, -3, 0]])
TRUE = dict(enumerate(
    (Sim3(), Sim3(0.4, (9.0, 1.0, 0.0)), Sim3(-2.5, (3.0, 7.0, 0.2)), Sim3(3.0, (-4.0, 5.0, 0.1)), Sim3(1.0, (2.0, 2.0, 0.0)))
))  # fmt: skip
WRONG = Sim3(0.0, (6.0, 0.0, 0.0))
Pair = tuple[int, int]


def between(i: int, j: int) -> Sim3:
    """The true T_ij."""
    return TRUE[i].inverse() @ TRUE[j]


class Votes:
    """In place of `Checks`: what pairs say to their true pose and to any other one; who has no vote does not overlap."""

    def __init__(self, to_true: dict[Pair, float] | None = None, to_others: dict[Pair, float] | None = None) -> None:
        self.to_true, self.to_others = to_true or {}, to_others or {}
        self.walls: dict[Pair, float] = {}
        self.measured: dict[Pair, Sim3] = {}

    def __call__(self, i: int, j: int, pose: Sim3) -> Check:
        if j < i:
            turned = self(j, i, pose.inverse())
            return Check(turned.pose.inverse(), turned.log_odds, turned.overlap, turned.features)
        true = np.allclose(pose.apply(PLACE), between(i, j).apply(PLACE), atol=0.5)
        said = (self.to_true if true else self.to_others).get((i, j))
        walls = {"walls": self.walls.get((i, j), 5.0)}
        return Check(self.measured.get((i, j), pose), said or 0.0, said is not None, walls)

    def place(self, i: int, j: int, pose: Sim3) -> np.ndarray:
        return PLACE

    def fine(self, i: int, j: int, pose: Sim3) -> Sim3:
        return pose


def claim(i: int, j: int, p: float, off: Sim3 | None = None) -> tuple[PoseHypothesis, ...]:
    """A hypothesis of maps i and j, true unless it is `off`."""
    return (PoseHypothesis((off or Sim3()) @ between(i, j), probability=p),)


def odds(p: float) -> float:
    return float(np.log(p / (1 - p)))


def heard(others: tuple[int, ...], claims: dict[Pair, tuple[PoseHypothesis, ...]], votes: Votes, off: Sim3 | None = None) -> Link:
    """The link of maps 0 and 1, of probability 0.5 by itself, where other maps lie right in the component of map 0."""
    link = claim(0, 1, 0.5, off)
    assembler = Assembler(5, {(0, 1): link, **claims}, votes, LIMIT)  # type: ignore[arg-type]
    return assembler.heard({k: TRUE[k] for k in (0, *others)}, {1: Sim3()}, (0, 1), link[0])


@pytest.mark.parametrize(("said", "adds"), [(3.0, 0.0), (-1.9, 0.0), (-2.5, -2.5)])
def test_its_own_two_maps_only_speak_where_they_contradict_a_link(said, adds):
    assert heard((), {}, Votes({(0, 1): said})).log_odds == pytest.approx(adds)


@pytest.mark.parametrize(("said", "adds"), [(1.0, 1.0), (3.0, BACKING), (-1.0, -1.0), (-5.0, -5.0)])
def test_the_vote_of_another_map_counts_for_and_against(said, adds):
    link = heard((2,), {}, Votes({(1, 2): said}))
    assert link.log_odds == pytest.approx(adds) and link.against == ((1, 2) if said < 0 else None)
    assert link.probability == pytest.approx(1 / (1 + np.exp(-adds)))


def test_no_backing_makes_up_for_a_veto_and_the_loudest_voice_is_named():
    link = heard((2, 3, 4), {}, Votes({(1, 2): 3.0, (1, 3): -5.0, (1, 4): -1.0}))
    assert link.log_odds == pytest.approx(min(3.0 - 1.0, BACKING) - 5.0) and link.against == (1, 3)


def test_backing_tells_a_hypothesis_from_its_rivals():
    """Of two places of 0.5 and 0.45 one is right: another map may tell which, and then more than `BACKING` is believed."""
    link, rival = claim(0, 1, 0.5)[0], claim(0, 1, 0.45, WRONG)[0]
    votes = Votes({(1, 2): 3.0, (1, 3): 3.0})
    assembler = Assembler(4, {(0, 1): (link, rival)}, votes, LIMIT)  # type: ignore[arg-type]
    heard_link = assembler.heard({k: TRUE[k] for k in (0, 2, 3)}, {1: Sim3()}, (0, 1), link)
    assert heard_link.log_odds == pytest.approx(odds(0.95) + BACKING)


def test_a_claim_of_the_same_place_backs_a_link_even_if_it_is_unsure():
    assert heard((2,), {(1, 2): claim(1, 2, 0.03)}, Votes()).log_odds == pytest.approx(odds(0.03) + 4.0)
    assert heard((2,), {(1, 2): claim(1, 2, 0.001)}, Votes()).log_odds == 0.0


def test_a_rival_claim_speaks_against_a_link_as_loud_as_it_is_probable():
    for p in (0.6, 0.95):
        link = heard((2,), {(1, 2): claim(1, 2, p, WRONG)}, Votes())
        assert link.log_odds == pytest.approx(-odds(p) - 1.0) and link.against == (1, 2)
    assert heard((2,), {(1, 2): claim(1, 2, 0.2, WRONG)}, Votes()).log_odds == 0.0


def test_a_rival_claim_that_its_own_maps_contradict_is_not_heard():
    assert heard((2,), {(1, 2): claim(1, 2, 0.95, WRONG)}, Votes(to_others={(1, 2): -4.0})).log_odds == 0.0


def test_a_rival_claim_that_a_third_one_contradicts_weighs_less():
    two_places = (*claim(0, 1, 0.5), *claim(0, 1, 0.45, WRONG))  # so that backing is not cut off
    claims = {(0, 1): two_places, (1, 2): claim(1, 2, 0.95, WRONG), (1, 3): claim(1, 3, 0.9)}
    left = odds(0.95) - odds(0.9) - 1.0  # of the rival, after the claim of maps 1 and 3
    assert heard((2, 3), claims, Votes(to_true={(1, 3): -1.9})).log_odds == pytest.approx(3.0 - left - 1.0)
    assert heard((2,), claims, Votes()).log_odds == pytest.approx(-odds(0.95) - 1.0)


def built(claims: dict[Pair, tuple[PoseHypothesis, ...]], votes: Votes | None = None, count: int = 4):
    return Assembler(count, claims, votes or Votes(), LIMIT).build()  # type: ignore[arg-type]


def is_right(poses: dict[int, Sim3]) -> bool:
    first = min(poses)
    return all(np.allclose((poses[first].inverse() @ p).matrix, between(first, k).matrix, atol=1e-6) for k, p in poses.items())


def test_a_chain_of_links_brings_maps_into_one_frame():
    assembly = built({(0, 1): claim(0, 1, 0.99), (1, 2): claim(1, 2, 0.95), (2, 3): claim(2, 3, 0.97), (0, 3): claim(0, 3, 0.5)})
    assert is_right(assembly.of(0)) and len(assembly.components) == 1
    assert sorted(link.maps for link in assembly.links) == [(0, 1), (1, 2), (2, 3)] and not assembly.rejected


def test_what_is_not_believed_stays_apart():
    assembly = built({(0, 1): claim(0, 1, 0.99), (1, 2): claim(1, 2, 0.8)}, count=3)
    assert sorted(map(sorted, assembly.components)) == [[0, 1], [2]] and is_right(assembly.of(1))


def test_votes_of_others_let_a_weak_link_in_and_keep_a_strong_one_out():
    claims = {(0, 1): claim(0, 1, 0.99), (1, 2): claim(1, 2, 0.8)}
    assert len(built(claims, Votes({(0, 2): 3.0}), 3).components) == 1
    assembly = built({**claims, (1, 2): claim(1, 2, 0.99)}, Votes({(0, 2): -4.0}), 3)
    assert sorted(map(sorted, assembly.components)) == [[0, 1], [2]]
    assert [(link.maps, link.against) for link in assembly.rejected] == [((1, 2), (0, 2))]


def test_a_wrong_claim_in_a_cycle_is_rejected_and_the_weakest_link_against_it_named():
    assembly = built({(0, 1): claim(0, 1, 0.999), (1, 2): claim(1, 2, 0.99), (0, 2): claim(0, 2, 0.6, WRONG)}, count=3)
    assert is_right(assembly.of(0)) and len(assembly.of(0)) == 3
    (rejected,) = assembly.rejected
    assert rejected.maps == (0, 2) and rejected.against == (1, 2) and rejected.log_odds == pytest.approx(-odds(0.6))


def test_a_wrong_link_that_was_taken_first_is_given_up():
    claims = {(0, k): claim(0, k, 0.998) for k in (1, 2, 4)} | {(0, 3): claim(0, 3, 0.9995, WRONG)}
    claims |= {tuple(sorted((k, 3))): claim(*sorted((k, 3)), 0.95) for k in (1, 2, 4)}  # type: ignore[misc]
    assembly = built(claims, count=5)
    assert len(assembly.components) == 1 and is_right(assembly.of(0))
    assert [link.maps for link in assembly.rejected] == [(0, 3)]


def test_two_claims_of_one_weight_leave_the_map_apart():
    claims = {(0, 1): claim(0, 1, 0.999), (0, 2): claim(0, 2, 0.95), (1, 2): claim(1, 2, 0.95, WRONG)}
    assembly = built(claims, count=3)
    assert sorted(map(sorted, assembly.components)) == [[0, 1], [2]]
    assert [link.maps for link in assembly.rejected] == [(0, 2), (1, 2)]


def test_three_maps_that_agree_come_together_though_no_pair_of_them_is_believed():
    claims = {pair: claim(*pair, 0.7) for pair in ((0, 1), (0, 2), (1, 2))}
    assembly = built(claims, count=3)
    assert odds(0.7) < LIMIT < odds(0.7) + BACKING
    assert len(assembly.components) == 1 and is_right(assembly.of(0)) and len(assembly.links) == 2
    assert all(link.log_odds == pytest.approx(odds(0.7) + BACKING) for link in assembly.links)
    for missing in claims:
        two = {pair: h for pair, h in claims.items() if pair != missing}
        assert len(built(two, count=3).components) == 3


def test_three_maps_that_go_round_to_another_place_stay_apart():
    claims = {(0, 1): claim(0, 1, 0.7), (0, 2): claim(0, 2, 0.7), (1, 2): claim(1, 2, 0.7, WRONG)}
    assert len(built(claims, count=3).components) == 3


def test_a_way_round_that_nobody_believes_adds_nothing():
    claims = {(0, 1): claim(0, 1, 0.7), (0, 2): claim(0, 2, 0.7), (1, 2): claim(1, 2, 0.01)}
    assert len(built(claims, count=3).components) == 3


@pytest.mark.parametrize("pair", [(1, 2), (2, 1)])
def test_components_meet_where_a_link_puts_their_maps(pair):
    """Map 1 lies in one component, map 2 in the other; each has a frame of its own."""
    here, there = Sim3(1.1, (50.0, 3.0, 1.0)), Sim3(-0.6, (-8.0, 20.0, 0.0))
    a, b = {k: here @ TRUE[k] for k in (0, 1)}, {k: there @ TRUE[k] for k in (2, 3)}
    move = across(a, b, pair, between(*pair))
    assert np.allclose(move.matrix, (here @ there.inverse()).matrix)


def test_the_measurement_with_more_walls_counts_more():
    """Around a cycle that misses by 6 cm the pair with few walls gives way; beyond `HEAVIEST_WALLS` more say no more."""
    votes = Votes({(0, 1): 3.0, (1, 2): 3.0, (0, 2): 3.0})
    links = [Link((0, 1), claim(0, 1, 0.99)[0], 4.0), Link((1, 2), claim(1, 2, 0.99)[0], 4.0)]
    votes.measured = {(0, 2): Sim3(0.0, (0.06, 0.0, 0.0)) @ between(0, 2)}
    poses = {k: TRUE[k] for k in range(3)}
    gaps = []
    for walls in (1.0, HEAVIEST_WALLS, 1000.0):
        votes.walls = {(0, 1): 10.0, (1, 2): 10.0, (0, 2): walls}
        solved, edges = Assembler(3, {}, votes, LIMIT).settled(poses, links)  # type: ignore[arg-type]
        gaps.append({e.maps: residual(e, solved) for e in edges})
    assert gaps[0][0, 2] > 3 * gaps[0][0, 1] and gaps[1][0, 2] < gaps[1][0, 1]
    assert gaps[1] == pytest.approx(gaps[2])


def test_maps_that_a_link_joins_without_overlap_stay_where_it_puts_them():
    poses = {0: TRUE[0], 1: Sim3(0.1, (0.2, 0.1, 0.0)) @ TRUE[1]}
    link = Link((0, 1), claim(0, 1, 0.99)[0], 4.0)
    solved, edges = Assembler(2, {}, Votes(), LIMIT).settled(poses, [link])  # type: ignore[arg-type]
    assert len(edges) == 1 and is_right(solved)
