"""Plans of homes to learn from, by the robots' own rooms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from topomerge.datasets.pairs.drawing import TRUE_CLASSES
from topomerge.datasets.real.home_plans import HOME_EDGE, UNTOLD, classify_pixels, load_home_examples

from tests.datasets.plans import plan_files as write
from tests.training import tiny
from topomerge.errors import InputError
from topomerge.training.plan_segmentation import PlanJob, build_plan_tensors, load_homes
from topomerge.training.scan_settings import GridSegmentation, PlanLoss

INSIDE, WALL, DOORWAY, OUTSIDE = (TRUE_CLASSES.index(name) for name in ("inside", "wall", "doorway", "outside"))


def test_columns_are_doorways_where_rooms_touch(tmp_path: Path) -> None:
    (example,) = load_home_examples(write.valetudo(tmp_path, 3))
    assert example.visited.tolist() == [0, 1, 2] and example.source == "home/home"
    assert [round((example.room == k).sum() * HOME_EDGE**2) for k in range(3)] == [12, 12, 12]
    at = np.argwhere(example.truth == DOORWAY) * HOME_EDGE + example.plan.origin + HOME_EDGE / 2
    for door in ((14.1, -6.45), (18.2, -6.45)):  # in the robot's frame: x right, y up
        near = np.abs(at - door).max(axis=1) < 0.6
        assert np.allclose(at[near].mean(axis=0), door, atol=0.07) and np.allclose(
            np.ptp(at[near], axis=0), (0.2, 0.9), atol=0.11
        )
        at = at[~near]
    assert not len(at)
    assert (example.truth[example.plan.wall] == WALL).mean() > 0.9 and (example.truth[example.room >= 0] == INSIDE).mean() > 0.9


def test_nothing_is_told_of_cuts_through_open_floor() -> None:
    rooms = np.zeros((60, 80), np.int32)
    rooms[10:50, 10:40], rooms[10:50, 40:70] = 1, 2
    wide = classify_pixels(rooms, 0.05)  # 2 m
    assert set(np.unique(wide[15:45, 38:42])) == {UNTOLD} and (wide[15:45, 15:35] == INSIDE).all() and wide[0, 0] == OUTSIDE
    rooms[10:20, 38:42] = rooms[34:50, 38:42] = 0
    narrow = classify_pixels(rooms, 0.05)  # .7 m
    assert (narrow[20:34, 38:42] == DOORWAY).all() and not (narrow == UNTOLD).any() and (narrow[12:16, 38:42] == WALL).all()


def test_homes_have_their_share_of_the_crops(tmp_path: Path) -> None:
    write.valetudo(tmp_path, 3)
    (tmp_path / "list.json").write_text("[]")  # left out
    homes = load_homes([str(tmp_path)])
    settings = GridSegmentation(crop=32, batch=4, widths=[4] * 8, homes=["there"], home_share=0.25)
    job = PlanJob(settings, [tiny.two_rooms(0), tiny.two_rooms(6)], [tiny.two_rooms(2)], homes)
    assert job.probability.sum() == pytest.approx(1) and job.probability[2:] == pytest.approx([0.25]) and job.origin["homes"] == 1
    untold = homes[0].truth.copy()
    untold[:, :20] = UNTOLD
    _, truth, weight = build_plan_tensors(
        type(homes[0])(homes[0].plan, homes[0].room, untold, homes[0].visited, "home/x"), PlanLoss()
    )
    assert not weight[:, :20].any() and truth.max() < len(TRUE_CLASSES) and weight[:, 20:].any()


def test_homes_that_teach_nothing_are_refused(tmp_path: Path) -> None:
    one = write.valetudo(tmp_path, 1)
    with pytest.raises(InputError, match="tells 1 rooms apart"):
        load_homes([str(one)])
    with pytest.raises(InputError, match="holds no robot's map with two rooms"):
        load_homes([str(tmp_path)])
    (tmp_path / "list.json").write_text("[]")
    with pytest.raises(InputError, match="is no map of Valetudo"):
        load_homes([str(tmp_path / "list.json")])
    with pytest.raises(InputError, match="home_share must be above 0"):
        GridSegmentation(home_share=1.0).check()
