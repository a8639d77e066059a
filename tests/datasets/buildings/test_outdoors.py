"""What stands around a building: outside of its walls, on the ground, and the building itself as before."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from topomerge.datasets.buildings.outdoors import add_outdoors, compute_footprint
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import SURFACES


@pytest.mark.parametrize("seed", range(4))
def test_the_surroundings_lie_outside(seed: int) -> None:
    house = make_building("house", 11)
    wide = add_outdoors(house, np.random.default_rng(seed))
    again = add_outdoors(house, np.random.default_rng(seed))
    count = len(house.triangles)
    assert np.array_equal(wide.triangles[:count], house.triangles) and np.array_equal(wide.vertices, again.vertices)
    assert len(wide.triangles) > count + 100 and (wide.labels[count:] == SURFACES.index("facade")).all()
    middle = wide.vertices[wide.triangles[count:]].mean(axis=1)
    assert not shapely.contains_xy(compute_footprint(house), middle[:, :2]).any()
    ground = middle[:, 2] < float(house.storeys["floor"][0]) + 0.2
    assert ground.sum() > 100 and wide.rooms == house.rooms
