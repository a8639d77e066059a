"""What clouds and maps refuse."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.types import EDGE_DTYPE, ROOM_DTYPE, STOREY_DTYPE, PointCloud, TopometricMap, VoxelGrid


def test_point_cloud_refuses_wrong_lengths():
    points = np.zeros((4, 3), np.float32)
    assert len(PointCloud(points)) == 4
    for wrong in ({"points": points[:, :2]}, {"colors": np.zeros((3, 3), np.uint8)}, {"labels": np.zeros(5, np.int32)}):
        with pytest.raises(ValueError):
            PointCloud(**{"points": points, **wrong})


def small_map(**changes):
    cells = np.array([[0, 0, 0], [1, 0, 0]], np.int32)
    grid = VoxelGrid(cells, np.zeros(3), 0.1, (2, 1, 1))
    rooms, storeys = np.zeros(2, ROOM_DTYPE), np.zeros(1, STOREY_DTYPE)
    edges = np.zeros(1, EDGE_DTYPE)
    edges["rooms"] = (0, 1)
    labels = np.array([0, 1], np.int32)
    parts = {"grid": grid, "room": labels, "navigable": grid, "navigable_room": labels}
    return TopometricMap(**{**parts, "rooms": rooms, "edges": edges, "storeys": storeys, **changes})


def test_map_refuses_what_does_not_fit_together():
    assert small_map().find_cell_storeys().tolist() == [0, 0]
    loop, astray, high = np.zeros(1, EDGE_DTYPE), np.zeros(1, EDGE_DTYPE), np.zeros(2, ROOM_DTYPE)
    astray["rooms"], high["storey"] = (0, 7), 3
    for changes in (
        {"room": np.array([0], np.int32)},
        {"room": np.array([0, 2], np.int32)},
        {"navigable_room": np.array([-2, 0], np.int32)},
        {"edges": loop},
        {"edges": astray},
        {"rooms": high},
        {"rooms": np.zeros(2)},
        {"storeys": np.zeros(1)},
        {"provenance": np.zeros(1, np.uint32)},
    ):
        with pytest.raises(ValueError):
            small_map(**changes)
