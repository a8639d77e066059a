"""Doors that somebody walked through: two rooms drawn by hand, a wall between them, and ways of a sensor."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tests.scenes import two_rooms
from topomerge.extraction.extract import extract
from topomerge.extraction.walked_doors import room_changes, rooms_under, with_walked_doors
from topomerge.types import PointCloud

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
INTO_THE_WALL = way((1, 4), (6, 4))


def test_rooms_are_those_of_the_floor_below(map):
    left, right, high, outside = rooms_under(map, np.array([(1, 2, 1.4), (6, 2, 1.4), (1, 2, 4.0), (20, 2, 1.4)]))
    assert left >= 0 and right >= 0 and left != right and high == outside == -1


def test_a_way_through_the_door_proves_it(map):
    (change,) = room_changes(map, THROUGH)
    assert change[0] == (0, 1) and change[1][0] < 4.4 and change[2][0] > 3.6
    proven, doubt = with_walked_doors(map, THROUGH)
    assert not doubt and proven.edges["confidence"].tolist() == [0.98] and len(proven.edges) == len(map.edges) == 1
    assert np.array_equal(proven.edges["centre"], map.edges["centre"])


def test_a_door_that_was_shut_later_is_one(map):
    shut = map.edges.copy()
    shut["open"], shut["confidence"] = False, 0.6
    proven, doubt = with_walked_doors(replace(map, edges=shut), THROUGH)
    assert not doubt and proven.edges["open"].all() and proven.edges["confidence"][0] == 0.98


def test_a_door_that_nothing_shows_is_added(map):
    proven, doubt = with_walked_doors(replace(map, edges=map.edges[:0]), THROUGH)
    (door,) = proven.edges
    assert not doubt and door["rooms"].tolist() == [0, 1] and door["open"] and door["kind"] == "door"
    assert door["centre"][:2] == pytest.approx([4, 2], abs=0.4) and door["direction"] == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize("back", [1, -1])
def test_there_and_back_is_one_door(map, back):
    proven, _ = with_walked_doors(replace(map, edges=map.edges[:0]), np.concatenate([THROUGH, THROUGH[::-1]])[::back])
    assert len(proven.edges) == 1


def test_a_way_through_walls_is_of_another_building(map):
    proven, doubt = with_walked_doors(map, INTO_THE_WALL)
    assert proven is map and "through walls" in doubt


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
    proven, doubt = with_walked_doors(map, places)
    assert proven is map and not doubt


def test_the_extraction_takes_the_places_of_the_file():
    points = two_rooms().points()
    poses = np.tile(np.eye(4), (len(THROUGH), 1, 1))
    poses[:, :3, 3] = THROUGH
    which = np.sort(np.arange(len(points)) % len(poses)).astype(np.int32)
    order = np.random.default_rng(0).permutation(len(points))
    map = extract(PointCloud(points[order], poses=poses, pose_of=which), walls=False)
    assert map.edges["confidence"].tolist() == [0.98]
