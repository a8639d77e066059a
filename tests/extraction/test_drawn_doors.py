"""Doors of a drawing part rooms where the floor has no narrowing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from topomerge.extraction.extract import extract
from topomerge.extraction.levelling import transform_cloud
from topomerge.io.drawing import ParsedDrawing, TracedDrawing
from topomerge.io.drawn_storeys import DrawnStorey
from topomerge.io.grid import Plan, build_drawn_pieces, list_drawn_doors
from topomerge.io.piece import ReadOptions
from topomerge.types import PointCloud

RESOLUTION = 0.05  # m


def draw_hall(probability: float) -> ParsedDrawing:
    """Draw a hall of 8 m x 4 m, and in its middle an opening of 3.4 m between two stubs, which may be a door."""
    occupied = np.zeros((100, 180), bool)
    occupied[10:90, 10:170] = True
    free = np.zeros_like(occupied)
    free[12:88, 12:168] = True
    free[12:16, 88:92] = free[84:88, 88:92] = False
    doorway = np.zeros(free.shape, np.float32)
    doorway[16:84, 88:92] = probability
    return ParsedDrawing(occupied & ~free, free, doorway > 0.5, np.zeros_like(free), doorway, 1.0)


def build_cloud(drawing: ParsedDrawing, options: ReadOptions) -> PointCloud:
    pieces = list(build_drawn_pieces(Path("plan.png"), TracedDrawing(drawing, RESOLUTION, (), ()), options))
    points = np.concatenate([piece.points for piece in pieces]).astype(np.float32)
    return PointCloud(points, upright=True, drawn_doors=pieces[0].drawn_doors)


@pytest.mark.parametrize(("probability", "rooms"), [(0.95, 2), (0.1, 1)])
def test_a_drawn_door_parts_two_rooms_where_nothing_is_narrow(probability: float, rooms: int) -> None:
    cloud = build_cloud(draw_hall(probability), ReadOptions(resolution=RESOLUTION))
    map = extract(cloud)
    assert len(map.rooms) == rooms
    if rooms == 2:
        assert map.edges["centre"][0][0] == pytest.approx(90 * RESOLUTION, abs=0.25)
        assert len(extract(replace(cloud, drawn_doors=None)).rooms) == 1


def test_doors_move_with_their_cloud() -> None:
    cloud = build_cloud(draw_hall(0.95), ReadOptions(resolution=RESOLUTION))
    assert cloud.drawn_doors is not None
    matrix = np.array([[0.0, -1.0, 0.0, 3.0], [1.0, 0.0, 0.0, -2.0], [0.0, 0.0, 1.0, 0.5], [0.0, 0.0, 0.0, 1.0]])
    moved = transform_cloud(cloud, matrix)
    x, y, z, probability = cloud.drawn_doors.T
    assert moved.drawn_doors is not None
    np.testing.assert_allclose(moved.drawn_doors, np.column_stack([3 - y, x - 2, z + 0.5, probability]))
    assert len(extract(moved).rooms) == 2


@pytest.mark.parametrize("resolution", [0.03, 0.05, 0.12])
def test_no_column_of_a_door_is_left_out(resolution: float) -> None:
    """Of pixels as coarse as columns, too; their places lie in their pixels, the first row at the top."""
    doorway = np.zeros((40, 60), np.float32)
    doorway[5:15, 20:50] = 0.7
    doorway[30, 3] = 0.04  # less is none
    storey = DrawnStorey(doorway > 2, doorway < 2, None, doorway)
    doors = list_drawn_doors(storey, Plan(Path("plan.png"), resolution, (10.0, 0.0, 0.0)), 2.8, 1.0)
    assert (doors[:, 2] == 2.8).all() and doors[:, 3] == pytest.approx(0.7)
    low, high = np.array([10 + 20 * resolution, 25 * resolution]), np.array([10 + 50 * resolution, 35 * resolution])
    assert (doors[:, :2] > low).all() and (doors[:, :2] < high).all()
    inside = np.floor(high / 0.1 - 0.05) - np.ceil(low / 0.1 + 0.05)
    columns = np.unique(np.floor(doors[:, :2] / 0.1).astype(int), axis=0)
    assert len(columns) >= np.prod(inside)
