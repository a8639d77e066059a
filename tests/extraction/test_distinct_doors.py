"""One doorway, one door: by hand between two rooms, and the rooms at a place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import topomerge as tm
from tests.scenes import Scene
from topomerge.extraction.attributes import ONE_DOORWAY, find_rooms_at, select_distinct_doors
from topomerge.types import TopometricMap


@pytest.fixture(scope="module")
def three_rooms() -> TopometricMap:
    """Side by side, from the west to the east; a door in the middle of either wall."""
    scene = Scene().shell(0, 0, 15, 5).wall((5, 0), (5, 5), doors=(2.0,)).wall((10, 0), (10, 5), doors=(2.0,))
    return tm.extract(scene.points().astype(np.float32))


def with_another(map: TopometricMap, **fields) -> TopometricMap:
    """With a copy of the first door, changed."""
    double = map.edges[:1].copy()
    for name, value in fields.items():
        double[name] = value
    return replace(map, edges=np.concatenate([double, map.edges]))


def test_all_doors_of_a_plain_map_stay(three_rooms):
    assert len(three_rooms.edges) == 2 and select_distinct_doors(three_rooms) is three_rooms
    bare = replace(three_rooms, edges=three_rooms.edges[:0])
    assert select_distinct_doors(bare) is bare


def test_of_a_doorway_told_twice_the_rooms_across_it_stay(three_rooms):
    """Even if the false one is surer: it says that the outer rooms meet there."""
    first = three_rooms.edges[0]
    outer = sorted({0, 1, 2} - set(first["rooms"].tolist()) | {int(first["rooms"].min())})
    false = with_another(three_rooms, rooms=outer, confidence=1.0, centre=first["centre"] + (0.0, 0.2, 0.0))
    assert np.array_equal(select_distinct_doors(false).edges, three_rooms.edges)


def test_of_two_between_the_same_rooms_the_surer_one_stays(three_rooms):
    for confidence in (0.3, 1.0):
        surest = max(confidence, float(three_rooms.edges["confidence"][0]))
        out = select_distinct_doors(with_another(three_rooms, confidence=confidence)).edges
        assert len(out) == 2 and surest in out["confidence"]


def test_doors_beside_each_other_and_stairs_stay(three_rooms):
    centre = three_rooms.edges["centre"][0]
    beside = with_another(three_rooms, centre=centre + (0.0, ONE_DOORWAY + 0.01, 0.0))
    stairs = with_another(three_rooms, kind="stairs")
    above = with_another(three_rooms, centre=centre + (0.0, 0.0, 3.0))
    for map in (beside, stairs, above):
        assert select_distinct_doors(map) is map


def test_the_order_of_the_doors_changes_nothing(three_rooms):
    doubled = with_another(three_rooms, rooms=[0, 2], confidence=0.9)
    turned = replace(doubled, edges=doubled.edges[::-1].copy())
    assert {e.tobytes() for e in select_distinct_doors(doubled).edges} == {
        e.tobytes() for e in select_distinct_doors(turned).edges
    }


def test_rooms_at_places(three_rooms):
    x = np.array([2.5, 7.5, 12.5, 30.0])
    floor = float(three_rooms.storeys["floor"][0])
    room = find_rooms_at(three_rooms, np.column_stack([x, np.full(4, 2.5), np.full(4, floor + 0.05)]))
    assert len(set(room[:3].tolist())) == 3 and (room[:3] >= 0).all() and room[3] == -1
    assert (find_rooms_at(three_rooms, np.array([[2.5, 2.5, floor + 3.0]])) == -1).all() and len(
        find_rooms_at(three_rooms, np.zeros((0, 3)))
    ) == 0
