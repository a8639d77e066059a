"""Metrics of maps: hand-computed examples, symmetry, and labels that may be named anyhow."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.grids import COMPILED
from topomerge.metrics import (
    assign,
    compute_overlaps,
    count_contingency,
    is_on_storey,
    is_pose_right,
    is_storeys_right,
    match_places,
    score_doors,
    score_edges,
    score_rooms,
)

LABELS = arrays(np.int32, 40, elements=st.integers(-1, 4))
ALL = np.ones(2, bool)


def places(*counts: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """True and found labels from (true, found, number of places)."""
    return tuple(np.concatenate([np.full(c[2], c[k]) for c in counts]) for k in (0, 1))  # type: ignore[return-value]


def test_a_perfect_map() -> None:
    true, found = places((0, 1, 30), (1, 0, 10))
    scores = score_rooms(true, found, 2, ALL)
    assert (scores.iou, scores.mcc, scores.precision, scores.recall) == (1, pytest.approx(1), 1, 1)
    assert scores.assigned.tolist() == [1, 0]


def test_a_room_split_in_two() -> None:
    """Room 0 (30 places) is found as 18 and 12; the larger piece is assigned to it."""
    true, found = places((0, 0, 18), (0, 1, 12), (1, 2, 10))
    scores = score_rooms(true, found, 2, np.ones(3, bool))
    assert scores.each.tolist() == pytest.approx([18 / 30, 1])
    assert scores.iou == pytest.approx(0.8)
    assert (scores.precision, scores.recall) == (pytest.approx(2 / 3), 1)
    # tp 18, fp 0, fn 12, tn 10
    assert scores.each_mcc[0] == pytest.approx((18 * 10) / np.sqrt(18 * 30 * 10 * 22))


def test_two_rooms_merged() -> None:
    """Rooms of 30 and 10 places are found as one: it is assigned to the larger, the other one has none."""
    true, found = places((0, 0, 30), (1, 0, 10))
    scores = score_rooms(true, found, 2, np.ones(1, bool))
    assert scores.each.tolist() == pytest.approx([0.75, 0])
    assert (scores.precision, scores.recall) == (1, 0.5)
    assert scores.mcc == 0  # the mask of everything says nothing
    assert scores.assigned.tolist() == [0, -1]


def test_a_room_that_leaks_and_one_that_is_missed() -> None:
    true, found = places((0, 0, 20), (-1, 0, 20), (1, -1, 10))
    scores = score_rooms(true, found, 2, np.ones(1, bool))
    assert scores.each.tolist() == pytest.approx([0.5, 0])
    assert (scores.precision, scores.recall) == (1, 0.5)


def test_no_map_at_all() -> None:
    scores = score_rooms(np.zeros(5, int), np.full(5, -1), 1, np.zeros(0, bool))
    assert (scores.iou, scores.mcc, scores.recall) == (0, 0, 0)
    assert np.isnan(scores.precision)
    empty = score_rooms(np.zeros(0, int), np.zeros(0, int), 0, np.zeros(0, bool))
    assert np.isnan(empty.iou) and np.isnan(empty.recall)


def test_rooms_that_do_not_count() -> None:
    """A glimpsed room beside the visited ones is not held against the map; one that is not marked is."""
    true, found = places((0, 0, 30), (1, 1, 10))
    expected = np.array([True, False])
    assert score_rooms(true, found, 2, np.array([True, False]), expected).precision == 1
    assert score_rooms(true, found, 2, ALL, expected).precision == 0.5
    assert score_rooms(true, found, 2, ALL, expected).recall == 1


def test_contingency_and_overlaps_by_hand() -> None:
    true, found = np.array([0, 0, 1, -1, 1]), np.array([0, 1, 1, 1, -1])
    assert count_contingency(true, found, 2, 2).tolist() == [[1, 1], [0, 1]]
    iou, _ = compute_overlaps(true, found, 2, 2)
    assert iou == pytest.approx(np.array([[1 / 2, 1 / 4], [0, 1 / 4]]))
    assert assign(iou).tolist() == [0, 1]


def test_matthews_correlation_is_that_of_the_masks() -> None:
    rng = np.random.default_rng(0)
    true, found = rng.integers(-1, 3, 200), rng.integers(-1, 4, 200)
    _, mcc = compute_overlaps(true, found, 3, 4)
    for i in range(3):
        for j in range(4):
            assert mcc[i, j] == pytest.approx(np.corrcoef(true == i, found == j)[0, 1])


@COMPILED
@given(LABELS, LABELS, st.permutations(range(5)), st.permutations(range(5)), st.permutations(range(40)))
def test_names_of_rooms_and_order_of_places_do_not_matter(true, found, a, b, order) -> None:
    before = score_rooms(true, found, 5, np.ones(5, bool))
    renamed = [np.append(p, -1)[x][list(order)] for p, x in ((a, true), (b, found))]
    after = score_rooms(*renamed, 5, np.ones(5, bool))
    assert after.iou == pytest.approx(before.iou)


def test_doors() -> None:
    true = np.array([[0, 0, 0], [5, 0, 0], [9, 0, 0]], float)
    found = np.array([[0.3, 0.3, 0.2], [0.1, 0, 0], [5, 0, 2], [9.6, 0, 0], [20, 0, 0]], float)
    assert match_places(true, found).tolist() == [[0, 1]]  # the nearer one; a storey higher and 0.6 m away are too far
    scores = score_doors(true, found, np.ones(5, bool))
    assert (scores.right, scores.precision, scores.recall) == (1, pytest.approx(1 / 5), pytest.approx(1 / 3))
    excused = score_doors(true, found, np.array([1, 1, 1, 1, 0], bool), others=np.array([[9.6, 0.1, 0]]))
    assert excused.precision == pytest.approx(1 / 3)
    assert np.isnan(score_doors(true, np.zeros((0, 3)), np.zeros(0, bool)).precision)


def test_one_door_is_not_found_twice() -> None:
    true = np.array([[0, 0, 0], [0.6, 0, 0]], float)
    assert match_places(true, np.array([[0.3, 0, 0]])).shape == (1, 2)
    assert match_places(true, np.array([[0.3, 0, 0], [-0.4, 0, 0]])).tolist() == [[0, 1], [1, 0]]


def test_edges() -> None:
    """True graph 0-1-2; room 1 was found as 7 and room 2 not at all."""
    assigned = np.array([3, 7, -1])
    counted = np.ones(9, bool)
    scores = score_edges([(0, 1), (2, 1)], np.array([[7, 3], [3, 7], [7, 8]]), assigned, counted)
    assert (scores.right, scores.precision, scores.recall) == (1, 0.5, 0.5)
    counted[8] = False
    assert score_edges([(0, 1), (2, 1)], np.array([[7, 3], [7, 8]]), assigned, counted).precision == 1


def test_storeys() -> None:
    assert is_storeys_right(np.array([0.0, 3.0]), np.array([3.4, -0.2]))
    assert not is_storeys_right(np.array([0.0, 3.0]), np.array([0.0, 3.6]))
    assert not is_storeys_right(np.array([0.0]), np.array([0.0, 3.0]))


@pytest.mark.parametrize(
    ("error", "flat", "good"),
    [
        ((0.3, 0.3, 4.9), False, True),
        ((0.3, 0.45, 1.0), False, False),  # 0.54 m in space
        ((0.3, 0.45, 1.0), True, True),
        ((0.1, 0.0, 5.1), False, False),
        ((0.1, 0.0, 5.1), True, False),
        ((0.1, 1.3, 0.0), True, True),
        ((0.1, 2.8, 0.0), True, False),
        ((0.1, -2.8, 0.0), True, False),
    ],
)
def test_a_pose_is_right_in_space_or_on_its_storey(error, flat, good) -> None:
    assert is_pose_right(error, flat, (0.5, 5.0)) == good


def test_storeys_are_nearer_to_their_own_floor() -> None:
    for height in (2.8, 3.2, 4.0):
        assert is_on_storey(0.0) and is_on_storey(0.1 * height) and not is_on_storey(height) and not is_on_storey(-0.9 * height)
