"""Counts, ratios, intervals and calibration against examples worked out by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from topomerge.datasets.pairs.evaluation_pair import EvaluationPair, find_twins

from topomerge.errors import InputError
from topomerge.evaluation.predict import match_mutually
from topomerge.evaluation.score import (
    classify_modality,
    classify_overlap,
    count_matches,
    count_merges,
    count_ranks,
    count_ranks_after,
    is_within,
    measure_pose_error,
    rank_partners,
)
from topomerge.evaluation.tables import compute_gain, compute_value, count_hit_buildings, draw_buildings, format_value
from topomerge.types import Sim3, TrueRoom


def hand_made_pair(**changes: Any) -> EvaluationPair:
    """Map a has five rooms: true 0, 1, 1 (in two pieces), 2, none; map b four: true 1, 0, 2, 3. Room 2 of a has a twin."""
    fields = {
        "name": "x",
        "folder": Path(),
        "matches": np.array([(0, 1), (1, 0), (2, 0), (3, 2)]),
        "true": (np.array([0, 1, 1, 2, -1]), np.array([1, 0, 2, 3])),
        "one": (np.array([True, True, False, True, False]), np.ones(4, bool)),
        "twin": (np.array([False, False, False, True, False]), np.zeros(4, bool)),
        "glimpsed": (np.array([False, False, True, False, False]), np.array([True, False, False, False])),
        "transform": Sim3(0.3, (1.0, 2.0, 0.0)),
        "anchor": np.array([5.0, 0.0, 0.0]),
        "about": {"kind": "overlap", "common": 100.0, "sensors": ["tls", "depth"], "rooms": "labelled"},
    }
    return EvaluationPair(**(fields | changes))


def test_matches_are_counted_by_hand() -> None:
    rooms = np.array([(0, 1), (1, 0), (2, 0), (3, 3), (4, 2)])  # right, right, right piece of the same room, wrong, wrong
    counts = count_matches(hand_made_pair(), rooms)
    assert (counts["predicted"], counts["right"], counts["units"], counts["found"]) == (5, 3, 3, 2)
    assert (counts["predicted_twin"], counts["right_twin"], counts["units_twin"], counts["found_twin"]) == (1, 0, 1, 0)
    assert (counts["predicted_single"], counts["right_single"], counts["units_single"], counts["found_single"]) == (4, 3, 2, 2)
    assert (counts["strict_right"], counts["strict_units"]) == (2, 3)


def test_no_match_at_all() -> None:
    counts = count_matches(hand_made_pair(), np.zeros((0, 2), int))
    assert (counts["predicted"], counts["right"], counts["units"], counts["found"]) == (0, 0, 3, 0)
    unmatched_pair = hand_made_pair(matches=np.zeros((0, 2), int))
    counts = count_matches(unmatched_pair, np.array([(0, 0)]))
    assert (counts["predicted"], counts["right"], counts["units"], counts["found"], counts["pairs"]) == (1, 0, 0, 0, 1)


def test_ranks_by_hand() -> None:
    cost = np.array([[0.5, 0.1, 0.3], [0.2, 0.2, 0.9]])
    rooms, rank = rank_partners(cost, np.array([(0, 2), (1, 0)]))
    assert rooms.tolist() == [0, 1]
    assert rank.tolist() == [2, 2]  # 0.1 is cheaper than 0.3; the other 0.2 costs as much, and counts before
    assert rank_partners(cost, np.array([(0, 2), (0, 1)]))[1].tolist() == [1]  # the better of two partners


def test_rank_counts_of_both_directions() -> None:
    cost = np.ones((5, 4))
    cost[[0, 1, 2], [1, 0, 0]] = 0.0  # right and cheap
    cost[3, 2] = 2.0  # right but dear
    counts = count_ranks(hand_made_pair(), cost)
    assert counts["queries"] == 4 + 3
    assert counts["chance"] == pytest.approx(4 / 4 + 4 / 5)  # four pairs of rooms, among four of b, and among five of a
    assert counts["first"] == 3 + 2  # rooms 0, 1 and 2 of a; rooms 0 and 1 of b
    assert counts["five"] == 7
    assert counts["reciprocal"] == pytest.approx(3 + 2 + 1 / 4 + 1 / 5)
    assert counts["queries_twin"] == 1 and counts["first_twin"] == 0
    assert counts["queries_glimpsed"] == counts["queries"] - 4 and counts["first_glimpsed"] == counts["first"] - 2
    assert (counts["queries_whole"], counts["first_whole"]) == (4, 2)  # rooms 0 and 3 of a, 1 and 2 of b, both entered


def test_ranks_after_consensus() -> None:
    cost = np.ones((5, 4))
    cost[0, 3] = 0.5  # the descriptor prefers the wrong room to room 0's partner
    agreed = np.array([(0, 1), (3, 3)])  # right, wrong
    counts = count_ranks_after(hand_made_pair(), cost, agreed)
    assert count_ranks(hand_made_pair(), cost)["first"] == 0
    assert counts == {"first_after": 2, "first_single_after": 2, "five_after": 7}  # room 0 of a, room 1 of b, both without twin
    assert all(np.isnan(v) for v in count_ranks_after(hand_made_pair(), cost, None).values()) and cost.min() == 0.5


def test_poses() -> None:
    truth = Sim3(0.3, (1.0, 2.0, 0.0))
    off = Sim3(0.3, (1.3, 2.4, 0.6))
    assert measure_pose_error(off, truth, np.array([5.0, 0.0, 0.0])) == pytest.approx((0.5, 0.6, 0.0))
    assert measure_pose_error(Sim3(0.3 - 2 * np.pi + 0.1), Sim3(0.3), np.zeros(3))[2] == pytest.approx(np.degrees(0.1))
    assert is_within((0.3, 0.3, 4.9), False, (0.5, 5.0))
    assert not is_within((0.3, 0.45, 1.0), False, (0.5, 5.0)) and is_within((0.3, 0.45, 1.0), True, (0.5, 5.0))
    assert not is_within((0.1, 0.0, 5.1), False, (0.5, 5.0))
    assert not is_within((0.1, 3.1, 1.0), True, (0.5, 5.0))


def verdict(pose: Sim3 | None, believed: bool) -> dict[str, Any]:
    matrix = None if pose is None else pose.matrix.tolist()
    return {"pose": matrix, "believed": believed, "probability": 0.9, "seconds": 1.0, "rooms": [[0, 1]], "chance": [0.8]}


@pytest.mark.parametrize(
    ("pose", "believed", "expected"),
    [
        (Sim3(0.3, (1.0, 2.0, 0.0)), True, {"near": 1, "fine": 1, "merged": 1, "false": 0, "refused": 0}),
        (Sim3(0.3, (1.3, 2.0, 0.0)), False, {"near": 1, "fine": 0, "merged": 0, "false": 0, "refused": 1}),
        (Sim3(1.3, (1.0, 2.0, 0.0)), True, {"near": 0, "fine": 0, "merged": 0, "false": 1, "refused": 0}),
        (None, False, {"near": 0, "fine": 0, "merged": 0, "false": 0, "refused": 0}),
    ],
)
def test_merges(pose: Sim3 | None, believed: bool, expected: dict[str, int]) -> None:
    counts = count_merges(hand_made_pair(), verdict(pose, believed))
    assert {k: counts[k] for k in expected} == expected and counts["mergeable"] == 1
    assert counts["good"] == [True]


def test_a_merge_in_rooms() -> None:
    """The pose of the second row is 0.3 m off in each room; that of the first is right in the near one and not in the far one."""
    near, far = np.array([(5.0, 0.0, 0.0), (5.5, 0.5, 0.0)]), np.array([(90.0, 0.0, 0.0), (100.0, 0.0, 0.0)])
    turned = Sim3(0.3 + np.radians(0.5), (1.0, 2.0, 0.0))  # 5 cm at 5.5 m, 0.87 m at 100 m
    counts = count_merges(hand_made_pair(), verdict(turned, True), [near, far])
    assert (counts["with_rooms"], counts["every_room"], counts["rooms_shared"], counts["rooms_near"]) == (1, 0, 2, 1)
    assert counts["farthest_room"] == pytest.approx(2 * 100 * np.sin(np.radians(0.25))) and counts["fine"] == 1
    moved = count_merges(hand_made_pair(), verdict(Sim3(0.3, (1.3, 2.0, 0.0)), True), [near, far])
    assert (moved["every_room"], moved["rooms_near"]) == (0, 0) and moved["farthest_room"] == pytest.approx(0.3)
    assert count_merges(hand_made_pair(), verdict(turned, True), [near])["every_room"] == 1
    about = {**hand_made_pair().about, "sensors": ["laser2d", "tls"]}
    for storey, right in ((0.4, 1), (3.0, 0)):  # a slice tells no height within its storey
        raised = count_merges(hand_made_pair(about=about), verdict(Sim3(0.3, (1.0, 2.0, storey)), True), [near])
        assert (raised["near"], raised["every_room"], raised["false"]) == (right, right, 1 - right)
    none = count_merges(hand_made_pair(), verdict(None, False), [near, far])
    assert (none["with_rooms"], none["every_room"], none["rooms_near"]) == (1, 0, 0)
    assert count_merges(hand_made_pair(), verdict(turned, True))["with_rooms"] == 0


def test_whatever_is_believed_of_two_places_is_false() -> None:
    hard = hand_made_pair(about={"kind": "other-storey", "common": 0.0, "sensors": ["tls", "tls"], "rooms": "labelled"})
    counts = count_merges(hard, verdict(Sim3(0.3, (1.0, 2.0, 0.0)), True))
    assert (counts["mergeable"], counts["near"], counts["false"]) == (0, 0, 1)


def test_kinds_of_maps() -> None:
    assert classify_modality(["tls", "depth"]) == classify_modality(["model", "tls"]) == "3D scans"
    assert classify_modality(["laser2d", "tls"]) == classify_modality(["phone", "phone"]) == "with a slice"
    assert classify_modality(["laser2d", "drawing"]) == classify_modality(["phone", "drawing"]) == "with a floor plan"


def test_bins() -> None:
    assert [classify_overlap(v) for v in (0.0, 0.1, 0.3, 0.5, 1.0)] == ["0", "0.1", "0.25", "0.5", "0.75"]
    assert classify_overlap(0.0, "twin-wing") == "twin-wing"


ROWS = [
    {"building": "a", "pair": "1", "right": 3, "predicted": 4, "found": 3, "units": 6, "first": 1, "queries": 2},
    {"building": "a", "pair": "2", "right": 1, "predicted": 4, "found": 1, "units": 2, "first": 1, "queries": 2},
    {"building": "b", "pair": "3", "right": 0, "predicted": 0, "found": 0, "units": 4, "first": 0, "queries": 4},
]


def test_ratios_are_of_sums() -> None:
    assert compute_value(ROWS, "precision").value == 4 / 8
    assert compute_value(ROWS, "recall").value == 4 / 12
    assert compute_value(ROWS, "F1").value == pytest.approx(2 * (1 / 2) * (1 / 3) / (1 / 2 + 1 / 3))
    assert compute_value(ROWS, "recall@1").value == 2 / 8
    assert (compute_value(ROWS, "recall").pairs, compute_value(ROWS, "recall").buildings) == (3, 2)
    assert np.isnan(compute_value(ROWS[2:], "precision").value) and np.isnan(compute_value([], "F1").value)


def test_the_interval_draws_whole_buildings() -> None:
    many = [{"building": str(i), "pair": str(i), "first": i % 2, "queries": 1} for i in range(400)]
    wide = compute_value(many, "recall@1", 2000)
    assert wide.high - wide.low == pytest.approx(2 * 1.96 * np.sqrt(0.25 / 400), rel=0.1) and not wide.ranged
    assert draw_buildings(3, 50).sum(axis=1).tolist() == [3] * 50
    twice = compute_value([*many, *many], "recall@1", 2000)  # more pairs of the same buildings tell nothing more
    assert (twice.low, twice.high, twice.pairs, twice.buildings) == (wide.low, wide.high, 400, 400)


def test_few_buildings_have_a_range_and_no_interval() -> None:
    recall = compute_value(ROWS, "recall@1")
    assert (recall.low, recall.high, recall.ranged) == (0.0, 0.5, True)  # building b, building a
    assert format_value(recall) == "0.25, 0.00–0.50 (2 buildings)" and format_value(recall, False) == "0.25"
    one = compute_value(ROWS[:2], "recall@1")
    assert one.low == one.high == one.value and format_value(one) == "0.50"
    empty = [{"building": str(i), "pair": f"e{i}", "first": 0, "queries": 0} for i in range(20)]
    with_empty = compute_value([*ROWS, *empty], "recall@1")  # buildings without a query say nothing of it
    assert (with_empty.low, with_empty.high, with_empty.counted, with_empty.buildings) == (0.0, 0.5, 2, 22)
    eight = [{"building": str(i), "pair": str(i), "first": 1, "queries": 1} for i in range(8)]
    assert format_value(compute_value(eight, "recall@1")) == "1.00 [1.00, 1.00]" and "(7 buildings)" in format_value(
        compute_value(eight[:7], "recall@1")
    )


def test_a_gain_is_paired() -> None:
    better = [{**r, "first": r["first"] + 1} for r in ROWS]
    recall_gain = compute_gain(better, ROWS, "recall@1", 500)
    assert recall_gain.value == 3 / 8 and (recall_gain.low, recall_gain.high) == (0.25, 0.5)  # 1 of 4 more, 2 of 4 more
    assert compute_gain(ROWS, ROWS, "recall@1", 500).high == 0
    many = [{"building": str(i), "pair": str(i), "first": i % 2, "queries": 2} for i in range(40)]
    more = compute_gain([{**r, "first": r["first"] + 1} for r in many], many, "recall@1", 500)
    assert (more.value, more.low, more.high) == pytest.approx(
        (0.5, 0.5, 0.5)
    )  # drawn alike, so that what differs between buildings goes


def test_wrong_merges_by_building() -> None:
    rows = [{"building": str(i // 2), "false": int(i in (0, 1))} for i in range(20)]  # two in one building
    hit, buildings, low, high = count_hit_buildings(rows, "false")
    assert (hit, buildings) == (1, 10)
    assert (low, high) == pytest.approx((0.00253, 0.44502), abs=1e-4)  # Clopper & Pearson of 1 in 10


def test_twins() -> None:
    def room(x: float, wide: float, deep: float) -> TrueRoom:
        return TrueRoom("", np.array([(x, 0), (x + wide, 0), (x + wide, deep), (x, deep)]), 0.0, 2.5)

    rooms = (room(0, 3, 4), room(5, 4, 3.02), room(10, 3, 5))  # the second is the first, turned
    assert find_twins(np.array([0, 1, 2, -1]), np.array([0, 1, 2]), rooms, rooms).tolist() == [True, True, False, False]
    assert find_twins(np.array([0, 2]), np.array([0, 2]), rooms, rooms).tolist() == [False, False]  # b does not hold room 1
    assert find_twins(np.array([0]), np.array([0]), rooms, rooms, same=False).tolist() == [True]  # another building


def test_mutual_matches() -> None:
    class Learned:
        def compute_probabilities(self, a: object, b: object) -> tuple[np.ndarray, np.ndarray]:
            rows = np.array([[0.9, 0.05, 0.05], [0.6, 0.3, 0.1], [0.1, 0.2, 0.7]])  # of 3 rooms of a: two rooms of b, none
            columns = np.array([[0.7, 0.2, 0.05, 0.05], [0.1, 0.5, 0.1, 0.3]])  # of 2 rooms of b: three rooms of a, none
            return rows, columns

    maps: Any = (None, None)
    rooms, probability = match_mutually(Learned(), maps)
    assert rooms.tolist() == [[0, 0]]  # room 1 of a likes room 0 best, which likes room 0; room 2 has no partner
    assert probability == pytest.approx([np.sqrt(0.9 * 0.7)])
    with pytest.raises(InputError, match="mutual needs"):
        match_mutually(object(), maps)
