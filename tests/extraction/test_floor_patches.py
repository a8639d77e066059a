"""Patches of floor that no door leads to: what is dropped, what stays, and that everything else of the map is as it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes_map import building
from topomerge.extraction.attributes import PATCH_AREA, remove_patches
from topomerge.types import EDGE_DTYPE, WINDOW_DTYPE, TopometricMap

NOWHERE = np.zeros((0, 3))


def with_patch(area: float = 1.5, storeys: int = 1) -> TopometricMap:
    """A building whose room 1 is a patch: no door leads to it, it is small, and two of its windows are those of others, too."""
    map = building(2, storeys=storeys)
    rooms = map.rooms.copy()
    rooms["area"][1] = area
    windows = np.zeros(4, WINDOW_DTYPE)
    windows["rooms"] = [(0, 1), (1, 2), (1, -1), (2, -1)]
    edges = map.edges[(map.edges["rooms"] != 1).all(axis=1)]
    return replace(map, rooms=rooms, windows=windows, edges=edges)


def test_a_patch_is_of_no_room_and_the_others_are_as_they_were():
    map = with_patch()
    other = remove_patches(map, NOWHERE)
    stays = np.delete(np.arange(len(map.rooms)), 1)
    assert np.array_equal(other.rooms, map.rooms[stays])
    for labels, before in ((other.room, map.room), (other.navigable_room, map.navigable_room)):
        assert (labels[before == 1] == -1).all()
        assert np.array_equal(stays[labels[before > 1]], before[before > 1])
    assert np.array_equal(stays[other.edges["rooms"]], map.edges["rooms"])
    assert np.array_equal(other.edges["centre"], map.edges["centre"])
    assert other.windows["rooms"].tolist() == [[0, -1], [1, -1], [1, -1]]


def test_areas_and_narrowings_of_a_patch_go_with_it():
    map = with_patch()
    count = len(map.rooms)
    areas = np.zeros(2 * count, map.areas.dtype)
    areas["room"] = np.repeat(np.arange(count), 2)
    narrows = np.zeros(count, EDGE_DTYPE)
    narrows["rooms"] = np.arange(2 * count).reshape(count, 2)
    area = np.where(map.navigable_room >= 0, 2 * map.navigable_room, -1).astype(np.int32)
    other = remove_patches(replace(map, areas=areas, narrows=narrows, navigable_area=area), NOWHERE)
    assert len(other.areas) == 2 * (count - 1) and len(other.narrows) == count - 1
    assert (other.areas["room"][other.narrows["rooms"]] == np.arange(count - 1)[:, None]).all()
    inside = other.navigable_room >= 0
    assert (other.areas["room"][other.navigable_area[inside]] == other.navigable_room[inside]).all()
    assert (other.navigable_area[~inside] == -1).all()


@pytest.mark.parametrize("why", ["door", "large", "entered", "alone"])
def test_rooms_stay(why: str):
    map, places = with_patch(), NOWHERE
    if why == "door":
        map = replace(map, edges=building(2).edges)
    elif why == "large":
        map = with_patch(PATCH_AREA)
    elif why == "entered":
        places = map.navigable.compute_centroids()[map.navigable_room == 1][:1] + (0.0, 0.0, 1.4)
    else:
        rooms = map.rooms.copy()
        rooms["area"] = 1.0
        map = replace(map, rooms=rooms, edges=map.edges[:0])
    assert remove_patches(map, places) is map


def test_patches_of_a_storey_that_has_nothing_else_stay():
    map = with_patch(storeys=2)
    upper = map.rooms["storey"] == 1
    rooms = map.rooms.copy()
    rooms["area"][upper] = 1.0
    edges = map.edges[~upper[map.edges["rooms"]].any(axis=1)]
    other = remove_patches(replace(map, rooms=rooms, edges=edges), NOWHERE)
    assert (other.rooms["storey"] == 1).sum() == upper.sum() and len(other.rooms) == len(map.rooms) - 1
