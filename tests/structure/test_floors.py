"""Floors as polygons: the known rooms, straight walls, no overlap, wherever the map lies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely

import topomerge
from tests.io.export_maps import AT, GRID, flat, nothing, rectangles
from tests.scenes import two_rooms
from tests.scenes_map import building
from topomerge.structure.floors import build_floor_polygons, compute_jambs, find_inside_point, measure_room_levels
from topomerge.types import EDGE_DTYPE


def overlap(a: shapely.Geometry, b: shapely.Geometry) -> float:
    return a.intersection(b).area / a.union(b).area


def corners(floor: shapely.MultiPolygon) -> int:
    return sum(len(ring.coords) - 1 for part in floor.geoms for ring in (part.exterior, *part.interiors))


@pytest.mark.parametrize("at", [AT, GRID])
def test_rooms_are_their_rectangles(at):
    floors = build_floor_polygons(building(2, 2, at))
    for floor, rectangle in zip(floors, rectangles(2, 2, at), strict=True):
        assert overlap(floor, rectangle) > 0.98 and floor.is_valid
    assert all(corners(floor) == 4 for floor in floors[:4])
    assert all(floor.geoms[0].exterior.is_ccw for floor in floors)


def test_rooms_of_a_storey_do_not_overlap():
    floors = build_floor_polygons(building(3))
    assert sum(f.area for f in floors) == pytest.approx(shapely.union_all(floors).area, rel=1e-9)


@pytest.mark.longer
@pytest.mark.parametrize("turn", [0.0, 0.3, np.pi / 4, 1.2])
def test_walls_are_straight_however_the_building_stands(turn):
    c, s = np.cos(turn), np.sin(turn)
    points = two_rooms().points() @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    topomap = topomerge.extract(points.astype(np.float32))
    floors = build_floor_polygons(topomap)
    assert len(floors) == 2
    for rectangle in (shapely.box(0.0, 0.05, 3.95, 5.0), shapely.box(4.05, 0.0, 7.0, 5.0)):
        rectangle = shapely.affinity.rotate(rectangle, np.degrees(turn), origin=(0, 0))
        best = max(floors, key=lambda floor: overlap(floor, rectangle))
        assert overlap(best, rectangle) > 0.95 and corners(best) <= 9
        assert best.hausdorff_distance(rectangle) < 0.35


def test_the_area_is_that_of_the_table():
    plan = np.ones((40, 50), bool)
    assert build_floor_polygons(flat(plan))[0].area == pytest.approx(20.0)
    # Extraction counts half a cell along the walls: 4.1 x 5.1 m.
    assert build_floor_polygons(flat(plan, 20.91))[0].bounds == pytest.approx((-0.05, -0.05, 4.05, 5.05), abs=0.002)


def test_courtyards_stay_and_columns_go():
    plan = np.ones((60, 60), bool)
    plan[10:25, 10:30] = False  # 3 m2
    plan[40:46, 40:46] = False  # 0.36 m2
    (floor,) = build_floor_polygons(flat(plan))
    assert [len(part.interiors) for part in floor.geoms] == [1]
    assert shapely.Polygon(floor.geoms[0].interiors[0]).area == pytest.approx(3.0, abs=0.05)


def test_a_floor_in_two_pieces_and_none_at_all():
    plan = np.zeros((60, 30), bool)
    plan[:20], plan[40:] = True, True
    (floor,) = build_floor_polygons(flat(plan))
    assert len(floor.geoms) == 2 and floor.area == pytest.approx(12.0)
    topomap = building(1)
    others = topomap.navigable_room != 1
    walked = {"navigable": topomap.navigable.select_cells(others), "navigable_room": topomap.navigable_room[others]}
    bare = replace(topomap, **walked, navigable_area=None)
    low, high = topomap.rooms["lo"][1], topomap.rooms["hi"][1]
    assert build_floor_polygons(bare)[1].bounds == pytest.approx((*low[:2], *high[:2]))
    assert build_floor_polygons(nothing()) == []


def test_ragged_floors_are_valid():
    rng = np.random.default_rng(5)
    for _ in range(30):
        plan = rng.random((rng.integers(2, 40), rng.integers(2, 40))) < rng.choice([0.2, 0.6, 0.9])
        plan[0, 0] = True
        (floor,) = build_floor_polygons(flat(plan))
        assert floor.is_valid and not floor.is_empty


def test_levels():
    topomap = building(1, 2)
    levels, seen = measure_room_levels(topomap)
    assert levels[:, 0] == pytest.approx([0.65] * 3 + [3.65] * 3)  # the middle of the lowest cells that one walks on
    assert levels[:, 1] - levels[:, 0] == pytest.approx(topomap.rooms["height"]) and seen.all()
    rooms = topomap.rooms.copy()
    rooms["height"] = 0
    levels, seen = measure_room_levels(replace(topomap, rooms=rooms))
    assert levels[0, 1] == pytest.approx(topomap.storeys["ceiling"][0]) and not seen.any()
    assert levels[3, 1] - levels[3, 0] == pytest.approx(2.5)  # nor was a ceiling of the storey seen
    assert measure_room_levels(nothing())[0].shape == (0, 2)


def test_jambs_stand_beside_the_middle_along_the_wall():
    door = np.zeros(1, EDGE_DTYPE)[0]
    door["centre"], door["width"], door["direction"] = (1.0, 2.0, 0.5), 0.9, 0.0  # the normal along x: a wall along y
    assert compute_jambs(door) == pytest.approx(np.array([[1.0, 1.55, 0.5], [1.0, 2.45, 0.5]]))


def test_a_point_inside():
    angle = shapely.MultiPolygon([shapely.box(0, 0, 6, 1).union(shapely.box(0, 0, 1, 6))])
    assert angle.contains(shapely.Point(find_inside_point(angle, np.array([4.0, 4.0, 0.0]))))
    assert find_inside_point(angle, np.array([0.5, 4.0, 0.0])).tolist() == [0.5, 4.0]
