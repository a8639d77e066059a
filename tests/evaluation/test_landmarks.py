"""The table of look-alikes with signs: what counts as wrong and as right."""

import numpy as np

from topomerge.evaluation.landmarks import (
    READ_ALONE,
    READINGS,
    RELATIONS,
    Settings,
    list_inputs,
    measure,
    measure_building,
    tabulate,
)


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


def test_signs_alone_are_scored_and_tabulated(tmp_path):
    """One building: places of five relations by three readers; the same bytes again; a wrong ten to one is counted."""
    settings = Settings(cache=str(tmp_path))
    settings.data.set, settings.data.limit = "signs", 1
    assert list_inputs(settings) == ["signs 0"]
    rows = measure(settings, lambda text: None)
    scored = rows[0]["scored"]
    assert len(scored) == 3 * 8 and {relation for _, relation, _ in scored} == {"", *RELATIONS}
    assert measure_building(0, "test") == {"scored": scored} != measure_building(0, "train")
    assert np.mean([odds for _, relation, odds in scored if relation]) > np.mean([odds for _, r, odds in scored if not r])
    assert "nan" not in tabulate(rows, settings)["landmark-odds"]
    wrong = [[name, relation, -5.0 if relation else 5.0] for name in READ_ALONE for relation in ("",) * 4 + (*RELATIONS,)]
    table = tabulate([{"scored": wrong}], settings)["landmark-odds"]
    assert table.count("| 1 | " + " | ".join(["5.007", "1.000"] * 5)) == len(READ_ALONE)
