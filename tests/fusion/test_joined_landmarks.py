"""Landmarks of maps that are joined: carried, fused, and told where they contradict; maps without are joined as before."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.fusion.atlas.atlas_scenes import office_map, truth
from topomerge.extraction.landmarks import add_landmarks
from topomerge.fusion.fuse import find_joined_rooms, fuse
from topomerge.fusion.result import MergeResult, serialise_merge
from topomerge.fusion.transfer import LANDMARK_PARAMETER, vote_rooms
from topomerge.io.maps import load_map, save_map
from topomerge.landmarks.fuse import CONTRADICTING
from topomerge.types import Landmarks, Sim3, TopometricMap, build_landmarks, join_landmarks

Halves = tuple[TopometricMap, TopometricMap]


@pytest.fixture(scope="module")
def halves() -> Halves:
    """The west and the east of the office, in two frames."""
    return office_map(0), office_map(2)


def in_east(at: np.ndarray) -> np.ndarray:
    return truth(0, 2).inverse().apply(np.atleast_2d(at))


def fused(west: TopometricMap, east: TopometricMap) -> TopometricMap:
    return fuse((west, east), [(0, Sim3()), (1, truth(0, 2))])


def common_door(west: TopometricMap, east: TopometricMap) -> np.ndarray:
    """The middle of a door that both have, in the frame of the west."""
    there = truth(0, 2).apply(east.edges["centre"])
    apart = np.linalg.norm(west.edges["centre"][:, None] - there[None], axis=2)
    k, j = np.unravel_index(apart.argmin(), apart.shape)
    assert apart[k, j] < 0.3
    return west.edges["centre"][k] + np.array([0, 0, 1.5])


def test_signs_of_both_are_one_and_rooms_are_those_of_the_joined_map(halves: Halves, tmp_path: Path) -> None:
    west, east = halves
    door = common_door(west, east)
    own = join_landmarks(
        [
            build_landmarks("text", ["2.113"], "w", door[None], sigma=0.2, number=0.5),
            build_landmarks("name", ["Lab"], "w", room=0),
            build_landmarks("radio", ["aa"] * 3, "w", np.tile(door, (3, 1)), number=-50.0),
        ]
    )
    turn = truth(0, 2).yaw
    theirs = join_landmarks(
        [
            build_landmarks("text", ["2.113"], "e", in_east(door + (0.2, 0, 0)), sigma=0.2, number=0.5 - turn),
            build_landmarks("object", ["sofa"], "e", east.rooms["centroid"][1:2]),
            build_landmarks("text", ["EXIT"], "e", storey=0),
        ]
    )
    west, east = add_landmarks(west, own), add_landmarks(east, theirs)
    joined = fused(west, east)
    marks = joined.landmarks
    assert marks.get_values().tolist() == ["2.113", "Lab", "aa", "aa", "aa", "sofa", "EXIT"]
    assert np.allclose(marks.table["position"][0], door + (0.1, 0, 0), atol=1e-6)
    assert marks.table["number"][0] == pytest.approx(0.5)
    rooms_of_west = find_joined_rooms(west, joined, Sim3())
    rooms_of_east = find_joined_rooms(east, joined, truth(0, 2))
    assert marks.table["room"][1] == rooms_of_west[0] and marks.table["room"][5] == rooms_of_east[1] >= 0
    assert marks.table["room"][0] == rooms_of_west[west.landmarks.table["room"][0]]
    assert marks.table[["room", "storey"]][6].tolist() == (-1, 0)
    assert joined.parameters[LANDMARK_PARAMETER]["fused"] == 1 and not [w for w in joined.warnings if CONTRADICTING in w]
    save_map(joined, tmp_path / "j.tmap")
    back = load_map(tmp_path / "j.tmap")
    assert back.landmarks.get_values().tolist() == marks.get_values().tolist()
    again = fuse((back, add_landmarks(halves[1], theirs)), [(0, Sim3()), (1, truth(0, 2))])
    assert len(again.landmarks) == len(marks) + 1, "the word that is of a storey alone may be another one"


def test_contradictions_stand_in_merge_json_and_in_a_warning(halves: Halves) -> None:
    west, east = halves
    door = common_door(west, east)
    west = add_landmarks(west, build_landmarks("text", ["2.113"], "w", door[None]))
    east = add_landmarks(east, build_landmarks("text", ["2.115"], "e", in_east(door)))
    joined = fused(west, east)
    assert joined.landmarks.get_values().tolist() == ["2.113", "2.115"]
    room = int(joined.landmarks.table["room"][0])
    assert joined.warnings[-1] == f"{CONTRADICTING}: room {room} is 2.113 in {west.title} and 2.115 in {east.title}"
    result = MergeResult("merged", 0.9, "so", transforms={1: truth(0, 2)}, map=joined, maps=(west, east))
    listed = json.loads(json.dumps(serialise_merge(replace(result, registration=None, transforms={}))))["landmarks"]
    assert (listed["maps"], listed["joined"], listed["fused"], listed["contradicting"]) == ([1, 1], 2, 0, 1)
    (one,) = listed["contradictions"]
    assert one == {
        "what": "number",
        "values": ["2.113", "2.115"],
        "maps": [0, 1],
        "room": room,
        "apart_m": pytest.approx(0, abs=0.01),
    }


def test_maps_without_landmarks_are_joined_as_before(halves: Halves) -> None:
    joined = fused(*halves)
    assert isinstance(joined.landmarks, Landmarks) and len(joined.landmarks) == 0
    assert LANDMARK_PARAMETER not in joined.parameters
    result = MergeResult("merged", 0.9, "so", map=joined, maps=halves)
    assert "landmarks" not in serialise_merge(result)
    marked = fused(add_landmarks(halves[0], build_landmarks("name", ["Lab"], "w", room=0)), halves[1])
    assert marked.rooms.tobytes() == joined.rooms.tobytes() and marked.edges.tobytes() == joined.edges.tobytes()


def test_most_floor_says_which_room_it_is() -> None:
    part, joined = np.array([0, 0, 0, 1, 1, 1, 2, 4]), np.array([5, 5, 3, 3, 7, -1, -1, 0])
    assert vote_rooms(part, joined, 5).tolist() == [5, 3, -1, -1, 0]  # of two with as much floor the first
    assert vote_rooms(part[:0], joined[:0], 2).tolist() == [-1, -1]
