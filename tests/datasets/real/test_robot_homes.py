"""The robots' own rooms as what is compared with: where they are, which touch, and maps that tell none apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from topomerge.datasets.core.building import find_physical_building
from topomerge.datasets.real.robot_homes import compute_home_truth
from topomerge.datasets.simulation.floor_truth import TRUTH_CELL, evaluate_map

import topomerge as tm
from tests.datasets.plans import plan_files as write
from topomerge.errors import InputError
from topomerge.io import read_points


def test_the_rooms_stand_where_the_map_is_read(tmp_path: Path) -> None:
    path = write.valetudo(tmp_path, 3)
    cloud = read_points(path)
    truth, rooms = compute_home_truth(path, cloud.points.astype(float))
    assert [r.name for r in rooms] == ["room 1", "room 2", "room 3"] and np.allclose(
        rooms[0].polygon.min(axis=0), (10, -8), atol=0.06
    )
    assert len(truth.visited) == 3 and truth.edges.tolist() == [[0, 1], [1, 2]] and len(truth.doors) == 2
    assert np.allclose((truth.raster == 0).sum() * TRUTH_CELL**2, 12, atol=0.5)
    assert np.allclose(truth.doors[0, 2:4], (14.05, -6.45), atol=0.06)  # in the robot's frame: x right, y up
    verdict = evaluate_map(tm.extract(cloud), truth)
    assert verdict.rooms.iou > 0.93 and verdict.rooms.precision == 1 and verdict.doors.recall == 1 and verdict.edges.recall == 1


def test_a_robot_that_tells_no_rooms_apart_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="tells 1 rooms apart"):
        compute_home_truth(write.valetudo(tmp_path, 1), np.zeros((1, 3)))


def test_maps_of_one_home_are_one_building() -> None:
    assert (
        find_physical_building("home", "1c_1096_a")
        == find_physical_building("home", "1c_1096_b")
        != find_physical_building("home", "d9_1058")
    )
