"""Scans against drawn plans: where the page lies, and what counts as right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.scenes_map import building
from topomerge.evaluation import drawn_merges
from topomerge.evaluation.tasks import Data, TaskSettings
from topomerge.types import Sim3


def test_a_pose_is_right_by_the_middle_and_sized_by_its_scale() -> None:
    map, truth = building(1, 2), Sim3(0.3, (2.0, 1.0, 0.0), 1.25)
    middle = drawn_merges.compute_anchor(type("Truth", (), {"truth": truth}), (map, map))
    assert drawn_merges.judge_pose(truth, truth, map, map) == {"right": True, "sized": True, "err": [0.0, 0.0, 0.0], "size": 1.0}
    larger = Sim3(0.3, (0.0, 0.0, 0.0), 1.1 * 1.25)
    x, y, _ = (truth.apply(middle[None]) - larger.apply(middle[None]))[0].tolist()
    about = drawn_merges.judge_pose(Sim3(0.3, (x, y, 0.0), 1.1 * 1.25), truth, map, map)
    assert about["right"] and not about["sized"] and about["size"] == pytest.approx(1.1)
    assert not drawn_merges.judge_pose(Sim3(0.3, (2.0, 1.6, 0.0), 1.25), truth, map, map)["right"]
    assert not drawn_merges.judge_pose(Sim3(0.3 + np.pi, (2.0, 1.0, 0.0), 1.25), truth, map, map)["right"]
    assert not drawn_merges.judge_pose(None, truth, map, map)["right"]


@pytest.mark.data
@pytest.mark.longer
def test_rooms_of_a_page_and_of_a_scan_lie_where_the_plan_has_them(tmp_path: Path, data_dir: Path) -> None:
    page = drawn_merges.list_drawn(TaskSettings(Data("dev", 12), cache=str(tmp_path)))[2]
    drawn = drawn_merges.read_drawn_map(page)
    scan, frame = drawn_merges.simulate_scan(page, 0)
    assert drawn.map is not None
    true = np.array([room.polygon.mean(axis=0) for room in page.shapes.rooms])
    for map, pose in ((drawn.map, drawn.frame), (scan, frame)):
        cells = map.navigable.compute_centroids()
        middles = [pose.inverse().apply(cells[map.navigable_room == k].mean(axis=0)[None])[0, :2] for k in range(len(map.rooms))]
        apart = np.linalg.norm(np.array(middles)[:, None] - true, axis=2).min(axis=1)
        assert np.median(apart) < 0.6


def test_pages_that_are_not_read_and_merges_that_are_not_right_are_named() -> None:
    row = {
        "name": "a",
        "whole": True,
        "scale_read": True,
        "right": True,
        "sized": True,
        "size": 1.0,
        "believed": True,
        "place": "a",
    }
    row |= {"other_believed": False, "probability": 0.9, "sensor": "tls"}
    rows = [
        row,
        row | {"name": "b", "place": "b", "right": False, "whole": False},
        {"name": "c", "place": "c", "refused": "no walls"},
    ]
    table = drawn_merges.tabulate(rows, TaskSettings())["drawn-merges"]
    assert "Not read: 1 of 3\n- c: no walls" in table and "- b (tls): 0.90, wrong" in table and "- a" not in table
    assert [line.split(" | ")[1] for line in table.splitlines() if line.startswith(("| whole", "| parts", "| all"))] == [
        "1",
        "1",
        "2",
    ]
