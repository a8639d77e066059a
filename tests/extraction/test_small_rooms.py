"""Small rooms of slices that no door parts from a neighbour are parts of it; larger rooms, and those behind doors, stay."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.scenes import Scene
from topomerge.extraction import small_rooms
from topomerge.extraction.extract import extract, rooms_and_passages
from topomerge.extraction.floor import Floor
from topomerge.extraction.parameters import PRESETS
from topomerge.extraction.small_rooms import without_small_rooms
from topomerge.extraction.stopwatch import Stopwatch
from topomerge.extraction.topology import topometric_map
from topomerge.types import Array, TopometricMap

FIRST, SECOND, THIRD, CORRIDOR = (1.2, 3.75), (3.6, 3.75), (7.0, 3.75), (4.5, 1.2)  # a place in each room


def slice_of_four_rooms() -> Array:
    """A corridor of 9 x 2.5 m and three rooms behind it, two of 6 m2 with a door between them and one of 10 m2, at 0.4 m."""
    scene = Scene().shell(0, 0, 9, 5).wall((0, 2.5), (9, 2.5), doors=(1.2, 3.6, 7.0))
    scene.wall((2.4, 2.5), (2.4, 5), doors=(1.25,)).wall((4.8, 2.5), (4.8, 5))
    points = scene.points()
    points = points[np.abs(points[:, 2] - 1.0) < 0.1]
    points[:, 2] = 0.4
    return points


@pytest.fixture(scope="module")
def cut() -> tuple[Floor, TopometricMap, Callable[[Floor], TopometricMap]]:
    """The floor before small rooms are looked at, its map, and what makes maps of floors."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("topomerge.extraction.extract.without_small_rooms", lambda floor, map: floor)
        parameters = PRESETS["default"]
        scan, _, floor, map = rooms_and_passages(slice_of_four_rooms(), 0.1, parameters, Stopwatch(None))
    return floor, map, lambda floor: topometric_map(scan.grid, floor, parameters.standing_height)


def room_at(map: TopometricMap, place: tuple[float, float]) -> int:
    """The room of the navigable cell nearest to a place."""
    cells = map.navigable.centroids()
    return int(map.navigable_room[np.hypot(*(cells[:, :2] - place).T).argmin()])


def merged(cut, monkeypatch: pytest.MonkeyPatch, chance: dict[frozenset[tuple[float, float]], float]) -> TopometricMap:
    """The map where the passages between two places have these chances to be doors, all others .9."""
    floor, map, of = cut
    rooms = {frozenset(room_at(map, place) for place in pair): likely for pair, likely in chance.items()}

    def stated(map: TopometricMap, storeys: object, edges: Array) -> Array:
        return np.array([rooms.get(frozenset(edge["rooms"].tolist()), 0.9) for edge in edges])

    monkeypatch.setattr(small_rooms, "flat_door_chance", stated)
    return of(without_small_rooms(floor, map))


def test_the_slice_has_four_rooms(cut):
    _, map, _ = cut
    assert len({room_at(map, place) for place in (FIRST, SECOND, THIRD, CORRIDOR)}) == 4 == len(map.rooms)
    assert len(map.edges) == 4


def test_likely_doors_change_nothing(cut, monkeypatch):
    map = merged(cut, monkeypatch, {})
    assert np.array_equal(map.navigable_room, cut[1].navigable_room) and np.array_equal(map.rooms, cut[1].rooms)


def test_a_small_room_without_a_door_is_part_of_its_neighbour(cut, monkeypatch):
    map, before = merged(cut, monkeypatch, {frozenset((FIRST, CORRIDOR)): 0.1, frozenset((FIRST, SECOND)): 0.1}), cut[1]
    assert room_at(map, FIRST) == room_at(map, CORRIDOR) != room_at(map, SECOND) and len(map.rooms) == 3
    whole = before.rooms["area"][[room_at(before, FIRST), room_at(before, CORRIDOR)]].sum()
    assert map.rooms["area"][room_at(map, CORRIDOR)] == pytest.approx(whole, rel=0.1)
    parts = before.rooms["completeness"][[room_at(before, FIRST), room_at(before, CORRIDOR)]]
    assert parts.min() <= map.rooms["completeness"][room_at(map, CORRIDOR)] <= parts.max()
    assert set(map.areas["room"].tolist()) <= set(range(3)) and (map.navigable_room < 3).all()


def test_what_a_likely_door_parts_elsewhere_stays_parted(cut, monkeypatch):
    """The first room joins the corridor, from which a door parts the second: a gap to the first does not join that, too."""
    map = merged(cut, monkeypatch, {frozenset((FIRST, CORRIDOR)): 0.05, frozenset((FIRST, SECOND)): 0.2})
    assert room_at(map, SECOND) != room_at(map, CORRIDOR) == room_at(map, FIRST)


def test_larger_rooms_stay(cut, monkeypatch):
    map = merged(cut, monkeypatch, {frozenset((THIRD, CORRIDOR)): 0.0})
    assert len(map.rooms) == 4


def test_all_in_one(cut, monkeypatch):
    none = {frozenset(pair): 0.0 for pair in ((FIRST, CORRIDOR), (SECOND, CORRIDOR), (FIRST, SECOND), (THIRD, CORRIDOR))}
    map = merged(cut, monkeypatch, none)
    assert len(map.rooms) == 2 and room_at(map, FIRST) == room_at(map, SECOND) == room_at(map, CORRIDOR)


def test_real_doors_of_small_rooms_stay():
    assert len(extract(slice_of_four_rooms()).rooms) == 4
