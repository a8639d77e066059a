"""Matching by attention: what must not matter does not, file and torch agree, files are trusted only as far as they can be."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from topomerge.models.export import read_weights, run_with_torch
from topomerge.models.room_matcher import MatcherStage, RoomMatcher, build_stages

from topomerge.archive import VARIABLE, find_weights_file
from topomerge.embedding.quarter_turns import FACTS, compute_room_features
from topomerge.errors import InputError
from topomerge.matching import room_matcher
from topomerge.matching.room_matcher import (
    AGREEMENT,
    LEVEL_GAP,
    VOTE_UNIT,
    VOTERS,
    Matcher,
    RoomsSeen,
    build_signature,
    combine_turn_certainties,
    compute_agreement,
    load_matcher_weights,
    run_network,
)
from topomerge.networks.network import WEIGHTS_PACKAGE, Network, read_card

ROWS, WIDTH = 24, 16


def rooms(count: int, seed: int) -> RoomsSeen:
    """Rooms that look like nothing else, on two storeys."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(count, ROWS))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    heights = np.where(np.arange(count) % 5 == 4, 3.0, 0.0)
    return RoomsSeen(rows, rng.uniform(0, 30, (count, 2)), heights, rng.normal(size=(count, FACTS)))


def some(of: RoomsSeen, index: np.ndarray) -> RoomsSeen:
    """Rooms of an index."""
    return RoomsSeen(of.rows[index], of.places[index], of.heights[index], of.facts[index])


def matcher_of(net: RoomMatcher) -> Matcher:
    """A network of torch as the package runs it."""
    stages = len(net.head)
    return Matcher(run_with_torch(build_stages(net), build_signature(ROWS, WIDTH, stages)), WIDTH, stages, "embedder")


def network(seed: int = 0) -> Matcher:
    """A small network that was not trained."""
    torch.manual_seed(seed)
    return matcher_of(RoomMatcher(ROWS, width=WIDTH, layers=2))


def seen_again(of: RoomsSeen, strange: int) -> RoomsSeen:
    """All rooms, moved together and a little changed, before so many others."""
    rng, other = np.random.default_rng(5), rooms(strange, 9)
    rows = of.rows + 0.05 * rng.normal(size=of.rows.shape)
    rows = np.concatenate([rows / np.linalg.norm(rows, axis=1, keepdims=True), other.rows])
    places = np.concatenate([of.places + (7.0, -3.0), other.places])
    return RoomsSeen(rows, places, np.concatenate([of.heights, other.heights]), np.concatenate([of.facts, other.facts]))


def test_stage_by_stage_is_all_at_once() -> None:
    torch.manual_seed(0)
    net = RoomMatcher(ROWS, width=16, layers=2).eval()
    a = rooms(6, 1)
    b = seen_again(a, 4)
    with torch.no_grad():
        partners = net(a, b)[-1]
    odds = run_network(a, b, matcher_of(net))
    assert odds.rows == pytest.approx(partners.rows.exp().numpy(), abs=1e-5)
    assert odds.columns == pytest.approx(partners.columns.exp().numpy(), abs=1e-5)
    assert odds.rows.sum(axis=1) == pytest.approx(1.0) and odds.columns.shape == (10, 7)


def test_order_of_rooms_order_of_maps_and_places_of_frames_do_not_matter() -> None:
    a, w = rooms(7, 1), network()
    b = seen_again(a, 3)
    odds, order = run_network(a, b, w), np.random.default_rng(1).permutation(10)
    shuffled = run_network(a, some(b, order), w)
    assert shuffled.certainty == pytest.approx(odds.certainty[:, order], abs=1e-6)
    assert run_network(b, a, w).certainty == pytest.approx(odds.certainty.T, abs=1e-6)
    moved = run_network(a, replace(b, places=b.places + (100.0, -40.0), heights=b.heights), w)
    assert moved.certainty == pytest.approx(odds.certainty, abs=1e-6)  # single precision


@pytest.mark.parametrize(("few", "more"), [(1, 0), (1, 1), (7, 4), (40, 31)])
def test_the_network_that_ships_is_as_its_module_of_torch(few: int, more: int) -> None:
    pytest.importorskip("onnx")
    shipped = load_matcher_weights()
    assert isinstance(shipped.run, Network)
    numbers = int(shipped.run.signature.inputs["rows_a"].shape[1])
    net = RoomMatcher(numbers, shipped.width, shipped.stages - 1)
    assert not any(MatcherStage(net, 0).load_state_dict(read_weights(shipped.run.path)))
    rng, maps = np.random.default_rng(few), []
    for count in (few, few + more):
        rows = np.repeat(rng.normal(size=(count, 1)), numbers, axis=1) + rng.normal(size=(count, numbers))
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        maps.append(
            RoomsSeen(rows, rng.uniform(0, 30, (count, 2)), 3.0 * (np.arange(count) % 2), rng.normal(size=(count, FACTS)))
        )
    with torch.no_grad():
        partners = net.eval()(*maps)[-1]
    odds = run_network(*maps, shipped)
    assert odds.rows == pytest.approx(partners.rows.exp().numpy(), abs=1e-5)
    assert odds.columns == pytest.approx(partners.columns.exp().numpy(), abs=1e-5)


