"""Each op on a map of known rooms; replay, undo, and maps that were extracted again."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import topomerge as tm
from tests.edits.recipes import assert_same_map, corridor_map, label_at
from topomerge.edits.apply import apply_edits
from topomerge.edits.journal import Edit, build_edit, build_undo
from topomerge.types import find_room_names

MIDDLES = np.array([(2 + 4 * (k // 2), 2 if k % 2 == 0 else 8) for k in range(8)] + [(8, 5)], float)  # of the rooms, in order


def edited(*edits: Edit):
    done = apply_edits(corridor_map(), edits)
    assert not done.refused, done.refused
    return done.map


def refusal(edit: Edit) -> str:
    done = apply_edits(corridor_map(), [edit])
    assert done.map is corridor_map() and not done.applied
    return str(done.refused[0])


def split(x: float = 8.0) -> Edit:
    return build_edit("split_room", at=[1, 5, 0], line=[[x, 4.3], [x, 5.7]])


def test_the_recipe_has_the_rooms_that_tests_speak_of():
    assert label_at(corridor_map(), MIDDLES).tolist() == list(range(9))
    assert len(corridor_map().edges) == 8


def test_a_room_is_split_where_the_line_is():
    map = edited(split())
    assert len(map.rooms) == 10
    assert label_at(map, np.array([(2, 5), (7.8, 5), (8.2, 5), (14, 5)], float)).tolist() == [9, 9, 8, 8]
    assert map.rooms["area"][[8, 9]].sum() == pytest.approx(corridor_map().rooms["area"][8], rel=0.02)
    assert map.rooms["cells"][[8, 9]].sum() == corridor_map().rooms["cells"][8]
    assert map.rooms["centroid"][9, 0] == pytest.approx(4, abs=0.1)
    assert (map.rooms["confidence"][[8, 9]] == 1).all()
    meeting = map.edges[(map.edges["rooms"] == (8, 9)).all(axis=1)]
    assert len(meeting) == 1 and meeting["kind"][0] == "opening" and meeting["width"][0] == pytest.approx(2, abs=0.25)
    assert meeting["centre"][0, :2] == pytest.approx((8, 5), abs=0.1)
    of_doors = {int(e["rooms"][0]): int(e["rooms"][1]) for e in map.edges if e["kind"] == "door"}
    assert of_doors == {0: 9, 1: 9, 2: 9, 3: 9, 4: 8, 5: 8, 6: 8, 7: 8}
    occupied = map.grid.compute_centroids()[map.room == 9]
    assert occupied[:, 0].max() < 8.2


def test_the_larger_side_keeps_the_number():
    assert label_at(edited(split(3.0)), np.array([(1, 5), (8, 5)], float)).tolist() == [9, 8]


def test_a_line_may_be_short_bent_or_long():
    for line in ([[8, 4.9], [8, 5.1]], [[8, 4.2], [8.4, 5], [8, 5.8]], [[8, -5], [8, 15]], [[8, 5.1], [8, 4.9], [8, 4.9]]):
        map = edited(build_edit("split_room", at=[1, 5, 0], line=line))
        assert sorted(label_at(map, np.array([(7, 5), (9, 5)], float)).tolist()) == [8, 9]


def test_a_line_that_is_too_long_cuts_off_no_corners():
    """Along the wall of the corridor it crosses the doorways of all rooms on that side."""
    join = build_edit("join_rooms", at=[[2, 2, 0], [2, 5, 0]])
    map = edited(join, build_edit("split_room", at=[2, 2, 0], line=[[0.0, 4.05], [16, 4.05]]))
    assert len(map.rooms) == 9
    floor = map.navigable.compute_centroids()
    for x in (6, 10, 14):  # the doorways of the others stay with the corridor
        doorway = (np.abs(floor[:, 0] - x) < 0.3) & (np.abs(floor[:, 1] - 4.02) < 0.15)
        assert set(map.navigable_room[doorway].tolist()) == set(corridor_labels(doorway, map))


def corridor_labels(places, map):
    """Labels of places as they were extracted, but for the numbers of the corridor and of the room that was cut off."""
    base = corridor_map().navigable_room[places]
    now = {int(old): int(np.bincount(map.navigable_room[corridor_map().navigable_room == old]).argmax()) for old in range(9)}
    return [now[int(r)] for r in base]


def test_a_line_that_does_not_part_the_room_is_told():
    for line in ([[3, 2], [3, 2]], [[30, 4], [30, 6]], [[0.5, 5], [15.5, 5.0]]):
        edit = build_edit("split_room", at=[1, 5, 0], line=line)
        if line[0][0] == 0.5:  # lengthwise it parts a corridor
            assert len(edited(edit).rooms) == 10
        else:
            assert "edit 1 (split_room) no longer applies: the line does not part room 8" in refusal(edit)


def test_rooms_are_joined_with_their_doors_and_areas():
    map = edited(build_edit("join_rooms", at=[[2, 2, 0], [6, 2, 0], [2, 5, 0]]))
    assert len(map.rooms) == 7
    assert label_at(map, MIDDLES).tolist() == [0, 1, 0, 2, 3, 4, 5, 6, 0]
    assert (map.edges["rooms"][:, 0] == 0).all() and len(map.edges) == 6  # the doors within the room are gone
    assert len(map.narrows) == 2  # but they still part its areas
    assert (map.areas["room"][map.narrows["rooms"]] == 0).all()
    base = corridor_map().rooms
    assert map.rooms["cells"][0] == base["cells"][[0, 2, 8]].sum()
    assert "nothing to join" in refusal(build_edit("join_rooms", at=[[2, 2, 0], [2.5, 2, 0]]))


def test_a_door_is_added_where_a_wall_is():
    map = edited(build_edit("add_door", at=[4, 2, 0], width=1.0, open=False))
    door = map.edges[(map.edges["rooms"] == (0, 2)).all(axis=1)]
    assert len(door) == 1 and not door["open"][0] and door["width"][0] == 1.0 and door["kind"][0] == "door"
    assert min(door["direction"][0], np.pi - door["direction"][0]) < 0.01  # the wall's normal is x
    wide = edited(build_edit("add_door", at=[4, 2, 0], width=3.0))
    assert wide.edges["kind"][(wide.edges["rooms"] == (0, 2)).all(axis=1)] == ["opening"]
    twice = edited(build_edit("add_door", at=[4, 2, 0]), build_edit("add_door", at=[4.1, 2.2, 0], open=False))
    assert len(twice.edges) == 9 and not twice.edges["open"].all()
    assert "split it first" in refusal(build_edit("add_door", at=[2, 2, 0]))
    assert "there is no room" in refusal(build_edit("add_door", at=[40, 2, 0]))
    between = edited(build_edit("add_door", at=[4, 4, 0], between=[[2, 2, 0], [6, 2, 0]]))
    assert (between.edges["rooms"] == (0, 2)).all(axis=1).sum() == 1


def test_doors_are_deleted_moved_and_changed():
    map = edited(build_edit("delete_door", at=[2, 4, 0]))
    assert len(map.edges) == 7 and 0 not in map.edges["rooms"]
    map = edited(build_edit("move_door", at=[2, 4, 0], to=[4, 2, 0]))
    assert (map.edges["rooms"] == (0, 2)).all(axis=1).sum() == 1 and not (map.edges["rooms"] == (0, 8)).all(axis=1).any()
    map = edited(build_edit("set_door", at=[2, 4, 0], open=False))
    assert map.edges["open"].tolist() == [False] + [True] * 7 and map.edges["confidence"][0] == 1
    assert map.edges["width"][0] == corridor_map().edges["width"][0]
    assert "there is no door at (2.00, 2.00, 0.00)" in refusal(build_edit("delete_door", at=[2, 2, 0]))


def test_rooms_are_named_and_described():
    kitchen = build_edit("rename_room", at=[2, 2, 0], name="Kitchen")
    map = edited(kitchen, build_edit("rename_room", at=[2.5, 2, 0], name="Bar"))
    assert find_room_names(map.landmarks, 9)[0] == "Bar" and len(map.landmarks) == 1
    assert not len(edited(kitchen, build_edit("rename_room", at=[2.5, 2, 0], name="")).landmarks)
    map = edited(build_edit("set_room", at=[2, 2, 0], kind="office", outside=True, looked_into=True))
    assert map.landmarks.get_values()[map.landmarks.is_kind("use")].tolist() == ["office"]
    assert map.rooms["outside"][0] == 1 and map.rooms["glimpsed"][0] and map.rooms["entered"][0] == 0
    map = edited(build_edit("assign_area", at=[[2, 2, 0], [6, 2, 0], [2.2, 2, 0]], area="ward A"))
    assert sorted(map.landmarks.table["room"].tolist()) == [0, 2]


def test_a_name_stays_with_its_part_of_a_room():
    name = build_edit("rename_room", at=[3, 5, 0], name="West")
    assert find_room_names(edited(name, split()).landmarks, 10)[9] == "West"
    joined = edited(name, split(), build_edit("join_rooms", at=[[3, 5, 0], [12, 5, 0]]))
    assert find_room_names(joined.landmarks, 9)[8] == "West"


def test_landmarks_are_added_and_deleted():
    sign = build_edit("add_landmark", at=[2.6, 4.2, 1.5], kind="text", value="101")
    chair = build_edit("add_landmark", at=[6, 2, 0.4], kind="object", value="chair")
    map = edited(sign, chair)
    assert map.landmarks.table["room"].tolist() == [0, 2]  # beside its door, a sign is of the room behind it
    left = edited(sign, chair, build_edit("delete_landmark", at=[6.2, 2, 0], kind="object"))
    assert left.landmarks.get_values().tolist() == ["101"]
    assert "there is no tag" in refusal(build_edit("delete_landmark", at=[6.2, 2, 0], kind="tag"))


def test_the_map_that_was_given_stays_as_it_is():
    before = corridor_map().navigable_room.copy(), corridor_map().edges.copy()
    edited(split(), build_edit("delete_door", at=[2, 4, 0]))
    assert (corridor_map().navigable_room == before[0]).all() and (corridor_map().edges == before[1]).all()


PLACES = [[float(x), float(y), 0.05] for x, y in MIDDLES] + [[4.0, 2.0, 0.0], [2.0, 4.0, 0.0], [6.0, 6.0, 0.0], [30.0, 0.0, 0.0]]
place = st.sampled_from(PLACES)
line = st.lists(st.tuples(st.floats(0, 16), st.floats(0, 10)).map(list), min_size=2, max_size=3)
any_edit = st.one_of(
    st.builds(lambda at, line: build_edit("split_room", at=at, line=line), place, line),
    st.builds(lambda at: build_edit("join_rooms", at=at), st.lists(place, min_size=2, max_size=3)),
    st.builds(lambda at, open: build_edit("add_door", at=at, open=open), place, st.sampled_from([None, True, False])),
    st.builds(lambda at: build_edit("delete_door", at=at), place),
    st.builds(lambda at, to: build_edit("move_door", at=at, to=to), place, place),
    st.builds(lambda at, name: build_edit("rename_room", at=at, name=name), place, st.sampled_from(["A", "B", ""])),
)
FEW = settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))


@FEW
@given(st.lists(any_edit, max_size=6), st.integers(0, 6))
@pytest.mark.longer
def test_any_edits_give_a_sound_map_and_the_same_one_again(edits, cut):
    done = apply_edits(corridor_map(), edits)
    assert_same_map(done.map, apply_edits(corridor_map(), edits).map)
    map, base = done.map, corridor_map()
    assert ((map.navigable_room >= 0) == (base.navigable_room >= 0)).all() and ((map.room >= 0) == (base.room >= 0)).all()
    assert np.unique(map.navigable_room).tolist() == list(range(len(map.rooms)))  # no room without a floor
    assert map.rooms["area"].sum() == pytest.approx(base.rooms["area"].sum(), rel=0.05)
    for pair in map.edges["rooms"], map.narrows["rooms"]:
        assert (pair[:, 0] < pair[:, 1]).all()
    assert len(done.applied) + len(done.refused) == len(edits)
    stepwise = apply_edits(apply_edits(base, edits[:cut]).map, edits[cut:]).map
    assert_same_map(map, stepwise)
    assert map.parameters.get("edits") == stepwise.parameters.get("edits") == (len(done.applied) or None)


@FEW
@given(st.lists(any_edit, max_size=4), any_edit)
def test_undo_takes_an_edit_back(edits, last):
    before, journal = apply_edits(corridor_map(), edits), [*edits, last]
    after = apply_edits(corridor_map(), [*journal, build_undo(journal)])
    assert_same_map(before.map, after.map)
    assert [r.reason for r in before.refused] == [r.reason for r in after.refused]


@FEW
@given(place, line)
def test_a_room_that_is_split_and_joined_is_what_it_was(at, line):
    base = corridor_map()
    cut = apply_edits(base, [build_edit("split_room", at=at, line=line)])
    if not cut.applied:
        return
    room = len(base.rooms)
    own = int(base.navigable_room[np.flatnonzero(cut.map.navigable_room == room)[0]])
    ends = [cut.map.navigable.compute_centroids(cut.map.navigable.cells[cut.map.navigable_room == r][:1])[0] for r in (own, room)]
    back = apply_edits(cut.map, [build_edit("join_rooms", at=np.array(ends))]).map
    assert (back.room == base.room).all() and (back.navigable_room == base.navigable_room).all()
    assert back.edges.tobytes() == base.edges.tobytes()
    for name in set(base.rooms.dtype.names) - {"confidence"}:
        assert back.rooms[name] == pytest.approx(base.rooms[name]), name


@pytest.mark.longer
def test_a_journal_holds_on_a_map_that_was_extracted_again():
    """The second map has other voxels; its rooms have the same places."""
    edits = [
        split(),
        build_edit("join_rooms", at=[[2, 2, 0.05], [6, 2, 0.05]]),
        build_edit("add_door", at=[8, 8, 0.05]),
        build_edit("delete_door", at=[14, 4, 0.05]),
        build_edit("rename_room", at=[14, 8, 0.05], name="Lab"),
    ]
    base, other = corridor_map(), corridor_map(0.08)
    first, second = (apply_edits(map, edits) for map in (base, other))
    assert not first.refused and not second.refused
    x, y = np.meshgrid(np.arange(0.25, 16, 0.1), np.arange(0.25, 10, 0.1))
    places = np.column_stack([x.ravel(), y.ravel()])
    a, b = (label_at(done.map, places) for done in (first, second))
    both = (a >= 0) & (b >= 0)
    assert both.mean() > 0.8
    for room in range(len(first.map.rooms)):
        partner = np.bincount(b[both & (a == room)]).argmax()
        union = both & ((a == room) | (b == partner))
        assert (both & (a == room) & (b == partner)).sum() / union.sum() > 0.95
    assert len(first.map.edges) == len(second.map.edges)


def test_what_no_longer_applies_is_told_line_by_line():
    done = tm.apply_edits(
        corridor_map(),
        [
            build_edit("rename_room", at=[2, 2, 0], name="Kitchen"),
            build_edit("delete_door", at=[40, 2, 0]),
            build_edit("undo", edit="nobody"),
            build_edit("reject_merge", maps=[0, 1]),
        ],
    )
    assert [(refused.line, refused.edit.op) for refused in done.refused] == [(2, "delete_door"), (3, "undo"), (4, "reject_merge")]
    assert done.map.parameters["edits"] == 1
    assert all(str(refused).count("\n") == 0 for refused in done.refused)
