"""What is told of changes is counted right: one to one, and what could not be seen neither for nor against."""

from __future__ import annotations

import numpy as np
import shapely
from topomerge.datasets.core.solids import build_rectangle
from topomerge.datasets.simulation.changed_sessions import TrueChange

from topomerge.evaluation.changes import GROUPS, draw_cases, score_kinds, shift_element, tabulate, write_ratio
from topomerge.evaluation.tasks import TaskSettings
from topomerge.io.ifc import ModelElement


def true(kind: str, x: float, seen: bool = True) -> TrueChange:
    return TrueChange(kind, (x, 0.0), build_rectangle((x - 0.5, 0.0), (x + 0.5, 0.0), 0.2), seen)


def told(kind: str, x: float) -> tuple[str, np.ndarray]:
    return kind, np.array([x, 0.3])


def test_each_true_change_is_found_once() -> None:
    real = [true("wall new", 0), true("wall new", 5), true("wall new", 10, seen=False), true("wall gone", 20)]
    said = [told("wall new", 0.2), told("wall new", 0.4), told("wall new", 10), told("wall new", 15), told("wall gone", 0)]
    assert score_kinds(said, real, ("wall new",)) == [1, 2, 1, 2]  # told twice of one, of one unseen, and one wrongly
    assert score_kinds(said, real, ("wall gone",)) == [0, 1, 0, 1]
    assert score_kinds([], real, ("wall new",)) == [0, 0, 0, 2] and score_kinds(said, [], ("wall new",)) == [0, 4, 0, 0]


def test_a_doorway_broken_through_is_a_new_door() -> None:
    assert score_kinds([told("door new", 0)], [true("door cut", 0)], ("door new",)) == [1, 1, 1, 1]


def test_cases_of_both_sets_are_of_other_seeds_and_a_third_is_unchanged() -> None:
    dev, test = (draw_cases(which) for which in (True, False))
    assert not {c.seed for c in dev if len(c.sensors) == 2} & {c.seed for c in test if len(c.sensors) == 2}
    pairs = [c for c in test if len(c.sensors) == 2]
    for sensors in {c.sensors for c in pairs}:
        same = [c for c in pairs if c.sensors == sensors and not c.changed]
        assert 2 <= len(same) <= 3, sensors
    assert len({c.name for c in test}) == len(test)


def test_tables_of_nothing_and_of_something() -> None:
    assert set(tabulate([], TaskSettings())) == {"changes", "changes-same", "changes-models"}
    groups = {name: [1, 2, 1, 1] for name in GROUPS}
    row = {"what": "changed", "aligned": True, "groups": groups, "place": "a", "sensors": "tls → tls"}
    assert "| walls new | 1 | 0.50 (1 building) | 1 of 2 |" in tabulate([row], TaskSettings())["changes"]
    assert write_ratio(np.array([0]), np.array([0]), [row]) == "–"
    model = {"what": "model", "aligned": False, "building": "m", "sensors": "tls", "states": ["seen"], "others": ["seen"]}
    model |= {"found": [[0.02, 0.021, "elsewhere"], [-0.05, 0.0, "seen"]]}
    assert "| m | tls | no: given | 1 of 1 | 0 of 1 | 0 of 0 |" in tabulate([model], TaskSettings())["changes-models"]


def test_elements_are_shifted() -> None:
    element = ModelElement("g", "wall", "", np.zeros((3, 3)), np.zeros((1, 3), np.int64))
    assert shift_element(element, np.array([0.05, 0, 0])).vertices[:, 0].tolist() == [0.05] * 3
    assert shapely.Polygon(true("wall new", 0).outline.exterior.coords).area > 0
