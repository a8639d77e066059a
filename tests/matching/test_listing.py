"""What `topomerge match` prints and writes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes_map import building
from topomerge.embedding.quarter_turns import YawProbability
from topomerge.matching.match import Matching, format_matching, serialise_matching
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3

POSE = Sim3(np.pi / 2, (1.0, -2.0, 0.5), 1.25)
BEST = PoseHypothesis(POSE, 7.12345, 0.87654, {"agree_m": 3.0}, True, np.array([[0, 2], [3, 1]]), np.array([0.9, 0.8]))
MATCHING = Matching(np.array([[0, 2], [3, 1]]), np.array([0.91239, 0.5]), POSE, (BEST,) * 7, {"rooms_a": 5.0})


def test_the_listing_holds_rooms_probabilities_and_transforms():
    listing = serialise_matching(MATCHING, building(2), building(1))
    assert [m["rooms"] for m in listing["maps"]] == [5, 3] and listing["statistics"] == {"rooms_a": 5.0}
    assert listing["matches"] == [{"rooms": [0, 2], "probability": 0.9124}, {"rooms": [3, 1], "probability": 0.5}]
    first = listing["hypotheses"][0]
    assert (first["probability"], first["score"], first["rooms"]) == (0.8765, 7.123, [[0, 2], [3, 1]])
    rows = [[0, -1.25, 0, 1], [1.25, 0, 0, -2], [0, 0, 1.25, 0.5], [0, 0, 0, 1]]
    assert first["transform"]["matrix"] == pytest.approx(np.array(rows))


def test_the_table_names_matches_and_the_first_hypotheses():
    lines = format_matching(MATCHING, building(2), building(1)).splitlines()
    assert lines[0] == "2 matches of 5 and 3 rooms"
    assert lines[3].split() == ["0", "20.0", "2", "7.2", "0.91"] and lines[4].split() == ["3", "20.0", "1", "20.0", "0.50"]
    assert lines[7].split() == ["0", "0.88", "2", "90.0", "1.00", "-2.00", "0.50", "1.250"]
    assert len(lines) == 12  # five of seven hypotheses
    assert format_matching(Matching(), building(2), building(1)) == "0 matches of 5 and 3 rooms"


@pytest.mark.parametrize(
    ("shares", "line"),
    [
        ([(np.pi, 0.5), (0.0, 0.48), (1.0, 0.02)], "two turns fit (0 and 180 degrees)"),
        ([(k * np.pi / 2 - np.pi / 2, 0.25) for k in range(4)], "four turns fit (-90, 0, 90 and 180 degrees)"),
        ([(np.radians(-72.3), 0.65), (np.radians(-144.0), 0.3), (0.0, 0.05)], "two turns fit (-144 and -72 degrees)"),
        ([(0.5, 0.95), (2.0, 0.05)], None),
    ],
)
def test_turns_that_fit_are_named_where_it_is_more_than_one(shares, line):
    matching = replace(MATCHING, turns=tuple(YawProbability(*share) for share in shares))
    last = format_matching(matching, building(2), building(1)).splitlines()[-1]
    assert last == line or (line is None and "fit" not in last)
    listed = serialise_matching(matching, building(2), building(1))["turns"]
    assert [turn["probability"] for turn in listed] == [p for _, p in shares] and listed[0]["yaw"] == shares[0][0]
