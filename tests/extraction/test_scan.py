"""A scan: what a file knows beside its points goes with the cells."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from topomerge.errors import InputError
from topomerge.extraction.scan import read_scan, reasons
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
    with pytest.raises(InputError, match="^why$"), reasons(()):
        raise InputError("why")


def coloured(many: int, k: int = 0) -> PointCloud:
    """Points in a row of cells; the colour of each says where it is."""
    points = np.column_stack([np.arange(many) % 250 / 10 + 0.05, np.full(many, k / 10.0), np.zeros(many)]).astype(np.float32)
    at = (np.arange(many) % 250).astype(np.uint8)
    return PointCloud(
        points, np.array([100.0, 0, 0]), colors=np.column_stack([at, 255 - at, np.full(many, k + 1)]).astype(np.uint8)
    )


def test_each_held_point_has_its_own_colour(monkeypatch: pytest.MonkeyPatch) -> None:
    chunks = [coloured(3000, k) for k in range(4)]
    whole = read_scan(chunks, 0.1).shades
    assert whole is not None and len(whole[0]) == 12_000
    monkeypatch.setattr("topomerge.extraction.scan.MOST_SHADES_HELD", 5000)
    some = read_scan(chunks, 0.1).shades
    assert some is not None and 1500 < len(some[0]) <= 5000
    for points, colours in (whole, some):
        assert np.allclose(points[:, 0] - 100.05, colours[:, 0] / 10, atol=1e-4) and points.dtype == np.float64
        assert np.allclose(points[:, 1] * 10 + 1, colours[:, 2], atol=1e-4)
    assert np.bincount(some[1][:, 2])[1:].min() > 0.15 * len(some[0])  # of all chunks alike
    again = read_scan(chunks, 0.1).shades
    assert again is not None and np.array_equal(again[0], some[0])


def test_intensities_are_grey_and_nothing_that_is_none_has_a_shade() -> None:
    cloud = coloured(2000)
    bright = np.linspace(-7000.0, 900.0, 2000).astype(np.float32)
    bright[5] = np.nan
    shades = read_scan(PointCloud(cloud.points, intensities=bright), 0.1).shades
    assert shades is not None and len(shades[0]) == 1999 and (shades[1] == shades[1][:, :1]).all()
    assert shades[1][0, 0] < 31 and shades[1][-1, 0] > 224 and (np.diff(shades[1][:, 0].astype(int)) >= 0).all()
    both = read_scan(PointCloud(cloud.points, colors=cloud.colors, intensities=bright), 0.1).shades
    assert both is not None and (both[1][:, 1] == 255 - both[1][:, 0]).all()
    black = np.zeros((2000, 3), np.uint8)
    nothing: list[dict[str, Any]] = [{}, {"intensities": np.zeros(2000, np.float32)}, {"colors": black}, {"colors": black + 7}]
    nothing.append({"intensities": np.full(2000, np.nan, np.float32)})
    for more in nothing:
        assert read_scan(PointCloud(cloud.points, **more), 0.1).shades is None
