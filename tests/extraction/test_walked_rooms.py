"""Rooms that a sensor's way proves to be one: no door shows, the plan hardly parts them, and somebody walked across."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes import Scene
from topomerge.extraction.extract import extract, rooms_and_passages
from topomerge.extraction.floor import Floor
from topomerge.extraction.parameters import PRESETS
from topomerge.extraction.plans.partition import pair_of
from topomerge.extraction.scan import Scan
from topomerge.extraction.small_rooms import gathered
from topomerge.extraction.stopwatch import Stopwatch
from topomerge.extraction.topology import rooms_with_floor, topometric_map
from topomerge.extraction.walked_doors import ONLY_WALKED_CHANCE, WALKED_CHANCE, with_walked_doors
from topomerge.extraction.walked_rooms import walked_rooms
from topomerge.types import PointCloud, TopometricMap

WAY = np.column_stack([np.full(13, 3.0), np.linspace(1.0, 7.0, 13), np.full(13, 1.5)])


def passed_on_foot(cut: float, part: float = 10.0) -> tuple[Floor, TopometricMap, Scan]:
    """Two rooms that the plan network parts with this probability, of which nothing is known but that somebody went from the one
    into the other; the smaller one has so many m2."""
    scene = Scene().shell(0, 0, 6, 8).wall((0, 4), (2.2, 4)).wall((3.8, 4), (6, 4))
    scan, _, floor, map = rooms_and_passages(scene.points(), 0.1, PRESETS["default"], Stopwatch(None))
    assert len(map.rooms) == 2
    rooms = map.rooms.copy()
    rooms["area"] = (part, 20.0)
    walked, doubt = with_walked_doors(replace(map, rooms=rooms, edges=map.edges[:0]), WAY)
    assert not doubt and walked.edges["confidence"].tolist() == [ONLY_WALKED_CHANCE]
    return replace(floor, door_probability={pair_of(*rooms_with_floor(floor).tolist()): cut}), walked, scan


def test_two_rooms_that_the_plan_hardly_parts_are_one():
    floor, map, scan = passed_on_foot(0.6)
    group = walked_rooms(map, floor, {})
    assert group is not None and len(set(group[rooms_with_floor(floor)].tolist())) == 1
    one = topometric_map(scan.grid, gathered(floor, group), PRESETS["default"].standing_height)
    assert len(one.rooms) == 1 and not len(one.edges)
    assert one.rooms["area"].sum() == pytest.approx(48.0, rel=0.1)


def test_rooms_that_the_plan_parts_surely_stay_two():
    floor, map, _ = passed_on_foot(0.99)
    assert walked_rooms(map, floor, {}) is None
    assert walked_rooms(map, replace(floor, door_probability={}), {}) is None


def test_two_large_rooms_stay_two():
    floor, map, _ = passed_on_foot(0.6, part=15.0)
    assert walked_rooms(map, floor, {}) is None


@pytest.mark.parametrize(("likely", "one"), [(0.1, True), (0.4, False)])
def test_a_door_elsewhere_between_them_keeps_rooms_apart(likely: float, one: bool):
    floor, map, _ = passed_on_foot(0.6)
    assert (walked_rooms(map, floor, {(0, 1): likely}) is not None) == one


def test_a_door_that_was_seen_and_walked_through_keeps_rooms_apart():
    floor, map, _ = passed_on_foot(0.6)
    edges = map.edges.copy()
    edges["confidence"] = WALKED_CHANCE
    assert walked_rooms(replace(map, edges=edges), floor, {}) is None
    assert walked_rooms(replace(map, edges=edges[:0]), floor, {}) is None


def test_a_scan_whose_rooms_are_one_is_extracted_with_one(monkeypatch: pytest.MonkeyPatch):
    """The whole extraction, told that two rooms are one, gives one, with the doors and odds of that one."""
    scene = Scene().shell(0, 0, 6, 8).wall((0, 4), (6, 4), doors=(3.0,))
    scene.box(1.0, 1.0, 0.0, 1.6, 2.0, 0.8)
    poses = np.tile(np.eye(4), (len(WAY), 1, 1))
    poses[:, :3, 3] = WAY
    cloud = PointCloud(scene.points().astype(np.float32), poses=poses)
    assert len(extract(cloud).rooms) == 2
    calls = []

    def once(map: TopometricMap, floor: Floor, likeliest: object) -> np.ndarray | None:
        calls.append(len(map.rooms))
        return np.zeros(int(rooms_with_floor(floor).max()) + 1, int) if len(calls) == 1 else None

    monkeypatch.setattr("topomerge.extraction.extract.walked_rooms", once)
    map = extract(cloud)
    assert calls == [2, 1] and len(map.rooms) == 1 and not len(map.edges)
    assert (map.room[map.room >= 0] == 0).all() and (map.navigable_room <= 0).all()
