"""A building's floor plan as a map: walls where rooms end, open doors, in the frame of the pair's second map."""

from __future__ import annotations

import pytest
import shapely
from scipy.spatial import cKDTree
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.pairs.drawing import draw
from topomerge.datasets.pairs.flat_maps import extrude_flat

from topomerge.extraction.extract import extract


def test_walls_stand_where_rooms_end_and_doors_are_open() -> None:
    building = make_building("house", 3)
    flat = draw(building)
    rooms = shapely.union_all([shapely.Polygon(r.polygon) for r in building.rooms])
    inside = shapely.contains_xy(rooms.buffer(-0.1), *flat.walls.T)
    assert inside.mean() < 0.01  # no furniture
    free = shapely.union_all(shapely.points(flat.free)[::7]).buffer(0.1)
    inner = building.doors[(building.doors["rooms"] >= 0).all(axis=1)]
    assert shapely.distance(free, shapely.points(inner["centre"][:, :2])).max() < 0.2
    map = extract(extrude_flat(flat), carve=False)
    assert abs(len(map.rooms) - len(building.rooms)) <= 2 and len(map.edges) >= 0.7 * len(inner)


@pytest.mark.longer
def test_the_upper_storey_has_its_own_rooms_and_doors() -> None:
    building = make_building("office", 5, 2)
    for storey in range(2):
        flat = draw(building, storey)
        own = [r for r in building.rooms if r.storey == storey]
        rooms = shapely.union_all([shapely.Polygon(r.polygon) for r in own])
        assert shapely.contains_xy(rooms.buffer(0.3), *flat.free.T).mean() > 0.95
        inner = building.doors[(building.doors["rooms"] >= 0).all(axis=1)]
        inner = inner[[building.rooms[i].storey == storey for i in inner["rooms"][:, 0]]]
        assert cKDTree(flat.free[::5]).query(inner["centre"][:, :2])[0].max() < 0.3
