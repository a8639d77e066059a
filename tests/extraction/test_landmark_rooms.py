"""Rooms of landmarks: by the floor where they are, of signs by the door that they hang at."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.scenes_map import HEIGHT, building
from topomerge.extraction.landmarks import add_landmarks, assign_landmarks, load_map_with_landmarks
from topomerge.io.maps import save_map
from topomerge.types import LEVELLED, Landmarks, TopometricMap, build_landmarks, select_rooms

# Rooms 0 and 1 on both sides of the corridor 2, each with one door to it; the same above as 3, 4 and 5.


@pytest.fixture(scope="module")
def two_storeys() -> TopometricMap:
    return building(1, 2)


def place(map: TopometricMap, kind: str, *at: tuple[float, float, float], **columns: int) -> list[tuple[int, int]]:
    found = assign_landmarks(map, build_landmarks(kind, [str(k) for k in range(len(at))], "here", np.array(at), **columns)).table
    return found[["room", "storey"]].tolist()


def test_what_stands_in_a_room_is_of_that_room(two_storeys: TopometricMap) -> None:
    middles = [tuple(middle) for middle in two_storeys.rooms["centroid"].tolist()]
    assert place(two_storeys, "object", *middles) == [(r, r // 3) for r in range(6)]
    assert place(two_storeys, "radio", *middles) == [(r, r // 3) for r in range(6)]
    x, y, z = two_storeys.rooms["hi"][0].tolist()
    assert place(two_storeys, "object", (x + 1.4, y - 2, z - 1), (x + 1.6, y - 2, z - 1)) == [(0, 0), (-1, 0)]


def test_a_sign_beside_a_door_is_of_the_room_behind_it(two_storeys: TopometricMap) -> None:
    door = two_storeys.edges["centre"][0]
    inside, outside = door + (0.7, -0.3, 1.5), door + (0.7, 0.3, 1.5)
    assert two_storeys.edges["rooms"][0].tolist() == [0, 2]
    for kind, rooms in (("text", [0, 0]), ("tag", [0, 0]), ("object", [0, 2])):
        assert [room for room, _ in place(two_storeys, kind, tuple(inside), tuple(outside))] == rooms, kind
    above = (*outside[:2], outside[2] + HEIGHT * 0.1)
    assert place(two_storeys, "text", above) == [(3, 1)]
    far = tuple(door + (1.6, 0.3, 1.5))
    assert place(two_storeys, "text", far) == [(2, 0)]


def test_of_two_rooms_with_as_many_doors_a_sign_names_the_other_one(two_storeys: TopometricMap) -> None:
    only = replace(two_storeys, edges=two_storeys.edges[:1])
    door = only.edges["centre"][0]
    assert place(only, "text", tuple(door + (0.7, 0.3, 1.5))) == [(0, 0)]
    assert place(only, "text", tuple(door + (0.7, -0.3, 1.5))) == [(2, 0)]


def test_what_a_landmark_says_of_itself_stays(two_storeys: TopometricMap) -> None:
    middle = tuple(two_storeys.rooms["centroid"][0].tolist())
    assert place(two_storeys, "text", middle, room=4) == [(4, 1)]
    assert place(two_storeys, "object", middle, storey=1) == [(3, 1)]
    assert place(two_storeys, "object", middle, room=99, storey=99) == [(0, 0)]
    nowhere = (np.nan, np.nan, np.nan)
    assert place(two_storeys, "text", nowhere) == [(-1, -1)]
    assert place(two_storeys, "text", nowhere, room=1) == [(1, 0)]


def test_maps_without_rooms_or_storeys() -> None:
    from tests.io.export_maps import nothing

    assert place(nothing(), "text", (0.0, 0.0, 0.0)) == [(-1, -1)]
    assert len(assign_landmarks(building(1, 1), Landmarks())) == 0
    map = building(1, 1)
    assert add_landmarks(map, Landmarks()) is map


def test_selections_of_rooms_keep_landmarks(two_storeys: TopometricMap) -> None:
    marked = add_landmarks(two_storeys, build_landmarks("name", ["a", "b", "c"], "here", room=[0, 4, -1]))
    kept = select_rooms(marked, np.arange(6) >= 3).landmarks
    assert kept.get_values().tolist() == ["a", "b", "c"] and kept.table["room"].tolist() == [-1, 1, -1]
    assert kept.table["storey"].tolist() == [0, 1, -1]


def test_a_table_beside_a_map_is_read_once(tmp_path: Path) -> None:
    angle = np.radians(90)
    turn = np.eye(4)
    turn[:2, :2] = ((np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle)))
    turn[0, 3] = 5
    map = building(1, 1)
    save_map(replace(map, parameters={**map.parameters, LEVELLED: turn.tolist()}), tmp_path / "a.tmap")
    (tmp_path / "a.landmarks.csv").write_text("kind,value,x,y,z\ntext,101,1,2,3\n")
    marked = load_map_with_landmarks(tmp_path / "a.tmap")
    assert np.allclose(marked.landmarks.table["position"], (3, 1, 3)), "the table is in the frame of the file"
    save_map(marked, tmp_path / "a.tmap")
    assert len(load_map_with_landmarks(tmp_path / "a.tmap").landmarks) == 1
    (tmp_path / "a.landmarks.csv").unlink()
    assert len(load_map_with_landmarks(tmp_path / "a.tmap").landmarks) == 1
