"""A finished map seen from above, with its rooms."""

from __future__ import annotations

import numpy as np

from tests.scenes_map import building
from topomerge.matching.consistency import matches_under
from topomerge.matching.room_plans import room_plans
from topomerge.types import Sim3


def test_rooms_lie_on_one_raster_with_the_walls():
    map = building(2)
    plans = room_plans(map)
    assert plans.walls.shape == plans.label.shape == (len(map.storeys), *map.grid.shape[:2])
    assert plans.walls.any() and np.allclose(plans.floors, map.storeys["floor"]) and len(plans.areas) == len(map.rooms)
    assert (plans.distance[plans.walls] == 0).all() and len(plans.fields) == len(plans.plans)
    places, storey, is_wall, each = plans.samples(50)
    assert len(places) == len(storey) <= 100 and is_wall.sum() == 50 and (each >= 1).all()


def test_a_map_on_itself_has_all_rooms_in_common():
    plans = room_plans(building(2))
    rooms, fit = matches_under(Sim3(), (plans, plans))
    assert rooms.tolist() == [[k, k] for k in range(len(plans.areas))] and np.allclose(fit, 1.0)
    assert not len(matches_under(Sim3(0.0, (0.0, 0.0, 20.0)), (plans, plans))[0])
