"""Landmarks of maps that are joined: carried, fused, and told where they contradict; maps without are joined as before."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.fusion.atlas.atlas_scenes import office_map, truth
from topomerge.extraction.landmarks import add_landmarks
from topomerge.fusion.atlas.store import add, remove, select_tile
from topomerge.fusion.fuse import find_joined_rooms, fuse
from topomerge.fusion.pipeline import merge
from topomerge.fusion.result import MergeResult, serialise_merge
from topomerge.fusion.transfer import LANDMARK_PARAMETER, vote_rooms
from topomerge.io.maps import load_map, save_map
from topomerge.landmarks.fuse import CONTRADICTING, describe_listed
from topomerge.types import Landmarks, Sim3, TopometricMap, build_landmarks, join_landmarks
from topomerge.viz.atlas_report import render_atlas_html
from topomerge.viz.merge_report import render_merge_html

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


def test_markup_on_signs_is_shown_in_the_report_and_never_run(halves: Halves) -> None:
    """Hostile: signs that contradict each other, and landmarks in the tables, whose texts are markup."""
    west, east = halves
    door, evil = common_door(west, east), ("</script><b onload=x>2.113", "<img src=x onerror=y>2.115")
    west = add_landmarks(west, build_landmarks("text", evil[:1], "<i>source</i>", door[None]))
    east = add_landmarks(east, build_landmarks("text", evil[1:], "e", in_east(door)))
    page = render_merge_html(
        MergeResult("merged", 0.9, "so", transforms={1: truth(0, 2)}, map=fused(west, east), maps=(west, east))
    )
    assert "<b onload" not in page and "<img src=x" not in page and "<i>source" not in page
    assert "&lt;b onload=x&gt;2.113" in page and "&lt;img src=x onerror=y&gt;2.115" in page


@pytest.mark.longer
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


@pytest.mark.longer
def test_an_atlas_tells_contradictions_and_lists_what_became_of_landmarks(halves: Halves, tmp_path: Path) -> None:
    west, east = halves
    door = common_door(west, east)
    west = add_landmarks(west, build_landmarks("tag", ["t:1"], "w", door[None]))
    east = add_landmarks(east, build_landmarks("tag", ["t:1"], "e", in_east(door + (3, 0, 0))))
    result = merge([west, east, office_map(1)])
    assert [w for w in result.warnings if w.startswith(f"{CONTRADICTING}: tag t:1 is 3.0 m apart")]
    assert "tag t:1 is 3.0 m apart" in render_merge_html(result)
    folder = tmp_path / "site"
    names = [("west", west), ("east", east), ("middle", office_map(1))]
    atlas = add(folder, names, render_atlas_html)
    assert any("tag t:1 is 3.0 m apart in west and east" in w for w in atlas.warnings)
    listing = json.loads((folder / "atlas.json").read_text())
    (component,) = listing["components"]
    assert component["landmarks"]["contradicting"] == 1
    component["landmarks"] = {"maps": "damaged"}  # a stranger's
    (folder / "atlas.json").write_text(json.dumps(listing))
    again = remove(folder, [], render_atlas_html)
    assert not [w for w in again.warnings if CONTRADICTING in w]


def test_a_tile_shows_its_own_landmarks(halves: Halves) -> None:
    map = add_landmarks(halves[0], build_landmarks("name", ["a", "b", "c"], "w", room=[0, 1, -1]))
    assert select_tile(map, [1]).landmarks.get_values().tolist() == ["b"]


def test_a_damaged_summary_says_nothing() -> None:
    good = {"maps": [1, 1], "joined": 2, "fused": 0, "contradicting": 1}
    listed = good | {"contradictions": [{"what": "number", "values": ["1", "2"], "maps": [0, 1], "room": 3, "apart_m": None}]}
    assert describe_listed(listed, "ab") == f"{CONTRADICTING}: room 3 is 1 in a and 2 in b"
    for bad in (
        3,
        None,
        [],
        {},
        good | {"contradictions": [{}]},
        good | {"contradictions": [3]},
        listed | {"contradicting": "x"},
    ):
        assert describe_listed(bad, "ab") == ""
    assert describe_listed(listed, "a") == ""
