"""Cached pairs of grids: what is written comes back."""

from __future__ import annotations

import json

import numpy as np
from topomerge.datasets.pairs.grid_pairs import GRID_EDGE, build_grid_arrays, unpack_pair

from topomerge.types import VoxelGrid


def test_floor_past_the_last_wall_comes_back():
    walls = VoxelGrid(np.array([[1, 1, 0], [4, 5, 2]], np.int32), np.array([1.0, 2.0, 0.0]), GRID_EDGE, (5, 6, 3))
    walls = VoxelGrid(walls.cells, walls.origin, walls.edge, walls.shape, {"offset": np.zeros((2, 3), np.int8)})
    floor = VoxelGrid(np.array([[2, 2, 0], [5, 6, 0]], np.int32), walls.origin, GRID_EDGE, (6, 7, 1))
    about = np.frombuffer(json.dumps({"common": 3.0}).encode(), np.uint8)
    sides = {**build_grid_arrays("a", walls, floor), **build_grid_arrays("b", walls, None)}
    pair = unpack_pair("x", {**sides, "truth": np.eye(4), "about": about})
    assert pair.a.shape == pair.free[0].shape == (6, 7, 3) and pair.b.shape == (5, 6, 3) and pair.free[1] is None
    assert np.array_equal(pair.a.cells, walls.cells) and np.array_equal(pair.free[0].cells, floor.cells)
