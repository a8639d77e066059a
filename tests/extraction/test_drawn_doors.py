"""Doors of a drawing part rooms where the floor has no narrowing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from topomerge.extraction.drawn_doors import place_drawn_doors
from topomerge.extraction.extract import extract
from topomerge.extraction.levelling import transform_cloud
from topomerge.io.drawing import ParsedDrawing, TracedDrawing
from topomerge.io.drawn_storeys import DrawnStorey
from topomerge.io.grid import Plan, build_drawn_pieces, list_drawn_doors
from topomerge.io.piece import ReadOptions
from topomerge.types import EDGE_DTYPE, ROOM_DTYPE, STOREY_DTYPE, PointCloud, TopometricMap, VoxelGrid

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


def draw_door(low: tuple[float, float], high: tuple[float, float], probability: float = 0.9, floor: float = 0.5) -> np.ndarray:
    """Places 5 cm apart in a box from low to high, m, as a drawing shows a door."""
    x, y = (np.arange(a, b, 0.05) + 0.025 for a, b in zip(low, high, strict=True))
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.column_stack([places, np.full(len(places), floor), np.full(len(places), probability)])


def list_doors(map: TopometricMap, rooms: tuple[int, int]) -> np.ndarray:
    return map.edges[(np.sort(map.edges["rooms"], axis=1) == rooms).all(axis=1)]


def test_a_door_lies_where_it_is_drawn_and_two_are_two() -> None:
    map = meet_along_a_wall()
    low, high = draw_door((3.9, 0.5), (4.1, 1.3)), draw_door((3.9, 3.0), (4.1, 3.9), 0.7)
    both = list_doors(place_drawn_doors(map, np.concatenate([low, high])), (0, 1))
    np.testing.assert_allclose(both["centre"][:, :2], [[4.0, 0.9], [4.0, 3.45]], atol=0.03)
    np.testing.assert_allclose(both["width"], [0.8, 0.9], atol=0.06)
    np.testing.assert_allclose(both["confidence"], [0.9, 0.7], atol=1e-6)
    np.testing.assert_allclose(np.sin(both["direction"]), 0.0, atol=0.1)
    assert both["open"].all() and (both["kind"] == "door").all()
    one = list_doors(place_drawn_doors(map, low), (0, 1))
    assert len(one) == 1 and one["height"][0] == map.edges["height"][0] == 2.1


@pytest.mark.parametrize(
    "drawn",
    [
        draw_door((1.0, 1.0), (1.2, 1.9)),  # within a room: a cupboard
        draw_door((3.9, 0.5), (4.1, 1.3), 0.4),  # unsure
        draw_door((3.9, 0.5), (4.1, 0.8)),  # too narrow
        draw_door((3.9, 0.5), (4.1, 1.3), floor=3.5),  # of another storey
    ],
)
def test_what_is_no_door_between_two_rooms_changes_nothing(drawn: np.ndarray) -> None:
    map = meet_along_a_wall()
    assert place_drawn_doors(map, drawn) is map


def meet_along_a_wall() -> TopometricMap:
    """Two rooms of 4 m x 4 m whose floors meet along x = 4 m, and an edge between them in the middle, 2.1 m high."""
    at = np.indices((80, 40)).reshape(2, -1).T
    cells = np.column_stack([at, np.zeros(len(at), np.int64)]).astype(np.int32)
    navigable = VoxelGrid.from_cells(cells, np.array([0.0, 0.0, 0.45]), 0.1, (80, 40, 1))
    rooms, edges, storeys = np.zeros(2, ROOM_DTYPE), np.zeros(1, EDGE_DTYPE), np.zeros(1, STOREY_DTYPE)
    rooms["area"], storeys["floor"] = 16.0, 0.5
    edges["rooms"], edges["centre"], edges["open"], edges["height"] = (0, 1), (4.0, 2.0, 0.5), True, 2.1
    edges["kind"] = "opening"
    room = (navigable.cells[:, 0] >= 40).astype(np.int32)
    return TopometricMap(navigable, room, navigable, room, rooms, edges, storeys)
