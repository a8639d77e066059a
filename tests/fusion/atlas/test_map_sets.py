"""Assembled set by set, an atlas is what it is assembled at once; sets are what pairs join."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from topomerge.fusion.atlas.pairs import Check
from topomerge.fusion.pose_graph import Assembler, Assembly, iter_map_sets
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3

LIMIT = 1.4  # log odds
PLACE = np.array([[0.0, 0, 0], [3, 0, 0], [-3, 0, 0], [0, 3, 0], [0, -3, 0]])


class Says:
    """In place of `Checks`: each pair says something of its own to the true pose, and another thing to any other one."""

    def __init__(self, truth: list[Sim3], said: np.ndarray) -> None:
        self.truth, self.said = truth, said

    def __call__(self, i: int, j: int, pose: Sim3) -> Check:
        if j < i:
            turned = self(j, i, pose.inverse())
            return Check(turned.pose.inverse(), turned.log_odds, turned.overlap, turned.features)
        true = np.allclose(pose.apply(PLACE), (self.truth[i].inverse() @ self.truth[j]).apply(PLACE), atol=0.5)
        log_odds = float(self.said[i, j, int(true)])
        return Check(pose, log_odds, log_odds != 0.0, {"walls": 5.0})

    def locate_place(self, i: int, j: int, pose: Sim3) -> np.ndarray:
        return PLACE


def drawn(seed: int) -> tuple[dict, Says, int]:
    """Hypotheses of pairs of a few buildings, some of them wrong, some of strangers."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 12))
    truth = [Sim3(float(rng.uniform(-3, 3)), tuple(rng.uniform(-9, 9, 3).tolist())) for _ in range(count)]
    building = rng.integers(0, 4, count)
    said = np.where(rng.random((count, count, 2)) < 0.5, 0.0, rng.uniform([-6.0, -1.0], [1.0, 3.0], (count, count, 2)))
    claims = {}
    for i in range(count):
        for j in range(i + 1, count):
            if rng.random() < (0.8 if building[i] == building[j] else 0.2):
                poses = [truth[i].inverse() @ truth[j], Sim3(0.1, (9.0, 1.0, 0.0)), Sim3(2.0, (-7.0, 5.0, 0.0))]
                shares = np.sort(rng.dirichlet([0.3, 0.3, 0.3]))[::-1].clip(0.01, 0.99)
                chosen = rng.permutation(3) if rng.random() < 0.3 else np.arange(3)
                claims[i, j] = tuple(PoseHypothesis(poses[n], probability=float(p)) for n, p in zip(chosen, shares, strict=True))
    return claims, Says(truth, said), count


def told(assembly: Assembly) -> tuple:
    """What does not depend on the order of the sets."""
    of_links = [sorted((x.maps, x.log_odds, x.against or ()) for x in of) for of in (assembly.links, assembly.rejected)]
    return sorted(tuple(sorted((k, p.matrix.tobytes()) for k, p in c.items())) for c in assembly.components), of_links


@pytest.mark.longer
@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_assembled_by_sets_it_is_what_it_is_at_once(seed: int) -> None:
    claims, says, count = drawn(seed)
    whole = told(Assembler(count, claims, says, LIMIT)._assemble())  # type: ignore[arg-type]
    assert told(Assembler(count, claims, says, LIMIT).build()) == whole  # type: ignore[arg-type]
    growing: dict = {}
    assembler = Assembler(count, growing, says, LIMIT)  # type: ignore[arg-type]
    for pair, of in claims.items():  # sets in which nothing is new are taken over
        growing[pair] = of
        if sum(pair) % 3 == 0:
            assembler.build()
    assert told(assembler.build()) == whole


def test_only_sets_with_more_pairs_are_assembled_anew(monkeypatch) -> None:
    assembled = []
    usual = Assembler._assemble
    monkeypatch.setattr(Assembler, "_assemble", lambda self: assembled.append(tuple(self.maps)) or usual(self))
    link = (PoseHypothesis(Sim3(), probability=0.99),)
    claims = {(0, 1): link, (2, 3): link}
    assembler = Assembler(5, claims, Says([Sim3()] * 5, np.zeros((5, 5, 2))), LIMIT)  # type: ignore[arg-type]
    assert len(assembler.build().components) == 3 and assembled == [(0, 1), (2, 3), (4,)]
    assembled.clear()
    claims[0, 3] = (PoseHypothesis(Sim3(), probability=0.05),)  # nothing is joined by it
    claims[3, 4] = link
    assert len(assembler.build().components) == 2 and assembled == [(2, 3, 4)]


@given(st.sets(st.tuples(st.integers(0, 11), st.integers(0, 11)), max_size=14))
def test_sets_are_what_pairs_join(pairs: set[tuple[int, int]]) -> None:
    sets = list(iter_map_sets(12, pairs, {pair: str(pair) for pair in pairs} | {(0, 11): "far"}))
    assert sorted(k for maps, _ in sets for k in maps) == list(range(12))
    assert all(any({i, j} <= set(maps) for maps, _ in sets) for i, j in pairs)
    reached = {0}
    while more := {k for pair in pairs if reached & set(pair) for k in pair} - reached:
        reached |= more
    first, within = sets[0]
    assert set(first) == reached and list(first) == sorted(first)
    assert set(within) == {p for p in {*pairs, (0, 11)} if set(p) <= reached}
