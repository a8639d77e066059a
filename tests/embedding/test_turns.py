"""Rows for quarter turns: the turn between two maps is found, rows that have none stay, and what is turned comes back."""

from __future__ import annotations

import numpy as np
import pytest

from tests.matching.turned_maps import turned
from tests.scenes_map import building
from topomerge.embedding.engineered import add_context
from topomerge.embedding.graph import build_graph_arrays
from topomerge.embedding.quarter_turns import (
    ONE_PLACE,
    TurnedRows,
    align_rows,
    compute_edge_positions,
    estimate_quarter_turns,
    estimate_relative_position,
    rotate_graph,
    score_common_motion,
)
from topomerge.embedding.sheets import build_sheet_arrays
from topomerge.embedding.surroundings import CROP_PART as CROP
from topomerge.embedding.surroundings import cut_crops
from topomerge.errors import InputError


def some_rows(rooms: int, seed: int = 0) -> TurnedRows:
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(rooms, 4, 6))
    return TurnedRows(rows / np.linalg.norm(rows, axis=2, keepdims=True), rng.uniform(0, 20, (rooms, 2)))


def turned_rows(of: TurnedRows, turns: int, rooms: list[int] | slice = slice(None)) -> TurnedRows:
    """Rows of the same rooms in a map that was turned back by so many quarter turns, and moved."""
    back = of.places[rooms] @ np.array([1, 1j]) * (-1j) ** turns
    return TurnedRows(np.roll(of.rows[rooms], turns, axis=1), np.column_stack([back.real + 5, back.imag - 2]))


@pytest.mark.parametrize("turns", range(4))
def test_rooms_of_a_turned_map_are_their_own_partners(turns):
    rows = some_rows(9)
    other = turned_rows(rows, turns)
    assert estimate_quarter_turns(rows, other) == turns
    a, b = align_rows(rows, other)
    assert a == pytest.approx(b) and np.linalg.norm(a, axis=1) == pytest.approx(1.0)


@pytest.mark.parametrize("turns", range(4))
def test_where_all_rooms_look_the_same_in_all_directions_their_places_tell(turns):
    rows = TurnedRows(np.ones((5, 4, 1)), np.array([[0, 0], [4, 0], [8, 0], [8, 5], [8, 11.0]]))
    assert estimate_quarter_turns(rows, turned_rows(rows, turns)) == turns


def test_strange_rooms_do_not_hide_the_turn():
    rows, strange = some_rows(9), some_rows(6, seed=1)
    again = turned_rows(rows, 3, [0, 1, 2, 3, 4])
    other = TurnedRows(np.concatenate([again.rows, strange.rows]), np.concatenate([again.places, strange.places]))
    a, b = align_rows(rows, other)
    assert (a @ b.T).argmax(axis=1)[:5].tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("turns", range(4))
def test_rooms_of_one_map_are_moved_by_one_way(turns):
    rows = some_rows(7)
    other = turned_rows(rows, turns)
    quarters, way = estimate_relative_position(rows, other)
    assert quarters == turns and way == pytest.approx(-(5 - 2j) * 1j**turns, abs=0.02)
    there = score_common_motion(rows, other, quarters, way)
    assert np.diag(there) == pytest.approx(1.0, abs=1e-3)
    apart = np.linalg.norm(rows.places[:, None] - rows.places[None], axis=2)
    assert there == pytest.approx(np.exp(-(apart**2) / (2 * ONE_PLACE**2)), abs=0.02)
    assert estimate_relative_position(rows, some_rows(0)) == (0, 0)


def test_the_order_of_two_maps_does_not_matter():
    one = some_rows(8)
    two = turned_rows(one, 1, [0, 2, 3, 5, 7])
    (a, b), (c, d) = align_rows(one, two), align_rows(two, one)
    assert a @ b.T == pytest.approx((c @ d.T).T)


def test_plain_rows_and_maps_without_rooms_stay_as_they_are():
    plain = np.ones((3, 6))
    assert align_rows(plain, plain)[0] is plain
    a, b = align_rows(some_rows(0), some_rows(2))
    assert a.shape == (0, 24) and b.shape == (2, 24)


def test_context_is_refused_for_rows_that_have_theirs():
    with pytest.raises(InputError, match="leave k out"):
        add_context(lambda map: some_rows(3), 1)(building(1))


def test_ways_and_crops_of_a_turned_map_are_turned():
    map = building(2)
    other, _ = turned(map, (3.0, 4.0, 0.0))
    graphs = [build_graph_arrays(m) | build_sheet_arrays(m) for m in (map, other)]
    read = [{"edge_way": compute_edge_positions(g), CROP: cut_crops(g)} for g in graphs]
    once = rotate_graph(read[0], 1)
    assert once["edge_way"] == pytest.approx(read[1]["edge_way"], abs=1e-4)
    right = [np.corrcoef(rotate_graph(read[0], k)[CROP].ravel(), read[1][CROP].ravel())[0, 1] for k in range(4)]
    assert int(np.argmax(right)) == 1


def test_four_quarter_turns_are_none():
    map = building(1)
    g = build_graph_arrays(map) | build_sheet_arrays(map)
    read = {"edge_way": compute_edge_positions(g), CROP: cut_crops(g)}
    back = rotate_graph(rotate_graph(read, 1), 3)
    assert back["edge_way"] == pytest.approx(read["edge_way"], abs=1e-5)
    assert np.array_equal(back[CROP], read[CROP])


def test_ways_lead_from_room_to_room_and_to_the_door_between():
    map = building(1)
    g = build_graph_arrays(map) | {"turn": np.zeros(1)}
    ways, index = compute_edge_positions(g), g["edge_index"]
    expected = (map.rooms["centroid"][index[1]] - map.rooms["centroid"][index[0]])[:, :2]
    assert ways[:, :2] == pytest.approx(expected, abs=1e-5)
    half = index.shape[1] // 2
    assert ways[:half, :2] == pytest.approx(-ways[half:, :2], abs=1e-5)
