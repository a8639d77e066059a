"""Tables of merges of a handful of pairs, cell by cell."""

from __future__ import annotations

from typing import Any

import pytest

from topomerge.evaluation.merge_report import (
    select_last_variant,
    tabulate_descriptor_effect,
    tabulate_independence,
    tabulate_merging,
    tabulate_reliability,
    tabulate_sites,
)
from topomerge.evaluation.settings import Evaluation

SETTINGS = Evaluation(rounds=50)


def merge_row(pair: str, site: str, captures: tuple[str, str] = ("1", "2"), **changes: Any) -> dict[str, Any]:
    """A row of a pair that is merged right, to a decimetre, in every one of its two rooms."""
    row = {
        "pair": pair, "variant": "walls alone", "building": site, "capture_a": captures[0], "capture_b": captures[1],
        "independent": captures[0] != captures[1], "origin": "real maps", "large": True, "area": ">200", "mergeable": 1,
        "near": 1, "fine": 1, "believed": 1, "merged": 1, "merged_fine": 1, "false": 0, "refused": 0, "with_rooms": 1,
        "every_room": 1, "rooms_shared": 2, "rooms_near": 2, "probability": 0.9, "seconds": 1.0, "chance": [], "good": [],
        "place": [1.0, 2.0, 0.0, 179.9],
    }  # fmt: skip
    return row | changes


REFUSED = {"believed": 0, "merged": 0, "merged_fine": 0, "refused": 1, "probability": 0.4}
WRONG = {"near": 0, "fine": 0, "merged": 0, "merged_fine": 0, "false": 1, "every_room": 0, "rooms_near": 0}
ROWS = [
    merge_row("p", "flat", ("walk 1", "walk 2")),
    merge_row("q", "flat", ("walk 1", "drawing"), fine=0, merged_fine=0, every_room=0, rooms_near=1),
    merge_row("r", "hall", ("log", "log"), **REFUSED),
    merge_row("s", "hall", ("log", "other log"), **WRONG),
]


def test_sites_in_numbers_of_pairs() -> None:
    table = tabulate_sites(ROWS)
    assert table.head[:4] == ["site", "the two maps are", "captures", "pairs"]
    assert [list(row) for row in table.rows] == [
        ["flat", "two captures", "3", "2", "2", "1", "1", "2", "0", "0"],
        ["hall", "two captures", "2", "1", "0", "0", "0", "0", "1", "0"],
        ["hall", "parts or copies of one capture", "1", "1", "1", "1", "1", "0", "0", "1"],
    ]


def test_independence_over_sites() -> None:
    table = tabulate_independence(ROWS, SETTINGS)
    cells = {row[0]: dict(zip(table.head, row, strict=True)) for row in table.rows}
    independent = cells["two captures"]
    assert (independent["pairs"], independent["sites"]) == ("3", "2")
    assert (
        independent["merged right"] == "0.67, 0.00–1.00 (2 buildings)" and independent["merged right, mean over sites"] == "0.50"
    )
    assert (independent["sites with a merge"], independent["sites with all merged"]) == ("1 of 2", "1 of 2")
    assert independent["merged wrongly"] == "1; 1 of 2 buildings [1.3, 98.7] %"
    assert independent["rooms within 0.1 m"] == "0.50"  # 2 + 1 + 0 of 6
    assert cells["parts or copies of one capture"]["merged right"] == "0.00" and cells["all"]["pairs"] == "4"


def test_what_decides() -> None:
    learned = [{**r, "variant": "learned"} for r in ROWS]
    learned[0]["place"] = [1.02, 2.0, 0.0, -179.9]  # 2 cm and 0.2 degrees: the same
    learned[1]["place"] = [1.0, 3.0, 0.0, 179.9]
    learned[2] |= {"believed": 1, "merged": 1, "refused": 0, "probability": 0.85}
    again = [{**r, "variant": "again"} for r in learned]
    table = tabulate_descriptor_effect([*ROWS, *learned, *again])
    assert [list(row) for row in table.rows] == [
        ["walls alone", "learned", "4", "3", "3", "1.000", "0.450"],
        ["walls alone", "again", "4", "3", "3", "1.000", "0.450"],
        ["learned", "again", "4", "4", "4", "0.000", "0.000"],
    ]
    without = tabulate_descriptor_effect([*ROWS, *({**r, "variant": "none", "place": []} for r in ROWS)])
    assert without.rows[0][4:6] == ["0", "inf"]
    assert {r["variant"] for r in select_last_variant([*ROWS, *learned])} == {"learned"} and select_last_variant([]) == []


def test_ways_that_merge_alike_share_their_rows() -> None:
    alike = [{**r, "variant": "learned", "seconds": 3.0} for r in ROWS]
    other = [{**r, "variant": "shape", **REFUSED} for r in ROWS]
    table = tabulate_merging([*ROWS, *alike, *other], "", SETTINGS)
    assert [row[0] for row in table.rows] == ["walls alone = learned", "shape"]
    assert table.rows[0][-1] == "3.0"


def test_calibration_by_origin() -> None:
    plans = [{**r, "origin": "procedural", "probability": p} for r in ROWS for p in (0.0, 0.75)]
    table = tabulate_reliability([], [*ROWS, *plans])
    rows = {row[1]: row[2:] for row in table.rows}
    assert list(rows) == ["procedural", "real maps"]
    assert rows["real maps"][:4] == ["4", "0.78", "0.75", "0.325"]  # .9 against 2 of 3, .4 against 1 of 1
    assert rows["procedural"][:4] == ["8", "0.38", "0.75", "0.375"]
    assert rows["procedural"][5:9] == ["4", "0.75", "0.75", "0.000"]


@pytest.mark.parametrize(
    "table",
    [tabulate_sites([]), tabulate_descriptor_effect([]), tabulate_reliability([], []), tabulate_merging([], "", SETTINGS)],
)
def test_no_merge_at_all(table: Any) -> None:
    assert table.rows == []
