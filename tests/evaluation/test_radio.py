"""Tables of radio: what is aimed at, and how well what storeys that were left out are told is calibrated."""

from __future__ import annotations

from topomerge.evaluation.radio import tabulate_aims, tabulate_left_out

ROWS = [
    {"storey": "F1", "walks": 0, "trials": [[1.0, 0.99, 1.0, True, 1.0], [2.0, 0.99, 1.0, True, 2.0]], "ranked": {"all scans": 2},
     "verdicts": {"elsewhere": [[-40.0, 0.0], [40.0, 1.0]], "storey": [[0.0, 1.0], [0.0, 0.0]]}},
    {"storey": "F1", "walks": 15,
     "trials": [[3.0, 0.95, 1.5, True, 3.0], [6.0, 0.97, 2.0, True, 6.0], [9.0, 0.2, 4.0, False, 9.0]]},
    {"storey": "F1", "walks": 5, "trials": [[20.0, 0.1, 9.0, False, 4.0]]},
]  # fmt: skip


def test_aims_count_what_is_wrong_and_told_as_sure():
    half, few, fewest = tabulate_aims(ROWS).splitlines()[2:]
    assert half == "| half of all | 2 | 1.50 | 1.50 to 1.50 | 2.0 | 0 | 2 | 0 | 2 of 2 | 15.8 to 100.0 % |"
    assert few == "| 15 | 3 | 6.00 | 6.00 to 6.00 | 9.0 | 2 | 2 | 1 | – | – |"
    assert fewest.endswith("| 1 | 0 | 0 | – | – |")


def test_storeys_left_out_are_told_with_what_was():
    (line,) = tabulate_left_out(ROWS).splitlines()[2:]
    assert line.split(" | ")[:5] == ["| F1", "4", "0.347", "0.50", "0.50"]  # two sure ones right, two of which nothing was told
    assert line.split(" | ")[5:8] == ["0.99", "1.00", "1.58"] and "0.33" in line
