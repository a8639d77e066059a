"""Doors that somebody walked through: two rooms drawn by hand, a wall between them, and ways of a sensor."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tests.cases import list_longer
from tests.extraction.elevations.doors import SHUT_DOOR, flush_door
from tests.scenes import Scene, two_rooms
from topomerge.extraction.attributes import SHUT_LATER_CHANCE, add_walked_doors, find_room_changes, find_rooms_under
from topomerge.extraction.extract import extract
from topomerge.types import PointCloud, TopometricMap

HEIGHT = 1.4


@pytest.fixture(scope="module")
def map():
    return extract(two_rooms().points(), walls=False)


def way(*corners, step=0.3):
    """Places of a sensor along straight lines between corners."""
    places = []
    for a, b in pairwise(corners):
        a, b = np.array(a, float), np.array(b, float)
        t = np.arange(0, np.linalg.norm(b - a), step) / np.linalg.norm(b - a)
        places.append(a + t[:, None] * (b - a))
    flat = np.concatenate([*places, [np.array(corners[-1], float)]])
    return np.column_stack([flat, np.full(len(flat), HEIGHT)])


THROUGH = way((1, 2), (6, 2))  # through the door at (4, 2)
THROUGH_WALLS = way((1, 4), (6, 4), (6, 0.3), (1, 0.3))


def test_rooms_are_those_of_the_floor_below(map):
    left, right, high, outside = find_rooms_under(map, np.array([(1, 2, 1.4), (6, 2, 1.4), (1, 2, 4.0), (20, 2, 1.4)]))
    assert left >= 0 and right >= 0 and left != right and high == outside == -1


def test_a_way_through_the_door_proves_it(map):
    (change,) = find_room_changes(map, THROUGH)
    assert change[0] == (0, 1) and change[1][0] < 4.4 and change[2][0] > 3.6
    proven, doubt = add_walked_doors(map, THROUGH)
    assert not doubt and proven.edges["confidence"].tolist() == [0.98] and len(proven.edges) == len(map.edges) == 1
    assert np.array_equal(proven.edges["centre"], map.edges["centre"])


def test_a_door_that_was_shut_later_is_one(map):
    shut = map.edges.copy()
    shut["open"], shut["confidence"] = False, 0.6
    proven, doubt = add_walked_doors(replace(map, edges=shut), THROUGH)
    assert not doubt and proven.edges["open"].all() and proven.edges["confidence"][0] == 0.98


def test_a_door_that_nothing_shows_is_added(map):
    proven, doubt = add_walked_doors(replace(map, edges=map.edges[:0]), THROUGH)
    (door,) = proven.edges
    assert not doubt and door["rooms"].tolist() == [0, 1] and door["open"] and door["kind"] == "door"
    assert door["centre"][:2] == pytest.approx([4, 2], abs=0.4) and door["direction"] == pytest.approx(0, abs=0.01)


def test_a_door_whose_lintel_the_way_meets_once_is_open(map):
    high = THROUGH[::-1] + (0, 0, 0.75)
    assert add_walked_doors(replace(map, edges=map.edges[:0]), high)[0].edges["open"].tolist() == [False]
    proven, _ = add_walked_doors(replace(map, edges=map.edges[:0]), np.concatenate([THROUGH, high]))
    assert proven.edges["open"].tolist() == [True]


@pytest.mark.parametrize("back", [1, -1])
def test_there_and_back_is_one_door(map, back):
    proven, _ = add_walked_doors(replace(map, edges=map.edges[:0]), np.concatenate([THROUGH, THROUGH[::-1]])[::back])
    assert len(proven.edges) == 1


@pytest.mark.parametrize(
    "places",
    [THROUGH_WALLS, way((1, 4), (12, 4))],
    ids=["in two places", "off the floors"],
)
def test_a_way_through_walls_is_of_another_building(map, places):
    proven, doubt = add_walked_doors(map, places)
    assert proven is map and "through walls" in doubt


@pytest.mark.parametrize("back", [False, True], ids=["there", "there and back"])
def test_one_thin_place_that_a_way_leads_through_is_a_door_that_was_shut_later(map, back):
    places = way((1, 4), (6, 4))
    proven, doubt = add_walked_doors(map, np.concatenate([places, places[::-1]]) if back else places)
    added = proven.edges[~proven.edges["open"]]
    assert not doubt and len(proven.edges) == 2 and added["rooms"].tolist() == [[0, 1]]
    assert added["centre"][0, :2] == pytest.approx([4, 4], abs=0.1) and added["width"] == [0.9] and added["kind"] == ["door"]
    assert added["confidence"] == [SHUT_LATER_CHANCE] and np.array_equal(added["lower"], added["centre"])


def test_few_places_of_a_good_way_through_a_wall_are_one_door_only_if_they_are_one(map):
    good = np.concatenate([THROUGH, THROUGH[::-1]] * 4)
    once, twice = (add_walked_doors(map, np.concatenate([good, more])) for more in (way((1, 2), (1, 4), (6, 4)), THROUGH_WALLS))
    assert not once[1] and once[0].edges["open"].tolist() == [True, False]
    assert not twice[1] and twice[0].edges["open"].tolist() == [True]


def by_its_plan(scene: Scene) -> TopometricMap:
    """The map by the plan alone."""
    return extract(scene.points(), walls=False)


@pytest.mark.parametrize(("deep", "doors"), [(0.02, 1), (0.4, 0)], ids=["a board", "a cupboard"])
def test_what_is_thick_is_no_door(deep, doors):
    scene = Scene().shell(0, 0, 7, 5).wall((4, 0), (4, 5))
    scene.box(4.1, 1.5, 0, 4.1 + deep, 2.5, 2.2)
    map = by_its_plan(scene)
    proven, doubt = add_walked_doors(map, way((1, 2), (6, 2)))
    assert len(map.rooms) == 2 and len(proven.edges) == doors and bool(doubt) == (not doors)


@pytest.mark.parametrize(("y", "doors"), [(3.1, 1), (4.2, 2)], ids=["beside it", "away from it"])
def test_a_way_through_the_wall_beside_a_door_drifted(y, doors):
    map = by_its_plan(two_rooms().wall((4, 2.7), (7, 2.7)))
    proven, doubt = add_walked_doors(map, way((1, y), (6, y)))
    assert len(map.rooms) == 3 and len(map.edges) == 1 and len(proven.edges) == doors and bool(doubt) == (doors == 1)


@pytest.mark.parametrize(
    "places",
    [
        np.zeros((0, 3)),
        np.full((4, 3), np.nan),
        way((1, 2), (2, 3)),
        way((100, 2), (106, 2)),
        np.array([(1, 2, 1.4), (6, 2, 1.4)]),
    ],
    ids=["none", "nan", "in one room", "elsewhere", "a jump"],
)
def test_what_changes_no_room_changes_nothing(map, places):
    proven, doubt = add_walked_doors(map, places)
    assert proven is map and not doubt


def walked(points: np.ndarray, places: np.ndarray) -> PointCloud:
    """A cloud of points in any order, seen from places in theirs."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    which = np.sort(np.arange(len(points)) % len(poses)).astype(np.int32)
    order = np.random.default_rng(0).permutation(len(points))
    return PointCloud(points[order], poses=poses, pose_of=which)


def test_the_extraction_takes_the_places_of_the_file():
    map = extract(walked(two_rooms().points(), THROUGH), walls=False)
    assert map.edges["confidence"].tolist() == [0.98]


@pytest.mark.parametrize("doors", [(SHUT_DOOR, 4.0), *list_longer(((SHUT_DOOR,),))], ids=["one of two", "the only door"])
def test_a_leaf_across_a_doorway_that_somebody_walked_through_is_a_shut_door(doors):
    points = flush_door(doors)
    map = extract(walked(points, way((1, SHUT_DOOR), (6, SHUT_DOOR))))
    (door,) = map.edges[~map.edges["open"]]
    assert len(extract(points).edges) == len(doors) - 1 and len(map.edges) == len(doors) and not map.warnings
    assert door["centre"][:2] == pytest.approx([4, SHUT_DOOR], abs=0.1) and door["width"] == pytest.approx(0.9)
