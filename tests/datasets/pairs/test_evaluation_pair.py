"""What is true of an evaluation pair: area in common, the point errors are measured at, rooms that lie over each other."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from topomerge.datasets.pairs.evaluation_pair import (
    _number_matched_rooms,
    compute_anchor,
    convert_to_sim3,
    find_twins,
    match_overlapping_rooms,
    measure_common_area,
)

from tests.matching.turned_maps import turned, uneven, without
from tests.scenes_map import building
from topomerge.types import Sim3, TopometricMap, TrueRoom

SHIFT = (7.0, -3.0, 1.5)


def pair(truth: Sim3 | None, kind: str = "overlap") -> Any:
    return SimpleNamespace(truth=truth, kind=kind)


@pytest.fixture(scope="module")
def maps() -> tuple[TopometricMap, TopometricMap]:
    return uneven(), turned(uneven(), SHIFT)[0]


@pytest.fixture(scope="module")
def truth() -> Sim3:
    return turned(uneven(), SHIFT)[1]


def plan_area(map: TopometricMap) -> float:
    width, depth = np.ptp(map.grid.cells[:, :2], axis=0) + 1
    return float(width * depth) * map.grid.edge**2


def test_the_area_in_common_is_that_of_the_columns_both_saw(maps, truth):
    whole = plan_area(maps[0])
    assert measure_common_area(maps, truth) == pytest.approx(whole, rel=0.05)
    aside = Sim3(0.0, (0.0, 5.0, 0.0)) @ truth  # along the longer side
    length = np.ptp(maps[0].grid.cells[:, 1]) * maps[0].grid.edge
    assert measure_common_area(maps, aside) == pytest.approx(whole * (1 - 5.0 / length), rel=0.05)
    assert measure_common_area(maps, None) == 0.0 and measure_common_area(maps, Sim3(0.0, (99.0, 0.0, 0.0)) @ truth) == 0.0


def test_storeys_that_lie_above_each_other_have_nothing_in_common(maps, truth):
    lifted = Sim3(0.0, (0.0, 0.0, 3.3)) @ truth
    assert measure_common_area(maps, lifted) == 0.0
    two = building(1, storeys=2)
    other, back = turned(two, SHIFT)
    assert measure_common_area((two, other), back) == pytest.approx(
        2 * measure_common_area((building(1), turned(building(1), SHIFT)[0]), back), rel=0.1
    )


def test_errors_are_measured_in_the_middle_of_what_both_saw(maps, truth):
    b = maps[1]
    assert compute_anchor(pair(truth), maps) == pytest.approx(b.grid.compute_centroids().mean(axis=0), abs=0.1)
    aside = Sim3(0.0, (0.0, 8.0, 0.0)) @ truth  # of b only what lies on a's far end was seen by both
    seen = aside.apply(b.grid.compute_centroids())
    seen = b.grid.compute_centroids()[seen[:, 1] < maps[0].grid.compute_centroids()[:, 1].max()]
    assert compute_anchor(pair(aside), maps) == pytest.approx(seen.mean(axis=0), abs=0.6)  # that of all is 4 m off
    away = Sim3(0.0, (99.0, 0.0, 0.0)) @ truth
    assert compute_anchor(pair(away), maps) == pytest.approx(b.grid.compute_centroids().mean(axis=0))


def test_rooms_that_lie_over_each_other_stand_for_true_ones(maps, truth):
    assert match_overlapping_rooms(pair(truth), maps).tolist() == [[k, k] for k in range(4)]
    less = (maps[0], without(maps[1], 1))
    assert match_overlapping_rooms(pair(truth), less).tolist() == [[0, 0], [2, 1], [3, 2]]
    assert (
        match_overlapping_rooms(pair(truth, "twin-wing"), maps).shape == match_overlapping_rooms(pair(None), maps).shape == (0, 2)
    )


def test_each_match_of_rooms_without_labels_is_a_room_of_its_own():
    true = _number_matched_rooms(np.array([[0, 2], [3, 1]]), (4, 3))
    assert true[0].tolist() == [0, -1, -1, 1] and true[1].tolist() == [-1, 1, 0]


def test_a_matrix_is_read_as_the_similarity_that_wrote_it():
    pose = Sim3(-2.9, (4.0, -1.0, 0.5), 1.3)
    assert np.allclose(convert_to_sim3(pose.matrix).matrix, pose.matrix) and convert_to_sim3(pose.matrix).scale == pytest.approx(
        1.3
    )
    assert convert_to_sim3(np.full((4, 4), np.nan)) is None


@pytest.mark.parametrize(
    ("size", "is_twin"), [((5.1, 4.0), True), ((4.0, 5.1), True), ((5.3, 4.0), False), ((5.2, 3.9), True), ((10.0, 2.0), False)]
)
def test_twins_have_one_area_and_one_pair_of_sides(size, is_twin):
    def room(x: float, y: float) -> TrueRoom:
        return TrueRoom("", np.array([[0.0, 0], [x, 0], [x, y], [0, y]]), 0.0, 2.5)

    rooms = [room(5.0, 4.0), room(*size)]
    assert find_twins(np.array([0]), np.array([0, 1]), rooms, rooms).tolist() == [is_twin]
