"""Outlines, doors and floods of plans."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.core.building import SURFACES, Difficulty
from topomerge.datasets.plans.floorplans import read_plans
from topomerge.datasets.plans.grid import find_contacts, flood, trace_outline
from topomerge.datasets.plans.sketch import build_outline as cut_open
from topomerge.datasets.plans.sketch import find_side_rooms, place_door

from tests.datasets.plans import plan_files as write


def test_hole_is_cut_open_and_closes_again() -> None:
    ring = shapely.box(0, 0, 10, 10).difference(shapely.union_all([shapely.box(2, 2, 4, 4), shapely.box(6, 6, 8, 8)]))
    shape = shapely.Polygon(cut_open(ring))
    assert shape.is_valid and not shape.interiors
    assert shape.area == pytest.approx(92, abs=0.01)
    healed = shapely.set_precision(shape, 1e-3)
    assert len(healed.interiors) == 2 and healed.area == pytest.approx(92)


def test_slit_of_a_hole_becomes_no_wall(tmp_path: Path) -> None:
    (plan,) = read_plans(write.campus(tmp_path / "a.xml", rooms=((0, 0, 300, 300), (100, 40, 250, 250)), portal=(100, 150)))
    building = build_building([plan], Difficulty(furniture=0, clutter=0, columns=0, beams=0, lamps=0))
    middles = building.vertices[building.triangles][building.labels == SURFACES.index("wall")].mean(axis=1)[:, :2]
    walls = shapely.union_all([shapely.box(0, -15, 15, 0).exterior, shapely.box(5, -12.5, 12.5, -2).exterior])
    assert shapely.distance(walls, shapely.points(middles)).max() < 0.3


def test_place_door_where_rooms_face_each_other() -> None:
    a, b = shapely.box(0, 0, 4, 4), shapely.box(4.2, 1, 8, 9)
    opening = place_door(a, b, 0.9, 0.5, np.array([4.0, 0.0]))
    assert opening is not None
    assert sorted([opening.start, opening.end]) == [pytest.approx((4.1, 1.1), abs=0.06), pytest.approx((4.1, 2.0), abs=0.06)]
    assert place_door(a, b, 0.9, 0.1) is None
    assert place_door(a, shapely.box(4.1, 3.7, 8, 9), 0.9, 0.5) is None  # they share 0.3 m only


def test_sides_are_left_and_right() -> None:
    shapes = [shapely.box(0, 0, 4, 4), shapely.box(4, 0, 8, 4)]
    joined_rooms = find_side_rooms(np.array([[4.0, 1], [0, 1]]), np.array([[4.0, 2], [0, 2]]), shapes, 0.3)
    assert joined_rooms.tolist() == [[0, 1], [-1, 0]]


def test_flood_meets_in_the_narrowest_place() -> None:
    free = np.ones((9, 21), bool)
    free[:, 8] = False
    free[3:6, 8] = True
    seeds = np.zeros((9, 21), np.int32)
    seeds[4, 1], seeds[4, 19] = 1, 2
    height = np.where(free, 2, 0)
    height[3:6, 8] = 1
    labels = flood(seeds, free, height)
    assert (labels[:, :8] == 1).all() and (labels[:, 9:] == 2).all() and (labels[:3, 8] == 0).all()
    ((a, b, ends),) = find_contacts(labels, 0.1, np.zeros(2))
    assert (a, b) == (1, 2) and np.ptp(ends, axis=0) == pytest.approx([0, 0.3])
    assert trace_outline(labels == 1, 0.1, np.array([5.0, 0])).bounds[:2] == pytest.approx((5.0, 0.0))
