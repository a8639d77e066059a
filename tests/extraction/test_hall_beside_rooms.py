"""A hall through two storeys' height beside low rooms, seen from outside as well: the low rooms' flat roof is no storey."""

from __future__ import annotations

import numpy as np
import pytest

import topomerge as tm
from tests.scenes import Scene


def gym(parapet: float = 0.0, slab: float = 0.3, hall: float = 7.0) -> np.ndarray:
    """The surfaces of a mesh: four low rooms, 8 x 10 m, and a hall of 14 x 10 m, with the upper sides of both roofs."""
    low = 3.0 + slab
    scene = Scene().floor(0, 0, 8, 10).floor(0, 0, 8, 10, 3.0).floor(-0.2, -0.2, 8, 10.2, low)
    scene.floor(8.2, 0, 22, 10).floor(8.2, 0, 22, 10, hall).floor(8, -0.2, 22.2, 10.2, hall + slab)
    scene.wall((-0.1, -0.1), (8.1, -0.1), 0, low + parapet, doors=(4.0,))
    for a, b in (((-0.1, -0.1), (-0.1, 10.1)), ((-0.1, 10.1), (8.1, 10.1))):
        scene.wall(a, b, 0, low + parapet)
    scene.wall((8.1, -0.1), (8.1, 10.1), 0, hall + slab, doors=(2.5, 7.5))
    for a, b in (((22.1, -0.1), (22.1, 10.1)), ((8.1, -0.1), (22.1, -0.1)), ((8.1, 10.1), (22.1, 10.1))):
        scene.wall(a, b, 0, hall + slab)
    return scene.wall((4, 0), (4, 10), 0, 3.0, doors=(2.5, 7.5)).wall((0, 5), (8, 5), 0, 3.0).points()


@pytest.mark.parametrize("more", [{}, {"parapet": 0.6}, {"slab": 0.6}, {"hall": 5.6}])
def test_the_flat_roof_beside_a_hall_is_no_storey(more: dict[str, float]) -> None:
    map = tm.extract(gym(**more))
    assert len(map.storeys) == 1 and len(map.rooms) == 5
    assert np.allclose(np.sort(map.rooms["area"])[:4], 20, atol=1.0) and abs(map.rooms["area"].max() - 140) < 3


@pytest.mark.parametrize("ceiling", [True, False])
def test_rooms_upstairs_beside_a_hall_are_a_storey(ceiling: bool) -> None:
    """The same with two rooms on the low ones; also where their own ceiling was not scanned."""
    points = [gym()]
    upstairs = Scene().wall((0.0, 0.0), (8.0, 0.0), 3.3, 2.6).wall((0.0, 10.0), (8.0, 10.0), 3.3, 2.6)
    upstairs.wall((0.0, 0.0), (0.0, 10.0), 3.3, 2.6).wall((0, 5), (8, 5), 3.3, 2.6, doors=(4.0,))
    if ceiling:
        upstairs.floor(0, 0, 8, 10, 5.9)
    map = tm.extract(np.concatenate([*points, upstairs.points()]))
    upper = map.rooms["area"][map.rooms["storey"] == 1]
    assert len(map.storeys) == 2 and np.isclose(upper, 40, atol=4).sum() == 2
