"""True rooms of maps whose cells are not where the points are: a slice that was made into walls and a floor.

A building's floor plan as a map: walls where rooms end, open doors, in the frame of the pair's second map.
"""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from scipy.spatial import cKDTree
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.pairs.drawing import draw
from topomerge.datasets.pairs.flat_maps import extrude_flat
from topomerge.datasets.pairs.parts import label_cells, match_true_rooms

from topomerge.extraction.extract import extract
from topomerge.types import PointCloud, TrueRoom


def slice_of_two_rooms() -> PointCloud:
    """Two rooms of 4 by 4 m with a door of 1 m between them, cut at 0.3 m, in a frame whose heights begin at 0.3 m."""
    along = np.arange(0, 4, 0.04) + 0.02
    side = [np.stack([along, np.full_like(along, y)], axis=1) for y in (0.0, 4.0)]
    end = np.stack([np.zeros_like(along), along], axis=1)
    between = end[(along < 1.5) | (along > 2.5)] + [4.0, 0]
    left = np.concatenate([*side, end, between - [0.02, 0]])
    right = np.concatenate([*(s + [4.0, 0] for s in side), end + [8.0, 0], between + [0.02, 0]])
    points = np.concatenate([left, right])
    points = np.column_stack([points, np.full(len(points), 0.05)]).astype(np.float32)
    labels = np.repeat(np.array([0, 1], np.int32), [len(left), len(right)])
    square = np.array([[0, 0], [4, 0], [4, 4], [0, 4.0]])
    rooms = (TrueRoom("left", square, -0.3, 2.5), TrueRoom("right", square + [4, 0], -0.3, 2.5))
    return PointCloud(points, labels=labels, rooms=rooms)


@pytest.mark.parametrize("uneven", [0.0, 0.12])  # m: with it some points lie in the walls and some below them
def test_a_slice_labels_the_walls_that_were_made_of_it(uneven: float) -> None:
    cloud = slice_of_two_rooms()
    cloud.points[:, 2] += uneven * (np.arange(len(cloud)) % 2)
    map = extract(cloud, voxel_size=0.1, carve=False)
    assert "slice" in " ".join(map.warnings)
    labels = label_cells(map, cloud)
    assert (labels >= 0).mean() > 0.95
    places = map.grid.compute_centroids()
    clear = np.abs(places[:, 0] - 4) > 0.2
    assert (labels[clear & (labels >= 0)] == (places[clear & (labels >= 0), 0] > 4)).all()
    truth = match_true_rooms(map, cloud)
    assert sorted(truth["room"][truth["one"]].tolist()) == [0, 1] and truth["iou"][truth["one"]].min() > 0.6


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
