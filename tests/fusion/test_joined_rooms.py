"""Rooms of joined maps are those of their parts; only what parts see differently is cut anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import topomerge as tm
from tests.fusion.atlas.atlas_scenes import office_map, truth
from tests.scenes import Scene, two_rooms
from topomerge.fusion import fuse as fusion
from topomerge.fusion import joined_rooms
from topomerge.fusion.fuse import fuse
from topomerge.fusion.joined_rooms import find_common_floor, unite_rooms
from topomerge.types import Sim3, TopometricMap

COLUMN = 1.0  # m2: numbers of columns are areas


def count_calls(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """How often maps were extracted, and floor was cut anew, from now on."""
    calls = {"extract": 0, "cut_rooms": 0}

    def count(module: object, name: str) -> None:
        original = getattr(module, name)

        def counted(*args: object, **keywords: object) -> object:
            calls[name] += 1
            return original(*args, **keywords)

        monkeypatch.setattr(module, name, counted)

    count(fusion, "extract")
    count(joined_rooms, "cut_rooms")
    return calls


def claim(*parts: dict[int, tuple[int, int]]) -> np.ndarray:
    """(parts, 100) rooms of parts that begin and end at columns."""
    out = np.full((len(parts), 100), -1)
    for row, rooms in zip(out, parts, strict=True):
        for room, (first, last) in rooms.items():
            row[first:last] = room
    return out


def unite(claims: np.ndarray, entered: tuple[bool, ...], part_of: tuple[int, ...]) -> tuple[list[int], list[bool]]:
    group, doubt = unite_rooms(claims, np.array(entered), np.array(part_of), COLUMN)
    return group.tolist(), doubt.tolist()


def test_common_floor_is_counted_for_each_pair():
    pairs, columns = find_common_floor(claim({0: (0, 30), 1: (30, 50)}, {2: (10, 40)}))
    assert pairs.tolist() == [[0, 2], [1, 2]] and columns.tolist() == [20, 10]


def test_rooms_that_share_their_floor_are_one():
    assert unite(claim({0: (0, 30), 1: (31, 60)}, {2: (1, 30), 3: (70, 90)}), (True,) * 4, (0, 0, 1, 1)) == (
        [0, 1, 0, 2],
        [False] * 3,
    )


def test_a_glimpse_is_of_the_room_that_somebody_was_in():
    """Not the other way round: an outline that nobody was in says nothing of the floor beyond."""
    assert unite(claim({0: (0, 30)}, {1: (20, 30)}), (True, False), (0, 1)) == ([0, 0], [False])
    assert unite(claim({0: (0, 30)}, {1: (20, 30)}), (False, True), (0, 1)) == ([0, 0], [True])


def test_two_rooms_in_one_are_doubtful():
    """Whether somebody was in both or not; rooms that somebody was in are never one by a glimpse."""
    claims = claim({0: (0, 20), 1: (20, 40)}, {2: (0, 40)})
    assert unite(claims, (True, True, True), (0, 0, 1)) == ([0, 1, 0], [True, True])
    assert unite(claims, (False, False, True), (0, 0, 1)) == ([0, 0, 0], [True])
    group, _ = unite(claims, (True, True, False), (0, 0, 1))
    assert group[0] != group[1]


def test_rooms_that_overlap_in_part_are_doubtful_and_strips_along_walls_are_not():
    assert unite(claim({0: (0, 40)}, {1: (30, 70)}), (True, True), (0, 1)) == ([0, 1], [True, True])
    assert unite(claim({0: (0, 40)}, {1: (39, 79)}), (True, True), (0, 1)) == ([0, 1], [False, False])


@pytest.fixture(scope="module")
def rooms() -> TopometricMap:
    return tm.extract(two_rooms().points().astype(np.float32), name="rooms")


def test_what_parts_agree_on_is_not_cut_again(rooms, monkeypatch):
    """A map laid on itself: nothing is extracted, no floor is cut, all is as it was."""
    calls = count_calls(monkeypatch)
    joined = fuse((rooms, rooms), [(0, Sim3()), (1, Sim3())])
    assert calls == {"extract": 0, "cut_rooms": 0}
    assert len(joined.rooms) == len(rooms.rooms) == 2
    for name in ("area", "centroid", "confidence", "whole", "entered", "completeness", "storey"):
        assert np.allclose(joined.rooms[name], rooms.rooms[name]), name
    assert (joined.navigable.cells == rooms.navigable.cells).all()
    assert (joined.navigable.properties["standing"] == rooms.navigable.properties["standing"]).all()
    assert len(joined.edges) == len(rooms.edges) and np.allclose(joined.edges["confidence"], rooms.edges["confidence"])
    assert np.allclose(joined.edges["centre"], rooms.edges["centre"])
    assert len(joined.areas) == len(rooms.areas) and len(joined.narrows) == len(rooms.narrows)
    assert (joined.room == rooms.room).all()


def test_a_merge_of_two_extracted_maps_extracts_nothing(monkeypatch):
    a, b = office_map(0), office_map(2)
    calls = count_calls(monkeypatch)
    joined = fuse((a, b), [(0, Sim3()), (1, truth(0, 2))])
    assert calls["extract"] == 0 and calls["cut_rooms"] <= 1
    assert len(joined.rooms) > max(len(a.rooms), len(b.rooms))


def test_a_hall_that_both_saw_half_of_is_one_room(monkeypatch):
    """Their floors meet and no map has both: that border is looked at."""
    points = Scene().shell(0, 0, 12, 6).points().astype(np.float32)
    west, east = (tm.extract(points[side], name="half") for side in (points[:, 0] < 6.1, points[:, 0] > 5.9))
    calls = count_calls(monkeypatch)
    joined = fuse((west, east), [(0, Sim3()), (1, Sim3())])
    assert calls == {"extract": 0, "cut_rooms": 1}
    assert len(joined.rooms) == 1 and joined.rooms["area"][0] == pytest.approx(72, rel=0.06)


def test_a_room_that_one_map_cut_in_two_is_looked_at_again(rooms, monkeypatch):
    """By a line that nothing shows, in the room in which the other map has no such line: the joined cells decide."""
    west = (rooms.navigable.compute_centroids()[:, 0] < 2.0) & (rooms.navigable_room == 0)
    table = np.append(rooms.rooms, rooms.rooms[:1])
    cut = replace(rooms, rooms=table, navigable_room=np.where(west, 2, rooms.navigable_room).astype(np.int32))
    calls = count_calls(monkeypatch)
    joined = fuse((rooms, cut), [(0, Sim3()), (1, Sim3())])
    assert calls == {"extract": 0, "cut_rooms": 1} and 2 <= len(joined.rooms) <= 3
    assert (joined.navigable_room >= 0).mean() > 0.99


@pytest.mark.longer
def test_floor_of_the_thesis_preset_is_cut_anew(monkeypatch):
    """It does not reach the walls."""
    points = two_rooms().points().astype(np.float32)
    thesis, ours = tm.extract(points, preset="thesis", name="thesis"), tm.extract(points, name="ours")
    calls = count_calls(monkeypatch)
    joined = fuse((thesis, ours), [(0, Sim3()), (1, Sim3())])
    assert calls["cut_rooms"] == 1 and len(joined.rooms) == 2
    assert joined.rooms["area"].sum() == pytest.approx(ours.rooms["area"].sum(), rel=0.05)


def test_maps_without_rooms_are_extracted_together(rooms, monkeypatch):
    none = select_none(rooms)
    calls = count_calls(monkeypatch)
    joined = fuse((none, none), [(0, Sim3()), (1, Sim3())])
    assert calls["extract"] == 1 and len(joined.rooms) == 2


def select_none(map: TopometricMap) -> TopometricMap:
    """The map without its rooms."""
    from topomerge.types import select_rooms

    return select_rooms(map, np.zeros(len(map.rooms), bool))