def test_pairs_that_are_moved_alike_agree_and_those_of_another_storey_do_not() -> None:
    places = np.array([[0.0, 0], [5, 0], [5, 6], [12, 6]])
    a = RoomsSeen(np.zeros((4, 1)), places, np.array([0.0, 0, 0, 3]), np.zeros((4, FACTS)))
    b = replace(a, places=places + (2.0, 1.0), heights=np.zeros(4))
    votes = compute_agreement(np.eye(4), a, b)
    assert votes[0, 0, 0] == pytest.approx(np.log1p(3 * 2)) and votes[3, 3, 0] == 0.0  # two others say the same way
    assert votes[0, 1, 0] == 0.0 and votes[1, 0].max() == 0.0
    off = compute_agreement(np.eye(4), a, replace(b, places=b.places + np.array([[0.75, 0], [0, 0], [0, 0], [0, 0]])))
    assert off[0, 0, 0] == pytest.approx(np.log1p(3 * 2 * 0.75**2)) and off[1, 1, 0] == pytest.approx(np.log1p(3 * (1 + 0.75**2)))


def test_votes_are_sums_over_all_pairs_of_pairs() -> None:
    rng = np.random.default_rng(0)
    n, m = 9, 7
    a, b = (
        RoomsSeen(np.zeros((k, 4)), rng.uniform(0, 12, (k, 2)), 3.0 * rng.integers(0, 2, k), np.zeros((k, 3))) for k in (n, m)
    )
    likely = rng.uniform(0, 1, (n, m))
    expected = np.zeros((n, m, len(AGREEMENT)))
    voters = sorted(product(range(n), range(m)), key=lambda pair: -likely[pair])[: VOTERS * (n + m)]
    for i, j in product(range(n), range(m)):
        for u, v in voters:
            apart = np.linalg.norm((a.places[i] - b.places[j]) - (a.places[u] - b.places[v]))
            level = abs((a.heights[i] - b.heights[j]) - (a.heights[u] - b.heights[v])) < LEVEL_GAP
            if i != u and j != v and level:
                expected[i, j] += [max(1 - (apart / width) ** 2, 0) ** 2 * likely[u, v] for width in AGREEMENT]
    assert expected.max() > 0 and np.allclose(compute_agreement(likely, a, b), np.log1p(VOTE_UNIT * expected))


def without(*parts: str) -> RoomMatcher:
    """A network without some parts, after a step of an optimizer."""
    torch.manual_seed(0)
    net = RoomMatcher(ROWS, width=16, layers=2, dropout=0.0)
    net.leave_out(parts)
    a = rooms(6, 1)
    optimizer = torch.optim.AdamW(net.parameters(), 0.01)
    net(a, seen_again(a, 4))[-1].rows[:, 0].sum().backward()
    optimizer.step()
    return net.eval()


@pytest.mark.parametrize(
    ("parts", "changed"), [(("votes", "ways"), "places"), (("facts",), "facts"), (("within", "votes", "across"), "places")]
)
def test_what_is_left_out_tells_nothing(parts: tuple[str, ...], changed: str) -> None:
    a = rooms(6, 1)
    b = seen_again(a, 4)
    other = replace(b, **{changed: np.random.default_rng(8).normal(size=getattr(b, changed).shape)})
    for names, same in ((parts, True), ((), False)):
        net = matcher_of(without(*names))
        rows = [run_network(a, one, net).rows for one in (b, other)]
        assert (np.abs(rows[0] - rows[1]).max() < 1e-9) == same


def test_a_part_that_does_not_exist_can_not_be_left_out() -> None:
    with pytest.raises(InputError, match="without: unknown 'layers'"):
        RoomMatcher(ROWS, width=16).leave_out(["layers"])


def test_turns_are_as_likely_as_they_are_sure() -> None:
    sure = room_matcher.RoomOdds(np.array([[1.0, 0.0]]), np.array([[1.0, 0.0]]), 2)
    none = room_matcher.RoomOdds(np.array([[0.0, 1.0]]), np.array([[0.0, 1.0]]), 0)
    assert sure.confidence == 1.0 and none.confidence == 0.0
    assert combine_turn_certainties([none, sure]) == pytest.approx(np.e / (1 + np.e))


def test_the_network_that_ships_is_that_of_the_embedder_that_ships() -> None:
    from topomerge.embedding.learned import load_embedder

    shipped = load_matcher_weights()
    assert isinstance(shipped.run, Network) and shipped.embedder == load_embedder().embedder
    assert shipped.run.signature.inputs["rows_a"].shape[1] == 4 * load_embedder().network.size


def test_facts_of_rooms_are_logarithms_their_dustbin_and_their_height() -> None:
    facts = compute_room_features(np.array([[np.e - 1, -np.e + 1, 0.0]]), np.array([0.5]), np.array([3.0]))
    assert facts == pytest.approx(np.array([[1, -1, 0, 0.5, 3]]))


@pytest.mark.parametrize(
    "change",
    [
        {"data": {}},
        {"settings": {}},
        {"inputs": 3},
        {"settings": {"width": 1 << 40, "layers": 3}},
        {"settings": {"width": 96, "layers": 2}},
    ],
)
def test_files_whose_card_is_of_no_matcher_are_refused(change, tmp_path, monkeypatch) -> None:
    shipped = find_weights_file(WEIGHTS_PACKAGE, room_matcher.MATCHER_FILE)
    shutil.copy(shipped, tmp_path)
    (tmp_path / "room_matcher.card.json").write_text(json.dumps({**read_card(shipped), **change}))
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    with pytest.raises(InputError, match=r"^[^\n]*room_matcher\.onnx: [^\n]*$"):
        load_matcher_weights()
