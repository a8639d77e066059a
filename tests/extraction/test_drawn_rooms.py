"""Doors of a drawing part rooms where the floor has no narrowing; where a drawing shows none, the floor decides alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from topomerge.extraction.extract import extract
from topomerge.extraction.plans.part_rooms import build_drawn_rooms
from topomerge.io.drawing import ParsedDrawing, TracedDrawing
from topomerge.io.drawn_storeys import DrawnStorey
from topomerge.io.grid import Plan, build_drawn_pieces, list_drawn_rooms
from topomerge.io.piece import ReadOptions
from topomerge.types import Array, PointCloud

RESOLUTION = 0.05  # m


def draw_hall(door: bool) -> ParsedDrawing:
    """Draw a hall of 8 m x 4 m, and in its middle an opening of 3.6 m between two stubs, which may be a door."""
    occupied, doors = np.zeros((2, 100, 180), bool)
    occupied[10:90, 10:170] = True
    free = np.zeros_like(occupied)
    free[12:88, 12:168] = True
    free[12:16, 89:91] = free[84:88, 89:91] = False
    doors[16:84, 89:91] = door
    return ParsedDrawing(occupied & ~free, free, doors, np.zeros_like(free), 1.0)


def build_cloud(drawing: ParsedDrawing) -> PointCloud:
    traced = TracedDrawing(drawing, RESOLUTION, (), ())
    pieces = list(build_drawn_pieces(Path("plan.png"), traced, ReadOptions(resolution=RESOLUTION)))
    points = np.concatenate([piece.points for piece in pieces]).astype(np.float32)
    return PointCloud(points, upright=True, drawn_rooms=pieces[0].drawn_rooms)


@pytest.mark.parametrize("door", [True, False])
def test_a_drawn_door_parts_two_rooms_where_nothing_is_narrow(door: bool) -> None:
    cloud = build_cloud(draw_hall(door))
    assert cloud.drawn_rooms is not None
    map = extract(cloud)
    assert len(map.rooms) == 1 + door
    if door:
        assert map.edges["centre"][0][0] == pytest.approx(90 * RESOLUTION, abs=0.25)
        assert len(extract(replace(cloud, drawn_rooms=None)).rooms) == 1


def test_rooms_of_a_drawing_are_numbered_on_from_storey_to_storey() -> None:
    drawing = draw_hall(True)
    storey = DrawnStorey(drawing.occupied, drawing.free, None, drawing.door)
    rooms = list_drawn_rooms(storey, Plan(Path("plan.png"), RESOLUTION, (10.0, 0.0, 0.0)), 2.8, 5)
    assert set(rooms[:, 3]) == {5, 6} and (rooms[:, 2] == 2.8).all()
    middles: Array = np.array([rooms[rooms[:, 3] == k, :2].mean(axis=0) for k in (5, 6)])
    np.testing.assert_allclose(middles, [[12.52, 2.5], [16.5, 2.5]], atol=0.05)


def test_no_drawing_says_nothing() -> None:
    assert build_drawn_rooms(None) == () and build_drawn_rooms(np.zeros((0, 4))) == ()
