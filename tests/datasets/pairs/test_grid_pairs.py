"""Cached pairs of grids: what is written comes back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from topomerge.datasets.core.builder import select_items
from topomerge.datasets.pairs.grid_pairs import (
    GRID_EDGE,
    GridRecipe,
    build_grid_arrays,
    draw_grid_items,
    load_grids,
    make_grids,
    unpack_pair,
)

from topomerge.errors import InputError
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


def test_a_larger_selection_holds_a_smaller_one() -> None:
    items = list(range(50))
    few, more = select_items(items, 5), select_items(items, 20)
    assert set(few) < set(more) and few == sorted(few) and len(few) == 5
    assert select_items(items, 0) == select_items(items, 80) == items
    with pytest.raises(InputError, match=r"data\.limit"):
        select_items(items, -1)


def test_a_part_of_a_set_holds_items_of_the_whole_set() -> None:
    whole, part = (draw_grid_items(GridRecipe(sets=[6, 3], limit=limit))[0] for limit in (0, 4))
    assert len(part) == 4 and {item.name for item in part} < {item.name for item in whole}


def test_a_pair_is_made_and_comes_back(tmp_path: Path) -> None:
    item, *_ = draw_grid_items(GridRecipe(sets=[1], rooms=[3, 4]))[0]
    assert make_grids(item, [], str(tmp_path)).reason == ""
    pair = load_grids(tmp_path / f"{item.name}.npz")
    assert (
        len(pair.a) > 1000 < len(pair.b) and pair.about["set"] == item.set and pair.about["kind"] in ("overlap", "other-building")
    )
