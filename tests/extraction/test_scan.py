"""A scan: what a file knows beside its points goes with the cells.

Discs laid along lines give what distance transforms give.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import edt
import numpy as np
import pytest

from topomerge.errors import InputError
from topomerge.extraction.morphology import _find_closing_columns, _near, compute_horizontal_distance_field, is_surrounded
from topomerge.extraction.scan import add_reasons, read_scan
from topomerge.types import PointCloud, VoxelGrid

POINTS = np.array([(x / 10 + 0.05, y / 10 + 0.05, 0.05) for x in range(8) for y in range(8)], np.float32)


def test_rays_of_points_whose_place_is_known() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = 3, 4, 1
    pose_of = np.full(len(POINTS), -1, np.int32)
    pose_of[:5] = 1
    chunks = [PointCloud(POINTS, np.array([10.0, 0, 0]), poses=poses, pose_of=pose_of), PointCloud(POINTS + 1, source="b.las")]
    scan = read_scan(chunks, 0.1)
    assert scan.rays is not None and scan.source == "b.las" and scan.free is None
    starts, ends = scan.rays
    assert (starts == (3, 4, 1)).all() and np.allclose(ends, POINTS[:5] + (10, 0, 0))
    assert read_scan(POINTS, 0.1).rays is None


def test_empty_space_and_warnings_of_all_chunks() -> None:
    free = VoxelGrid.from_cells(np.array([(1, 2, 3)]))
    chunks = [PointCloud(POINTS, free=free, warnings=("odd",)), PointCloud(POINTS + 1, warnings=("odd", "odder"))]
    scan = read_scan(iter(chunks), 0.1)
    assert scan.free is free and scan.warnings == ("odd", "odder") and len(scan.grid) == 128


def test_a_grid_is_taken_as_it_is() -> None:
    grid = VoxelGrid.from_cells(np.array([(1, 2, 3)]), edge=0.2)
    assert read_scan(grid, 0.1, least_neighbours=3.5).grid is grid


def test_sparse_points_get_larger_cells() -> None:
    scan = read_scan(POINTS[::4] * 2, 0.1, least_neighbours=3.5)
    assert scan.grid.edge > 0.1 and "sparse" in scan.warnings[0]
    assert read_scan(POINTS[::4] * 2, 0.1).grid.edge == 0.1


@pytest.mark.parametrize("source", ["scan.ply", Path("scan.ply")])
def test_a_path_must_be_read_first(source: Any) -> None:
    with pytest.raises(InputError, match=r"^scan\.ply: extract takes points, not the name of a file; read it with read_points"):
        read_scan(source, 0.1)


def test_points_are_numbers() -> None:
    with pytest.raises(InputError, match="not a sequence of list"):
        read_scan(POINTS.tolist(), 0.1)
    for points in (np.full((2, 3), "a"), np.zeros((2, 3), object), POINTS.tolist()):
        with pytest.raises(ValueError, match="must be an .* array of numbers"):
            PointCloud(points)


def test_what_looked_wrong_is_told_with_the_error() -> None:
    with pytest.raises(InputError, match=r"^no finite point: nothing to voxelise \(and all points were NaN\)$"):
        read_scan(PointCloud(np.zeros((0, 3), np.float32), warnings=("all points were NaN",)), 0.1)
    with pytest.raises(InputError, match="^why$"), add_reasons(()):
        raise InputError("why")


@pytest.mark.parametrize("radius", [1, 1.5, 2, 3.0000001, 4.7, 10])
def test_near_is_what_a_distance_transform_says(radius: float) -> None:
    mask = np.random.default_rng(1).random((90, 130)) < 0.02
    assert np.array_equal(_near(mask, radius), edt.edtsq((~mask).view(np.uint8)) <= radius**2)


def test_closing_is_the_same_in_tiles_and_at_once() -> None:
    """A gap across the border of two tiles is closed; a wider one is not."""
    x = np.concatenate([np.arange(200, 254), np.arange(258, 300), np.arange(310, 340)])
    floor = np.array([(i, j) for i in x for j in range(250, 265)])
    added = _find_closing_columns(floor, 3.0)
    assert set(added[:, 0].tolist()) == {254, 255, 256, 257} and set(added[:, 1].tolist()) <= set(range(250, 265))
    assert len(added) >= 4 * 13


@pytest.mark.parametrize("edge", [0.05, 0.1, 0.13])
def test_cells_on_all_sides_are_those_of_the_distance_field(edge: float) -> None:
    cells = np.unique(np.random.default_rng(2).integers(0, 30, (25_000, 3)), axis=0).astype(np.int32)
    grid = VoxelGrid.from_cells(cells, np.zeros(3), edge)
    field = compute_horizontal_distance_field(grid)
    for radius in range(4):
        assert np.array_equal(is_surrounded(grid, grid.cells, radius), field >= radius)
