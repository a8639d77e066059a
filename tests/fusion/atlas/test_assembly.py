"""Which links hold maps together, which are thrown out, and where the maps lie then."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fusion.atlas.votes import LIMIT, PLACE, TRUE, WRONG, Pair, Votes, between, claim, odds
from topomerge.fusion.atlas import solve
from topomerge.fusion.atlas.link_evidence import CLOSING_GAIN, Link, place_component
from topomerge.fusion.atlas.pairs import Check
from topomerge.fusion.pose_graph import HEAVIEST_WALLS, Assembler, compute_residual
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3


def built(claims: dict[Pair, tuple[PoseHypothesis, ...]], votes: Votes | None = None, count: int = 4):
    return Assembler(count, claims, votes or Votes(), LIMIT).build()  # type: ignore[arg-type]


def is_right(poses: dict[int, Sim3]) -> bool:
    first = min(poses)
    return all(np.allclose((poses[first].inverse() @ p).matrix, between(first, k).matrix, atol=1e-6) for k, p in poses.items())


def test_a_chain_of_links_brings_maps_into_one_frame():
    assembly = built({(0, 1): claim(0, 1, 0.99), (1, 2): claim(1, 2, 0.95), (2, 3): claim(2, 3, 0.97), (0, 3): claim(0, 3, 0.5)})
    assert is_right(assembly.find_component(0)) and len(assembly.components) == 1
    assert sorted(link.maps for link in assembly.links) == [(0, 1), (1, 2), (2, 3)] and not assembly.rejected


def test_what_is_not_believed_stays_apart():
    assembly = built({(0, 1): claim(0, 1, 0.99), (1, 2): claim(1, 2, 0.8)}, count=3)
    assert sorted(map(sorted, assembly.components)) == [[0, 1], [2]] and is_right(assembly.find_component(1))


def test_votes_of_others_let_a_weak_link_in_and_keep_a_strong_one_out():
    claims = {(0, 1): claim(0, 1, 0.99), (1, 2): claim(1, 2, 0.8)}
    assert len(built(claims, Votes({(0, 2): 3.0}), 3).components) == 1
    assembly = built({**claims, (1, 2): claim(1, 2, 0.99)}, Votes({(0, 2): -4.0}), 3)
    assert sorted(map(sorted, assembly.components)) == [[0, 1], [2]]
    assert [(link.maps, link.against) for link in assembly.rejected] == [((1, 2), (0, 2))]


def test_a_wrong_claim_in_a_cycle_is_rejected_and_the_weakest_link_against_it_named():
    assembly = built({(0, 1): claim(0, 1, 0.999), (1, 2): claim(1, 2, 0.99), (0, 2): claim(0, 2, 0.6, WRONG)}, count=3)
    assert is_right(assembly.find_component(0)) and len(assembly.find_component(0)) == 3
    (rejected,) = assembly.rejected
    assert rejected.maps == (0, 2) and rejected.against == (1, 2) and rejected.log_odds == pytest.approx(-odds(0.6))


def test_a_wrong_link_that_was_taken_first_is_given_up():
    claims = {(0, k): claim(0, k, 0.998) for k in (1, 2, 4)} | {(0, 3): claim(0, 3, 0.9985, WRONG)}
    claims |= {tuple(sorted((k, 3))): claim(*sorted((k, 3)), 0.95) for k in (1, 2, 4)}  # type: ignore[misc]
    they_see_it = Votes(to_others=dict.fromkeys(claims, 0.0))
    assembly = built(claims, they_see_it, count=5)
    assert len(assembly.components) == 1 and is_right(assembly.find_component(0))
    assert [link.maps for link in assembly.rejected] == [(0, 3)]


def test_two_claims_of_one_weight_leave_the_map_apart():
    claims = {(0, 1): claim(0, 1, 0.999), (0, 2): claim(0, 2, 0.95), (1, 2): claim(1, 2, 0.95, WRONG)}
    assembly = built(claims, count=3)
    assert sorted(map(sorted, assembly.components)) == [[0, 1], [2]]
    assert [link.maps for link in assembly.rejected] == [(0, 2), (1, 2)]


def test_three_maps_that_agree_come_together_though_no_pair_of_them_is_believed():
    claims = {pair: claim(*pair, 0.7) for pair in ((0, 1), (0, 2), (1, 2))}
    assembly = built(claims, count=3)
    assert odds(0.7) < LIMIT < odds(0.7) + CLOSING_GAIN
    assert len(assembly.components) == 1 and is_right(assembly.find_component(0)) and len(assembly.links) == 2
    assert all(link.log_odds == pytest.approx(odds(0.7) + CLOSING_GAIN) for link in assembly.links)
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
    move = place_component(a, b, pair, between(*pair))
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
        solved, edges = Assembler(3, {}, votes, LIMIT).settle(poses, links)  # type: ignore[arg-type]
        gaps.append({e.maps: compute_residual(e, solved) for e in edges})
    assert gaps[0][0, 2] > 3 * gaps[0][0, 1] and gaps[1][0, 2] < gaps[1][0, 1]
    assert gaps[1] == pytest.approx(gaps[2])


def test_maps_that_a_link_joins_without_overlap_stay_where_it_puts_them():
    poses = {0: TRUE[0], 1: Sim3(0.1, (0.2, 0.1, 0.0)) @ TRUE[1]}
    link = Link((0, 1), claim(0, 1, 0.99)[0], 4.0)
    solved, edges = Assembler(2, {}, Votes(), LIMIT).settle(poses, [link])  # type: ignore[arg-type]
    assert len(edges) == 1 and is_right(solved)


class Remembering(Votes):
    """Votes that judge poses near each other once, as `Checks` does."""

    def __call__(self, i: int, j: int, pose: Sim3) -> Check:
        if j < i:
            turned = self(j, i, pose.inverse())
            return Check(turned.pose.inverse(), turned.log_odds, turned.overlap, turned.features)
        near = self.measured.get((i, j), Sim3())
        if not np.allclose(pose.apply(PLACE), near.apply(PLACE), atol=0.08):
            self.measured[i, j] = pose
        return super().__call__(i, j, pose)


def test_what_was_registered_first_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """An atlas was written anew where its links were registered before: poses near each other are judged at the first one."""
    monkeypatch.setattr(solve, "Checks", lambda *of: Remembering(dict.fromkeys([(0, 1), (0, 2), (1, 2)], 1.0)))
    monkeypatch.setattr(solve, "find_partners", lambda *of: ([[1, 2], [0, 2], [1, 0]], True))
    keys = ("a", "b", "c")
    off = {(0, 1): 0.0, (1, 2): 0.06, (0, 2): 0.0}
    registrations = {(keys[i], keys[j]): claim(i, j, 0.7, Sim3(0.0, (m, 0.0, 0.0))) for (i, j), m in off.items()}
    found = []
    for linked in ((), (("a", "b"), ("a", "c")), (("b", "c"),)):
        maps = type("Maps", (), {"keys": keys, "__len__": lambda self: 3})()
        explorer = solve._Explorer(maps, solve.AtlasSettings(), 0.5, registrations, dict.fromkeys(linked, Sim3()))
        assembly = explorer.explore()
        assert len(explorer.tried) == 3 and len(assembly.components) == 1
        poses, edges = explorer.assembler.settle(assembly.components[0], assembly.links)
        found.append([poses[k].matrix.tobytes() for k in range(3)] + [e.pose.matrix.tobytes() for e in edges])
    assert found[0] == found[1] == found[2]
