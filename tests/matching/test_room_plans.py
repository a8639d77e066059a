"""A finished map seen from above, with its rooms."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tests.scenes_map import building
from topomerge.matching.consistency import find_matches
from topomerge.matching.room_plans import RoomPlans, build_room_plans
from topomerge.types import Sim3


def test_rooms_lie_on_one_raster_with_the_walls():
    map = building(2)
    plans = build_room_plans(map)
    assert plans.walls.shape == plans.label.shape == (len(map.storeys), *map.grid.shape[:2])
    assert plans.walls.any() and np.allclose(plans.floors, map.storeys["floor"]) and len(plans.areas) == len(map.rooms)
    assert (plans.distance[plans.walls] == 0).all() and len(plans.fields) == len(plans.plans)
    places, storey, is_wall, each = plans.sample_columns(50)
    assert len(places) == len(storey) <= 100 and is_wall.sum() == 50 and (each >= 1).all()


def test_a_map_on_itself_has_all_rooms_in_common():
    plans = build_room_plans(building(2))
    rooms, fit = find_matches(Sim3(), (plans, plans))
    assert rooms.tolist() == [[k, k] for k in range(len(plans.areas))] and np.allclose(fit, 1.0)
    assert not len(find_matches(Sim3(0.0, (0.0, 0.0, 20.0)), (plans, plans))[0])


def test_each_room_has_the_area_of_its_columns():
    map = building(2)
    plans = build_room_plans(map)
    assert plans.areas[:4] == pytest.approx(map.rooms["area"][:4]) and plans.areas[4] == pytest.approx(
        map.rooms["area"][4] + 4 * 0.1
    )
    x, y = np.argwhere(plans.label[0] == 2).mean(axis=0) * 0.1 + plans.origin + 0.05
    assert (x, y) == pytest.approx(tuple(map.rooms["centroid"][2, :2]), abs=0.01)


def test_the_middle_is_that_of_the_columns_on_the_lowest_floor():
    map = building(2)
    low, high = map.rooms["lo"].min(axis=0), map.rooms["hi"].max(axis=0)
    assert build_room_plans(map).middle == pytest.approx([*(low + high)[:2] / 2, map.storeys["floor"][0]], abs=0.01)


def test_samples_spread_over_all_walls_and_stand_for_their_share():
    plans = build_room_plans(building(1))
    places, _, is_wall, each = plans.sample_columns(100)
    walls = (np.argwhere(plans.walls[0]) + 0.5) * 0.1 + plans.origin
    assert np.allclose(places[is_wall][[0, -1]], walls[[0, -1]])
    assert is_wall.sum() * each[0] == pytest.approx(len(walls)) and (~is_wall).sum() * each[1] == pytest.approx(plans.floor.sum())
    every, _, is_wall, each = plans.sample_columns(10**6)
    assert np.allclose(every[is_wall], walls) and each.tolist() == [1, 1]


def drawn(angle: float) -> np.ndarray:
    """(1, n, n) columns of two walls, 60 x 25 columns long, that meet at a right angle; degrees."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    image = np.zeros((1, 140, 140), bool)
    for (u, v), length in (((c, s), 60), ((-s, c), 25)):
        steps = np.arange(0, length, 0.3)
        image[0, np.rint(60 + u * steps).astype(int), np.rint(60 + v * steps).astype(int)] = True
    return image


@pytest.mark.parametrize("angle", [0.0, 20.0, 65.0])
def test_the_direction_of_walls(angle):
    direction, share = RoomPlans.direction.func(SimpleNamespace(walls=drawn(angle)))
    assert np.degrees(direction - np.radians(angle) + 1) % 90 == pytest.approx(np.degrees(1), abs=2.0) and 0.5 < share <= 1
    both = np.concatenate([drawn(angle), drawn(angle + 45)])
    assert RoomPlans.direction.func(SimpleNamespace(walls=both))[1] < 0.2  # all ways
