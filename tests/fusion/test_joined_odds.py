"""Who was in the rooms of a joined map, as its parts say: by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import topomerge as tm
from tests.scenes import two_rooms
from topomerge.extraction.plans.part_rooms import PartRooms
from topomerge.fusion.fuse import fuse
from topomerge.fusion.transfer import LEAST_COVER, add_part_odds
from topomerge.types import Sim3, TopometricMap


@pytest.fixture(scope="module")
def rooms() -> TopometricMap:
    return tm.extract(two_rooms().points().astype(np.float32))


def part_of(map: TopometricMap, entered, share: float = 1.0) -> PartRooms:
    """The floor of a map's rooms, each up to a share of it from the south on."""
    inside = np.flatnonzero(map.navigable_room >= 0)
    floor, room = map.navigable.compute_centroids()[inside], map.navigable_room[inside]
    taken = np.zeros(len(floor), bool)
    for r in range(len(map.rooms)):
        mine = np.flatnonzero(room == r)
        taken[mine[np.argsort(floor[mine, 1], kind="stable")[: round(share * len(mine))]]] = True
    return PartRooms(floor[taken], room[taken], np.array(entered, float), map.grid.edge**2)


def test_the_part_that_was_in_a_room_decides(rooms):
    first, second = part_of(rooms, [0.9, 0.1]), part_of(rooms, [0.2, 0.3])
    for parts in ([first, second], [second, first]):
        out = add_part_odds(rooms, parts).rooms
        assert out["entered"] == pytest.approx([0.9, 0.3]) and out["glimpsed"].tolist() == [False, True]


def test_a_part_that_saw_little_of_a_room_says_nothing(rooms):
    for share, entered in ((LEAST_COVER - 0.1, rooms.rooms["entered"]), (LEAST_COVER + 0.1, [0.11, 0.12])):
        assert add_part_odds(rooms, [part_of(rooms, [0.11, 0.12], share)]).rooms["entered"] == pytest.approx(entered)


def test_a_room_that_a_part_cuts_has_the_mean_of_its_floor(rooms):
    cut = part_of(rooms, [0.8, 0.8, 0.2])
    south = cut.places[:, 1] < np.median(cut.places[cut.room == 0, 1])
    cut = replace(cut, room=np.where(south & (cut.room == 0), 2, cut.room))
    assert add_part_odds(rooms, [cut]).rooms["entered"] == pytest.approx([0.5, 0.8], abs=0.05)


def test_without_parts_all_stays(rooms):
    assert np.array_equal(add_part_odds(rooms, []).rooms, rooms.rooms)


def test_joined_maps_have_it_from_their_parts(rooms):
    looked_into = replace(rooms, rooms=rooms.rooms.copy())
    looked_into.rooms["entered"], looked_into.rooms["glimpsed"] = 0.1, True
    joined = fuse([looked_into, looked_into], [(0, Sim3()), (1, Sim3())])
    assert joined.rooms["entered"] == pytest.approx(0.1) and joined.rooms["glimpsed"].all()
    joined = fuse([looked_into, rooms], [(0, Sim3()), (1, Sim3())])
    assert joined.rooms["entered"] == pytest.approx(rooms.rooms["entered"], abs=0.01)
