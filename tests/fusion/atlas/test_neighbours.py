"""Nearest rooms of many maps, and the maps that they speak for."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.embedding.quarter_turns import TurnedRows
from topomerge.fusion.atlas import partners as neighbours
from topomerge.fusion.atlas.partners import (
    compute_queries,
    compute_vectors,
    count_votes,
    find_nearest,
    iter_most_similar,
    list_owners,
)
from topomerge.types import Array


def unit(rows: Array) -> Array:
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


@pytest.mark.parametrize("at_once", [7, 1000])
def test_the_nearest_are_those_of_a_sort(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neighbours, "VECTORS_AT_ONCE", at_once)
    monkeypatch.setattr(neighbours, "QUERIES_AT_ONCE", 3)
    rng = np.random.default_rng(0)
    table, asked = unit(rng.normal(size=(50, 6))), unit(rng.normal(size=(10, 6)))
    rooms, cosine = find_nearest(table, asked, 12)
    assert np.array_equal(rooms, np.argsort(-(asked @ table.T), axis=1)[:, :12])
    assert np.allclose(cosine, np.take_along_axis(asked @ table.T, rooms, axis=1), atol=1e-6)
    assert find_nearest(table, asked, 99)[0].shape == (10, 50)
    left = find_nearest(table, asked, 12, but=(5, 30))[0]
    rest = np.r_[0:5, 30:50]
    assert np.array_equal(left, rest[np.argsort(-(asked @ table[rest].T), axis=1)[:, :12]])


def test_equal_ones_come_in_their_order() -> None:
    assert find_nearest(np.ones((6, 1)), np.ones((1, 1)), 4)[0].tolist() == [[0, 1, 2, 3]]


def test_a_room_has_one_vote_and_a_map_its_best_turn() -> None:
    owner = np.array([0, 0, 1, -1])
    alike = np.ones((1, 4))
    assert count_votes(np.array([[0, 1, 2, 3]]), alike, 1, owner, 3) == pytest.approx([2 / 3, 1 / 3, 0])
    # two rooms at two turns: map 0 has both at the first one, map 1 one at each
    rooms = np.array([[0, 2], [1, 3], [3, 2], [3, 3]])
    assert count_votes(rooms, np.ones((4, 2)), 2, owner, 2) == pytest.approx([1 / 3 + 1, 1 / 3])
    assert count_votes(np.array([[0, 2]]), np.array([[0.9, 1.0]]), 1, owner, 2)[1] == pytest.approx(1 / (1 + np.exp(-2.5)))


def test_vectors_of_a_turned_map_are_those_of_the_map_asked_for_at_that_turn() -> None:
    rng = np.random.default_rng(1)
    rows = unit(rng.normal(size=(5, 4, 3)))
    a, b = TurnedRows(rows, np.zeros((5, 2))), TurnedRows(np.roll(rows, 1, axis=1), np.zeros((5, 2)))
    assert np.allclose(np.linalg.norm(compute_vectors(a), axis=1), 1, atol=1e-6) and compute_queries(a).shape == (4, 5, 12)
    assert np.allclose(compute_vectors(b), compute_queries(a)[3]) and not np.allclose(compute_vectors(b), compute_queries(a)[1])
    plain = np.array([[3.0, 4.0], [0.0, 0.0]])
    assert compute_vectors(plain).tolist() == [[np.float32(0.6), np.float32(0.8)], [0, 0]] and compute_queries(plain).shape == (
        1,
        2,
        2,
    )


def test_maps_name_their_likes() -> None:
    rng = np.random.default_rng(2)
    rows = [unit(rng.normal(size=(6, 4, 8))) for _ in range(8)]
    again = [np.roll(unit(of[::-1] + 0.05 * rng.normal(size=of.shape)), k, axis=1) for k, of in enumerate(rows)]
    maps = [TurnedRows(of, np.zeros((6, 2))) for of in (*rows, *again)] + [np.zeros((0, 32))]
    named = list(iter_most_similar(maps, 3))
    assert [of[0] for of in named[:16]] == [*range(8, 16), *range(8)] and named[16] == ()
    assert all(len(set(of) - {k}) == 3 for k, of in enumerate(named[:16]))


def test_owners() -> None:
    assert list_owners([2, 0, 1]).tolist() == [0, 0, 2]
