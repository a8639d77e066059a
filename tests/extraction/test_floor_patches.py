"""Patches of floor that no door leads to: what is dropped, what stays, and that everything else of the map is as it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.scenes_map import building
from topomerge.extraction.attributes import PATCH_AREA, remove_patches, remove_strokes
from topomerge.extraction.extract import extract
from topomerge.io.points import read_points
from topomerge.types import EDGE_DTYPE, WINDOW_DTYPE, TopometricMap, select_rooms

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


@pytest.mark.parametrize("why", ["stroke", "door", "wide", "alone"])
def test_narrow_floor_to_which_no_door_leads_is_no_room(why: str):
    map = building(2) if why == "door" else with_patch()
    at = map.navigable.cells[:, 0] - map.navigable.cells[map.navigable_room == 1, 0].min()
    stays = (map.navigable_room != 1) | (at < (7 if why == "wide" else 5))  # cells of 0.1 m
    map = replace(map, navigable=map.navigable.select_cells(stays), navigable_room=map.navigable_room[stays], navigable_area=None)
    if why == "alone":  # the storey keeps its rooms
        map = select_rooms(replace(map, edges=map.edges[:0]), np.arange(len(map.rooms)) == 1)
    other = remove_strokes(map)
    if why != "stroke":
        assert other is map
    else:
        assert (
            np.array_equal(other.rooms, np.delete(map.rooms, 1)) and (other.navigable_room[map.navigable_room == 1] == -1).all()
        )


def test_a_letter_painted_on_a_grid_is_no_room(tmp_path: Path):
    """The stroke of a large O beside the rooms, 45 cm wide and free within, as the number of a storey on a robot's map."""
    image = np.full((120, 200), 205, np.uint8)
    image[10:110, 10:130] = 0
    image[12:108, 12:68] = image[12:108, 72:128] = image[50:68, 66:74] = 254
    x, y = np.meshgrid(np.arange(200) - 165, np.arange(120) - 60)
    away = np.hypot(x, y)
    image[(away >= 14) & (away <= 27)] = 0
    image[(away >= 16) & (away <= 25)] = 254
    Image.fromarray(image).save(tmp_path / "map.png")
    (tmp_path / "map.yaml").write_text(
        "image: map.png\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    map = extract(read_points(tmp_path / "map.yaml"))
    beside = map.navigable.compute_centroids()[:, 0] > 6.6
    assert len(map.rooms) == 2 and not (map.navigable_room[beside] >= 0).any()
