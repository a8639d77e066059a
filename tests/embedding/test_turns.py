"""Rows for quarter turns: turns between two maps have probabilities, rows that have none stay, what is turned comes back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.matching.turned_maps import turned
from tests.scenes_map import building
from topomerge.embedding.engineered import add_context
from topomerge.embedding.graph import build_graph_arrays
from topomerge.embedding.quarter_turns import (
    ONE_PLACE,
    Turn,
    TurnedRows,
    YawProbability,
    average_turns,
    compute_edge_positions,
    compute_similarity,
    estimate_turns,
    merge_yaws,
    rotate_graph,
    select_credible,
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


def likeliest(a: TurnedRows, b: TurnedRows) -> Turn:
    return max(estimate_turns(a, b), key=lambda turn: turn.probability)


@pytest.mark.parametrize("turns", range(4))
def test_rooms_of_a_turned_map_are_their_own_partners(turns):
    rows = some_rows(9)
    other = turned_rows(rows, turns)
    best = likeliest(rows, other)
    assert best.quarters == turns and best.probability > 0.999
    assert np.diag(best.cosine) == pytest.approx(1.0)
    assert compute_similarity(rows, other) == pytest.approx(best.cosine, abs=1e-2)


@pytest.mark.parametrize("turns", range(4))
def test_where_all_rooms_look_the_same_in_all_directions_their_places_tell(turns):
    rows = TurnedRows(np.ones((5, 4, 1)), np.array([[0, 0], [4, 0], [8, 0], [8, 5], [8, 11.0]]))
    best = likeliest(rows, turned_rows(rows, turns))
    assert best.quarters == turns and best.probability > 0.9


@pytest.mark.parametrize(("fold", "fitting"), [(1, [0]), (2, [0, 2]), (4, [0, 1, 2, 3])])
def test_all_turns_of_a_symmetric_plan_fit_alike(fold, fitting):
    """Copies of three rooms by turns about the middle: what a copy sees is what the first one sees, turned."""
    seen, ways = some_rows(3, 4), np.array([9 + 2j, 7 + 6j, 3 + 5j])
    rows, places = [], []
    for k in range(0, 4, 4 // fold):
        rows.append(np.roll(seen.rows, -k, axis=1))
        places.append(ways * 1j**k)
    flat = np.concatenate(places)
    map = TurnedRows(np.concatenate(rows), np.column_stack([flat.real, flat.imag]))
    again = replace(map, places=map.places + (3.0, -8.0))
    turns = estimate_turns(map, again)
    assert [turn.quarters for turn in turns if turn.probability == pytest.approx(1 / fold, abs=0.02)] == fitting
    credible = select_credible(merge_yaws([(turn.yaw, turn.probability) for turn in turns]))
    assert sorted(round(np.degrees(yaw)) % 360 for yaw, _ in credible) == [90 * k for k in fitting]
    similarity = compute_similarity(map, again)
    images = [np.arange(len(flat)) // 3 == k for k in range(fold)]
    for i in range(3):  # every image of a room is as alike as the room itself, and more than any other
        of = similarity[i, [np.flatnonzero(image)[i] for image in images]]
        assert of == pytest.approx(of[0], abs=0.02) and (similarity[i] >= of.min() - 0.02).sum() == fold


def test_yaws_are_those_of_frames_and_do_not_depend_on_them():
    rows = some_rows(8)
    plain = estimate_turns(rows, turned_rows(rows, 1))
    turned = estimate_turns(replace(rows, direction=0.3), replace(turned_rows(rows, 1), direction=0.3 - np.radians(30)))
    assert [t.probability for t in turned] == [t.probability for t in plain]
    best = max(turned, key=lambda turn: turn.probability)
    assert np.degrees(best.yaw) == pytest.approx(120.0)


def test_walls_of_two_directions_allow_more_than_quarter_turns():
    """Two maps whose first directions of walls are not the same: in another one of b, its rooms look like those of a."""
    rows, wrong = some_rows(7), some_rows(7, seed=3)
    right = replace(turned_rows(rows, 2), direction=0.4)
    b = replace(wrong, direction=0.4 - np.radians(35), others=(right,))
    best = likeliest(rows, b)
    assert best.b is right and best.quarters == 2 and best.probability > 0.999
    assert len(estimate_turns(rows, b)) == 8 and np.degrees(best.yaw) == pytest.approx(180 - np.degrees(0.4))
    assert (compute_similarity(rows, b).argmax(axis=1) == np.arange(7)).all()
    assert (compute_similarity(rows, replace(b, others=())).argmax(axis=1) != np.arange(7)).any()


def test_strange_rooms_do_not_hide_the_turn():
    rows, strange = some_rows(9), some_rows(6, seed=1)
    again = turned_rows(rows, 3, [0, 1, 2, 3, 4])
    other = TurnedRows(np.concatenate([again.rows, strange.rows]), np.concatenate([again.places, strange.places]))
    assert compute_similarity(rows, other).argmax(axis=1)[:5].tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("turns", range(4))
def test_rooms_of_one_map_are_moved_by_one_way(turns):
    rows = some_rows(7)
    best = likeliest(rows, turned_rows(rows, turns))
    assert best.shift == pytest.approx(-(5 - 2j) * 1j**turns, abs=0.02)
    assert np.diag(best.coincidence) == pytest.approx(1.0, abs=1e-3)
    apart = np.linalg.norm(rows.places[:, None] - rows.places[None], axis=2)
    assert best.coincidence == pytest.approx(np.exp(-(apart**2) / (2 * ONE_PLACE**2)), abs=0.02)


def test_evidence_is_that_of_the_sum_over_shifts():
    """Of two rooms each, by hand: with the partner that a shift gives, or none."""
    a = TurnedRows(np.ones((2, 4, 1)), np.array([[0.0, 0], [40, 0]]))
    one, none = np.log(0.5 + 0.5 * np.exp(20.0 * 0.35)), np.log(0.5)
    straight = [2 * one, one + none, one + none, 2 * one]  # shifts by the pairs (0, 0), (0, 1), (1, 0), (1, 1)
    across = [one + none] * 4
    shares = np.exp([np.logaddexp.reduce(side) for side in (straight, across, straight, across)])
    found = [turn.probability for turn in estimate_turns(a, a)]
    assert found == pytest.approx(shares / shares.sum())


def test_nobody_knows_the_turn_of_a_map_without_rooms():
    assert [turn.probability for turn in estimate_turns(some_rows(0), some_rows(2))] == [0.25] * 4
    assert compute_similarity(some_rows(0), some_rows(2)).shape == (0, 2)


def test_the_order_of_two_maps_does_not_matter():
    one, two = some_rows(8), turned_rows(some_rows(8), 1, [0, 2, 3, 5, 7])
    assert compute_similarity(one, two) == pytest.approx(compute_similarity(two, one).T)
    there, back = estimate_turns(one, two), estimate_turns(two, one)
    assert [t.probability for t in there] == pytest.approx([back[-t.quarters % 4].probability for t in there])


def test_means_over_turns_go_by_their_probability():
    turns = [Turn(some_rows(2), some_rows(3), k, probability=p) for k, p in enumerate((0.75, 0.25))]
    assert average_turns(turns, lambda turn: np.full((2, 3), float(turn.quarters))) == pytest.approx(0.25)


def test_nearly_equal_yaws_are_one_and_the_fewest_are_credible():
    found = merge_yaws([(np.pi - 0.05, 0.3), (0.0, 0.4), (0.05 - np.pi, 0.2), (1.0, 0.1)])
    assert [p for _, p in found] == pytest.approx([0.5, 0.4, 0.1]) and found[0].yaw == pytest.approx(np.pi - 0.05)
    assert select_credible(found) == found[:2]
    assert select_credible((YawProbability(0.0, 0.95), YawProbability(1.0, 0.05))) == (YawProbability(0.0, 0.95),)
    assert select_credible(()) == ()


def test_plain_rows_have_no_turns():
    plain = np.array([[1.0, 0.0], [0.6, 0.8]])
    assert compute_similarity(plain, plain) == pytest.approx(plain @ plain.T)


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
