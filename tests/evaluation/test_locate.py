"""The measure of where scans were taken: what counts as right, and its table."""

from __future__ import annotations

import pytest

from tests.fusion.atlas.test_locate import SENSOR, index, scan_part
from topomerge.evaluation.locate import Settings, classify_outcome, find_true_room, list_inputs, measure_scan, tabulate
from topomerge.evaluation.tasks import Data
from topomerge.types import Sim3


@pytest.mark.longer
def test_a_scan_that_is_found_is_right_and_one_under_another_truth_is_wrong() -> None:
    row = measure_scan(index(), scan_part(), (0, Sim3()))
    assert classify_outcome(row) == "right" and row["pose"] and row["among"] and row["away"] < 0.3 and row["seconds"] > 0
    assert classify_outcome(measure_scan(index(), scan_part(), (0, Sim3(0.0, (9.0, 6.0, 0.0))))) == "wrong"
    stranger = measure_scan(index(), scan_part(), None)
    assert stranger["stranger"] and classify_outcome(stranger) == "wrong"
    assert find_true_room(index(), 0, SENSOR) >= 0 and find_true_room(index(), 0, SENSOR + 500.0) == -1


def test_the_table_counts_each_outcome() -> None:
    def scan(status: str, stranger: bool = False, **words: object) -> dict[str, object]:
        return {"kind": "sweep", "status": status, "stranger": stranger, "seconds": 0.5, "told": 1, **words}

    right = scan("located", room=True, pose=True, among=True)
    rows = [
        {"scans": [right, scan("located", room=False, pose=False, among=False), scan("ambiguous", among=True)]},
        {"scans": [right, scan("not here"), scan("not here", True), scan("located", True)]},
    ]
    (table,) = tabulate(rows, Settings()).values()
    lines = [[cell.strip() for cell in line.strip("| ").split("|")] for line in table.splitlines()[2:]]
    assert lines[0][:4] == ["sweep", "a map", "5", "0.40"] and lines[0][5] == "2 of 2" and lines[0][6] == "1"
    assert lines[0][8:11] == ["1 of 1", "1", "1"] and lines[1][:3] == ["sweep", "no map", "2"] and lines[1][6] == "1"


def test_buildings_by_which_the_threshold_was_chosen_are_not_judged() -> None:
    assert list_inputs(Settings(data=Data(set="test")))[0] == "building 24" and len(list_inputs(Settings())) == 24
    assert len(list_inputs(Settings(data=Data(set="captures", limit=3)))) == 3


def test_more_maps_are_tabulated_with_what_a_thousand_would_take() -> None:
    settings = Settings(data=Data(set="size"), sizes=[50, 100])
    names = list_inputs(settings)
    assert len(names) == 10 and names[0] == "building 24 of 50" and names[-1] == "building 28 of 100"

    def row(size: int) -> dict[str, object]:
        told = {"status": "located", "room": True, "seconds": size / 50, "stranger": False}
        return {"maps": size, "storeys": size, "scans": [told, {**told, "stranger": True, "status": "not here"}]}

    table = tabulate([row(50), row(100)], settings)["locate-size"]
    assert "| 50 | 50 | 1 | 1 | 0 | 1 | 0 | 1.00 | 1.00 |" in table
    assert "| 1,000, by a straight line | – | – | – | – | – | – | 20 | – |" in table
    assert "straight" not in tabulate([row(50), row(1000)], settings)["locate-size"]


def test_a_turn_and_a_drive_are_asked_for_in_the_buildings_of_the_test() -> None:
    assert list_inputs(Settings(data=Data(set="more", limit=2))) == ["building 24", "building 25"]
