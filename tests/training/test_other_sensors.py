"""What another sensor, walk or day would have left of a map: against scenes whose result is plain."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.embedding.surroundings import SHEET_PLANES
from topomerge.kernels.rays import find_lit_pixels
from topomerge.training.batches import (
    HIGH,
    LOW,
    OPAQUE,
    WALL,
    drop_patches,
    roughen_walls,
    simulate_partial_walk,
    simulate_slice,
    warp_planes,
)

SIDE = 60


def two_rooms() -> tuple[np.ndarray, ...]:
    """Two rooms of 28 by 28 pixels beside each other, whose wall has a door of four pixels; middles and doors of both."""
    planes, room = np.zeros((SIDE, SIDE, len(SHEET_PLANES)), np.uint8), np.full((SIDE, SIDE), -1, np.int16)
    planes[1:30, 1:30, 1] = planes[31:59, 1:30, 1] = 255
    room[1:30, 1:30], room[31:59, 1:30] = 0, 1
    for at in (np.s_[0, :31], np.s_[59, :31], np.s_[:, 0], np.s_[:, 30], np.s_[30, :13], np.s_[30, 17:31]):
        planes[at][..., WALL] = 255
    anchor, doors = np.array([[15.0, 15.0], [45.0, 15.0]]), np.full((2, 3, 2), np.nan)
    doors[:, 0] = 30.5, 15.0
    return planes, room, anchor, doors


def test_light_falls_through_the_door_only_and_ends_at_walls():
    planes, _, _, _ = two_rooms()
    seen = find_lit_pixels(planes[..., WALL] >= OPAQUE, np.array([[15, 15]]), 56.0)
    assert seen[2:29, 2:29].all() and seen[0, 15] and not seen[:, 31:].any()
    through = seen[31:59, 1:30]
    assert through[:, 13].all() and 0.1 < through.mean() < 0.6 and not through[:5, :5].any()
    assert not find_lit_pixels(planes[..., WALL] >= OPAQUE, np.array([[15, 15]]), 10.0)[27:].any()


def test_a_walk_sees_the_rooms_it_enters_and_a_part_of_the_others(monkeypatch):
    from topomerge.training import batches

    planes, room, anchor, doors = two_rooms()
    monkeypatch.setattr(batches, "ENTERED", (1.0, 1.0))
    monkeypatch.setattr(batches, "SENSOR_REACH", (56.0, 56.0))
    all_planes, all_rooms = simulate_partial_walk(planes, room, anchor, doors, np.random.default_rng(0))
    assert (all_rooms == room).mean() > 0.99 and ((all_planes == planes) | (all_planes == 0)).all()
    monkeypatch.setattr(batches, "ENTERED", (0.0, 0.0))
    monkeypatch.setattr(batches, "SENSOR_REACH", (8.0, 8.0))
    some_planes, some = simulate_partial_walk(planes, room, anchor, doors, np.random.default_rng(0))
    for number in (0, 1):
        assert 0.05 < (some == number).sum() / (room == number).sum() < 0.3
    assert (some_planes[some == -1][:, 1] == 0).all()


def test_rooms_without_doors_are_entered():
    planes, room, anchor, doors = two_rooms()
    seen = simulate_partial_walk(planes, room, anchor, np.full_like(doors, np.nan), np.random.default_rng(3))[1]
    assert {0, 1} <= set(np.unique(seen))


def test_a_slice_shows_high_things_as_walls_and_nothing_else():
    planes = two_rooms()[0]
    planes[5, 5, HIGH], planes[8, 8, LOW] = 200, 200
    shown = [simulate_slice(planes, np.random.default_rng(seed)) for seed in range(8)]
    assert all(one[5, 5, WALL] == 200 and not one[..., [LOW, HIGH]].any() for one in shown)
    assert {int(one[8, 8, WALL]) for one in shown} == {0, 200}
    assert all((one[..., 1] == planes[..., 1]).all() for one in shown)


def test_rough_walls_lose_pixels_or_are_thicker():
    planes = two_rooms()[0]
    shares = {(roughen_walls(planes, np.random.default_rng(seed))[..., WALL] > 0).sum() for seed in range(8)}
    plain = (planes[..., WALL] > 0).sum()
    assert min(shares) < plain < max(shares) <= 3 * plain and min(shares) > 0.5 * plain


@pytest.mark.parametrize(("tilt", "zoom"), [(0.0, 1.0), (0.2, 1.0), (0.0, 1.2), (-0.3, 0.9)])
def test_places_go_where_their_pixels_go(tilt, zoom):
    """A mark of three by three pixels is about its place after all was turned, stretched and bent."""
    planes, room, _, doors = two_rooms()
    planes[44:47, 14:17, LOW] = 255
    there = np.array([[45.5, 15.5]])
    seen, rooms, (moved, nothing) = warp_planes(planes, room, (there, doors), tilt, zoom, 1.0, np.random.default_rng(1))
    marked = np.argwhere(seen[..., LOW] == 255) + 0.5
    assert np.abs(marked.mean(axis=0) - moved[0]).max() < 1.0 and np.isnan(nothing[0, 1]).all()
    assert abs((rooms == 1).sum() / ((room == 1).sum() * zoom**2) - 1) < 0.1


def test_nothing_bent_is_as_it_was():
    planes, room, anchor, doors = two_rooms()
    seen, rooms, (moved, _) = warp_planes(planes, room, (anchor, doors), 0.0, 1.0, 0.0, np.random.default_rng(0))
    x, y = (moved[0] - anchor[0]).astype(int)
    assert (seen[x : x + SIDE, y : y + SIDE] == planes).all() and (rooms[x : x + SIDE, y : y + SIDE] == room).all()


def test_gaps_are_empty_and_the_input_stays():
    planes, room, _, _ = two_rooms()
    before = planes.copy()
    seen, rooms = drop_patches(planes, room, np.random.default_rng(5))
    assert (planes == before).all() and (seen[rooms != room] == 0).all()
