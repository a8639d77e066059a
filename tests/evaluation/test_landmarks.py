"""The table of look-alikes with signs: what counts as wrong and as right."""

from topomerge.evaluation.landmarks import READINGS, Settings, list_inputs, tabulate


def row(kind, again, reading, believed, right, landmarks):
    return {"kind": kind, "again": again, "reading": reading, "believed": believed, "right": right, "landmarks": landmarks}


def test_wrong_merges_and_believed_true_pairs_are_counted():
    none, signs = list(READINGS)[:2]
    rows = [
        row("storeys", False, none, True, False, [0, 0]),
        row("storeys", False, signs, False, False, [5, 4]),
        row("modules", False, none, True, False, [0, 0]),
        row("modules", False, signs, True, False, [3, 0]),
        row("storeys", True, none, False, True, [0, 0]),
        row("storeys", True, signs, True, True, [5, 4]),
    ]
    table = tabulate(rows, Settings())["landmarks"]
    assert f"| {none} | 2 | 2 | 15.8 to 100.0 % | 0 | 0 | 1 | 0 | 0 |" in table
    assert f"| {signs} | 2 | 1 | 1.3 to 98.7 % | 1 | 0 | 1 | 1 | 100 |" in table
    assert f"| storeys | {signs} | 1 | 0 |" in table and "tags" not in table


def test_inputs_are_the_items_of_the_split():
    few, more = (list_inputs(Settings(pairs=n, again=0)) for n in (1, 2))
    assert set(few) < set(more) and len(more) == 2 * len(few) == 14
