"""Free space: where views stand when the sensor's places are unknown."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.morphology import compute_horizontal_distance_field
from topomerge.extraction.navigable import VIEW_CLEARANCE, VIEW_HEIGHT, find_free_space, select_tile_views
from topomerge.extraction.scan import Scan
from topomerge.types import VoxelGrid


def slab(nx: int, ny: int, z: int = 0) -> VoxelGrid:
    return VoxelGrid.from_cells((np.argwhere(np.ones((nx, ny, 1), bool)) + (0, 0, z)).astype(np.int32), shape=(nx, ny, 30))


def test_one_view_a_tile_where_it_is_farthest_from_the_boundary() -> None:
    grid = slab(30, 20)
    views = select_tile_views(grid, grid, 1.0)
    distance = compute_horizontal_distance_field(grid)
    assert len(views) == 6
    for cell in grid.locate(views - (0, 0, VIEW_HEIGHT)):
        tile = (grid.cells // 10 == cell // 10).all(axis=1)
        assert distance[grid.find_rows(cell[None])[0]] == distance[tile].max()


def test_views_stay_below_the_ceiling() -> None:
    floor = slab(20, 20)
    room = floor.replace_cells(np.concatenate([floor.cells, slab(10, 20, 15).cells]))
    views = select_tile_views(room, floor, 1.0)
    covered = views[:, 0] < 1.0
    np.testing.assert_allclose(views[covered, 2], 0.05 + 1.5 - VIEW_CLEARANCE)
    np.testing.assert_allclose(views[~covered, 2], 0.05 + VIEW_HEIGHT)


def test_what_the_file_says_is_empty_is_taken_as_it_is() -> None:
    floor, known_empty = slab(20, 20), slab(5, 5, 3)
    assert find_free_space(Scan(floor, free=known_empty), floor, 5.0) is known_empty
