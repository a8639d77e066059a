"""Doors inside of what a plan took for one room: where they part it, and that nothing else is parted."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes import Scene
from topomerge.extraction.extract import extract
from topomerge.extraction.navigable import navigable_volume
from topomerge.extraction.parameters import PRESETS
from topomerge.extraction.plans.inner_doors import DOOR_LOG_ODDS, INNER_DOOR_DTYPE, inner_columns, inner_log_odds
from topomerge.extraction.plans.partition import pair_of
from topomerge.extraction.plans.passages import Passage
from topomerge.extraction.plans.plan import storey_plan
from topomerge.extraction.plans.plan_rooms import rooms_of_plans
from topomerge.extraction.plans.storey_rooms import OtherSigns
from topomerge.extraction.scan import read_scan
from topomerge.extraction.storeys import find_storeys, floor_to_ceiling
from topomerge.types import VoxelGrid


def door(x=3.0, y=2.0, normal=(1.0, 0.0), width=0.9, level=0.0):
    return np.array([((x, y, level), normal, width)], INNER_DOOR_DTYPE)


@pytest.fixture(scope="module")
def scanned():
    """One room of 6 x 4 m: its scan and its navigable volume."""
    return navigable_volume(read_scan(Scene().shell(0, 0, 6, 4).points(), 0.1), PRESETS["default"])


@pytest.fixture(scope="module")
def plan(scanned):
    scan, navigable = scanned
    _, storey = find_storeys(navigable, floor_to_ceiling(scan.grid, navigable, 1.75))
    return storey_plan(scan.grid, navigable, storey, 0)


def places(plan, columns):
    return plan.origin + (np.argwhere(columns) + 0.5) * plan.edge


@pytest.mark.parametrize("turn", [0.0, 0.4, 1.3])
def test_columns_lie_along_the_doorway(plan, turn):
    normal = (np.cos(turn), np.sin(turn))
    at = places(plan, inner_columns(plan, door(normal=normal))) - (3.0, 2.0)
    along = at @ (-normal[1], normal[0])
    assert np.abs(at @ normal).max() < 0.1 and along.min() == pytest.approx(-0.65, abs=0.1) == -along.max()
    assert len(at) >= 12


def test_a_door_of_another_storey_is_none(plan):
    assert not inner_columns(plan, door(level=3.0)).any() and not inner_columns(plan, door()[:0]).any()


def test_only_the_passage_in_the_doorway_is_a_door(plan):
    there = tuple(np.argwhere(inner_columns(plan, door()))[3].tolist())
    passages = {(0, 1): Passage(there, 0.9, (0.0, 1.0), ()), (0, 2): Passage((there[0] + 12, there[1]), 0.9, (0.0, 1.0), ())}
    assert inner_log_odds(plan, passages, door()) == {(0, 1): DOOR_LOG_ODDS, (0, 2): 0.0}


def rooms(scanned, doors):
    scan, navigable = scanned
    p = PRESETS["default"]
    return rooms_of_plans(scan.grid, navigable, p.door, p.narrow, p.standing_height, OtherSigns(doors=doors))


def test_a_wall_with_a_gap_as_wide_as_the_toilet_parts_two_rooms(scanned):
    scene = Scene().shell(0, 0, 6, 4).wall((5, 0), (5, 4)).wall((5, 1.1), (6, 1.1))
    points = scene.points()
    gap = (np.abs(points[:, 0] - 5) < 0.1) & (points[:, 1] > 0.05) & (points[:, 1] < 0.95) & (points[:, 2] < 2.4)
    narrow = navigable_volume(read_scan(points[~gap & (points[:, 2] > -0.5)], 0.1), PRESETS["default"])
    with_door = rooms(narrow, door(5.0, 0.5))
    number = set(np.unique(with_door.room)) - {-1}
    at = with_door.cells.centroids()[:, :2]
    toilet = with_door.room[(at[:, 0] > 5.2) & (at[:, 1] < 0.9)]
    hall = with_door.room[at[:, 0] < 4.8]
    assert len(number) >= 2 and len(set(toilet[toilet >= 0])) == 1 and set(toilet[toilet >= 0]).isdisjoint(hall)
    pair = pair_of(int(toilet.max()), int(np.bincount(hall[hall >= 0]).argmax()))
    assert with_door.door_probability[pair] > 0.9


def test_without_such_doors_nothing_changes(scanned):
    one, other = rooms(scanned, door()[:0]), rooms(scanned, door(level=9.0))
    assert np.array_equal(one.room, other.room) and len(set(one.room) - {-1}) == 1


def test_a_room_is_parted_once_more_where_walls_show_a_door(monkeypatch):
    seen = []

    def shown(map, walls, classes):
        seen.append(len(map.rooms))
        return door() if len(seen) == 1 else door()[:0]

    monkeypatch.setattr("topomerge.extraction.extract.doors_inside_rooms", shown)
    map = extract(Scene().shell(0, 0, 6, 4).box(1, 1, 0, 2, 1.8, 0.7).points())  # a bare one looks like a raised drawing
    assert seen == [1, 2] and len(map.rooms) == 2 and np.sort(map.rooms["area"]) == pytest.approx([12, 12], abs=1.5)


def test_a_grid_has_no_walls_to_ask(monkeypatch):
    monkeypatch.setattr("topomerge.extraction.extract.doors_inside_rooms", lambda *_: pytest.fail("asked"))
    cells = read_scan(Scene().shell(0, 0, 6, 4).points(), 0.1).grid.cells
    assert len(extract(VoxelGrid.from_cells(cells, np.zeros(3), 0.1)).rooms) == 1
