"""The classic segmentations of grid maps against plans whose rooms anyone can count, and their scores against counts by hand."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest

CELL = 0.05  # m


@pytest.fixture
def classic():
    return importlib.import_module("benchmarks.peers.segmentations")


@pytest.fixture
def occupancy():
    return importlib.import_module("benchmarks.peers.rooms")


def plan(door: int) -> np.ndarray:
    """Two rooms of 5 m by 6 m, 0.2 m of wall between them, and a gap of so many cells in it."""
    free = np.zeros((124, 208), bool)
    free[2:122, 2:102] = free[2:122, 106:206] = True
    if door:
        free[40 : 40 + door, 102:106] = True
    return free


def office() -> np.ndarray:
    """Eight rooms of 4 m by 4 m on both sides of a corridor of 2 m by 16.6 m, each with a door of 0.9 m."""
    free = np.zeros((220, 344), bool)
    free[90:130, 6:338] = True
    for k in range(4):
        for top, door in ((4, 84), (136, 130)):
            free[top : top + 80, 6 + 84 * k : 86 + 84 * k] = True
            free[door : door + 6, 36 + 84 * k : 54 + 84 * k] = True
    return free


@pytest.mark.parametrize("method", ["distance", "morphological", "voronoi"])
@pytest.mark.parametrize("turned", [False, True])
def test_a_door_parts_two_rooms_and_a_lone_room_is_one(classic, method, turned) -> None:
    segment = classic.METHODS[method]
    for door, rooms in ((0, 2), (18, 2)):
        free = plan(door).T if turned else plan(door)
        labels = segment(free, CELL)
        assert ((labels >= 0) == free).all() and labels.max() + 1 == rooms
        sides = labels.T if turned else labels
        assert len(np.unique(sides[2:122, 2:100])) == len(np.unique(sides[2:122, 108:206])) == 1
        assert sides[50, 40] != sides[50, 140]
    alone = plan(0)
    alone[:, 102:] = False
    assert (segment(alone, CELL)[alone] == 0).all()


@pytest.mark.parametrize("method", ["distance", "morphological", "voronoi"])
def test_rooms_on_a_corridor(classic, method) -> None:
    free = office()
    labels = classic.METHODS[method](free, CELL)
    rooms = [labels[44 + 132 * row, 46 + 84 * k] for row in (0, 1) for k in range(4)]
    assert len({*rooms, labels[110, 90]}) == 9, "eight rooms, and none of them the corridor"
    for row, top in ((0, 4), (1, 136)):
        for k in range(4):
            inner = labels[top + 4 : top + 76, 10 + 84 * k : 82 + 84 * k]
            assert (inner == rooms[4 * row + k]).all(), "a room is whole"


def test_a_map_without_floor_has_no_rooms(classic) -> None:
    for segment in classic.METHODS.values():
        assert (segment(np.zeros((20, 30), bool), CELL) == -1).all()
        tiny = np.zeros((20, 30), bool)
        tiny[5:7, 5:7] = True
        assert (segment(tiny, CELL) == -1).all(), "less than any room"


def test_waves_meet_halfway_and_go_round_walls(classic) -> None:
    free = np.ones((5, 21), bool)
    seeds = np.zeros(free.shape, int)
    seeds[2, 0], seeds[2, 20] = 1, 2
    labels = classic.flood_seeds(seeds, free)
    assert (labels[:, :10] == 0).all() and (labels[:, 11:] == 1).all()
    free[:, 4] = False  # the first seed is shut in
    labels = classic.flood_seeds(seeds, free)
    assert (labels[:, :4] == 0).all() and (labels[:, 5:] == 1).all() and (labels[:, 4] == -1).all()


def test_sides_that_pieces_share(classic) -> None:
    labels = np.array([[0, 0, 1], [0, 0, -1]])
    touch = classic.count_contacts(labels, 2)
    assert touch[0, 1] == touch[1, 0] == 1
    assert touch[0, 2] == 7 and touch[1, 2] == 3, "what is not free, the border of the map among it"


def test_wide_openings_are_no_doors_for_the_graph(classic) -> None:
    """An opening as wide as the rooms: their pieces are joined again."""
    free = plan(0)
    free[2:122, 102:106] = True
    assert classic.segment_by_voronoi(free, CELL).max() == 0


def truth_of_two():
    """Two rooms of 4 m², side by side, all judged, on a raster of 2 m by 4 m."""
    floor_truth = importlib.import_module("topomerge.datasets.simulation.floor_truth")
    raster = np.zeros((1, 20, 40), np.int32)
    raster[:, :, 20:] = 1
    none = np.zeros((0, 3))
    return floor_truth.FloorTruth(
        raster=raster, origin=np.zeros(2), visited=np.ones(2, bool), floors=np.zeros(1), height=np.full(1, 2.5),
        doors=np.zeros((0, 5)), edges=np.zeros((0, 2), int), matrix=np.eye(4), anchors=none, drift=none, complete=np.array(True),
    )  # fmt: skip


def test_scores_of_the_survey(occupancy) -> None:
    truth = truth_of_two()
    one = np.zeros_like(truth.raster)
    assert occupancy.compute_survey_scores(truth, one) == (0.5, 1.0), "united: half of it lies in one true room"
    cut = truth.raster.copy()
    cut[:, :10, 20:] = 2
    assert occupancy.compute_survey_scores(truth, cut) == (1.0, 0.75), "cut: one whole, of the other half"
    assert occupancy.compute_survey_scores(truth, truth.raster) == (1.0, 1.0)
    assert occupancy.compute_survey_scores(truth, np.full_like(one, -1))[1] == 0.0


def test_rooms_that_nobody_visited_are_not_held_against_a_method(occupancy) -> None:
    truth = truth_of_two()
    assert occupancy.score_map(truth, truth.raster, 2).rooms.precision == 1.0
    unvisited = replace(truth, visited=np.array([True, False]))
    rooms = occupancy.score_map(unvisited, truth.raster, 2).rooms
    assert rooms.precision == rooms.recall == 1.0 and rooms.iou == 1.0
    outside = truth.raster.copy()
    outside[:, :5] = 2
    walled = replace(truth, raster=np.where(outside == 2, -1, truth.raster))
    assert occupancy.score_map(walled, outside, 3).rooms.precision == pytest.approx(2 / 3), "what is no room at all is wrong"


def test_a_grid_from_above(occupancy) -> None:
    """A floor of 4 m by 3 m with a wall through it, and a lamp and a low sill that are no obstacles."""
    scans = importlib.import_module("topomerge.evaluation.scans")
    from topomerge.types import PointCloud

    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.025, 4, 0.05), np.arange(0.025, 3, 0.05)))
    floor = np.column_stack([x, y, np.zeros(len(x))])
    z = np.arange(0.0, 2.4, 0.05)
    wall = np.column_stack([np.full(len(z) * 60, 2.025), np.repeat(np.arange(0.025, 3, 0.05), len(z)), np.tile(z, 60)])
    lamp, sill = floor[:50] + (0, 0, 2.2), floor[-50:] + (0, 0, 0.15)
    truth = replace(truth_of_two(), raster=np.zeros((1, 30, 40), np.int32))
    cloud = PointCloud(np.concatenate([floor, wall, lamp, sill]).astype(np.float32))
    (grid,) = occupancy.build_floor_grids(scans.Scan(cloud, truth, ()))
    assert grid.free.sum() == 80 * 60 - 60 and grid.seen.sum() == 80 * 60
    assert grid.compute_centres(grid.free)[:, :2].min(axis=0) == pytest.approx([0.025, 0.025], abs=1e-6)
    columns, count = occupancy.segment_scan(scans.Scan(cloud, truth, ()), "morphological", [grid])
    assert count == 2 and len(np.unique(columns[0, :, :18])) == len(np.unique(columns[0, :, 24:])) == 1
