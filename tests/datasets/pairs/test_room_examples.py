"""Rooms of simulated scans as examples, and scans of buildings that stand in the open."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from topomerge.datasets.buildings.outdoors import add_outdoors, compute_footprint
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.pairs.flat_maps import GRID_CELL, count_rays, simulate_robot_grid
from topomerge.datasets.pairs.plan_examples import PlanRecipe, draw_item
from topomerge.datasets.simulation.sensors import get_sensor

from topomerge.training import room_odds
from topomerge.training.room_odds import ANSWERS, build_rooms, draw_room_item, simulate_open_scan
from topomerge.training.settings import TaskSettings
from topomerge.types import Sim3


def test_files_are_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def rows(item, plan):
        made.append(item.name)
        return {"x": np.zeros((2, 3)), "about": np.frombuffer(b"{}", np.uint8), **dict.fromkeys(ANSWERS, np.ones(2))}

    monkeypatch.setattr(room_odds, "build_room_rows", rows)
    recipe, sharing = PlanRecipe("room_scans", scans=3, seed=5), TaskSettings(cache=str(tmp_path))
    paths = build_rooms(recipe, sharing)
    assert [path.stem for path in paths] == made and len(made) == 3
    assert build_rooms(recipe, sharing) == paths and len(made) == 3
    assert not {draw_room_item(n, {}).name for n in range(9)} & {draw_item(n, {}).name for n in range(9)}


def test_a_ray_that_met_nothing_is_free_to_its_end() -> None:
    ends = np.array([[3.01, 0.01], [0.01, 3.01]])
    occupied, free, corner = count_rays(np.zeros((2, 2)), ends, np.array([True, False]))
    at = np.floor((ends - corner) / GRID_CELL).astype(int)
    assert occupied[at[0, 1], at[0, 0]] and not occupied[at[1, 1], at[1, 0]] and occupied.sum() == 1
    assert free[at[1, 1] - 1, at[1, 0]]


@pytest.mark.longer
def test_a_robot_draws_nothing_beyond_what_it_believes() -> None:
    house = add_outdoors(make_building("house", 11), np.random.default_rng(1))
    laser = replace(get_sensor("laser2d"), height=1.1, reach=(0.1, 40.0))
    some = np.arange(3)
    grids = (simulate_robot_grid(house, laser, some, np.random.default_rng(0), Sim3(), c).points for c in (np.inf, 3.0, 5.0))
    far, *others = grids
    for near in others:
        assert np.ptp(near[:, :2], axis=0).max() < np.ptp(far[:, :2], axis=0).max()
        walls = near[near[:, 2] > 1.0]
        assert len(walls) and len(walls) < (far[:, 2] > 1.0).sum()


@pytest.mark.longer
def test_a_surveyor_who_steps_out_sees_the_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room_odds, "STEPPED_OUT", 1.0)
    monkeypatch.setattr(room_odds, "OPEN_SHARE", 1.0)
    made = simulate_open_scan(draw_room_item(3, {}, surroundings=True), None)
    out = ~shapely.contains_xy(compute_footprint(made.building), made.cloud.poses[:, :2, 3])
    assert out.any() and not out.all()
    places = made.cloud.poses[out][:, :2, 3]
    points = made.cloud.points[np.isin(made.cloud.pose_of, np.flatnonzero(out))]
    away = np.hypot(*(points[:, None, :2] - places[None]).transpose(2, 0, 1)).min(axis=1)
    assert (away < 8).any() and compute_footprint(made.building).area > 0
