"""Maps are fused: no cell is lost, each knows who saw it, rooms and doors are extracted once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

import topomerge as tm
from tests.fusion.atlas.atlas_scenes import office_map, truth
from tests.scenes import two_rooms
from topomerge.errors import InputError
from topomerge.extraction.cleaning import compute_cell_means
from topomerge.fusion.fuse import _JoinedCells, fuse, match_common_rooms
from topomerge.fusion.resampling import resample_cells, transform_means
from topomerge.registration.storeys import is_extruded
from topomerge.types import Placement, Sim3, TopometricMap, VoxelGrid


def fused(a: TopometricMap, b: TopometricMap, pose: Sim3) -> TopometricMap:
    """Two maps, of which the second lies at T_ab."""
    return fuse((a, b), [(0, Sim3()), (1, pose)])


@pytest.fixture(scope="module")
def halves() -> tuple[TopometricMap, TopometricMap]:
    """The west and the east of the office, in two frames."""
    return office_map(0), office_map(2)


@pytest.fixture(scope="module")
def joined(halves) -> TopometricMap:
    return fused(*halves, truth(0, 2))


@pytest.mark.longer
def test_provenance_tells_who_saw_each_cell():
    """Two boxes of cells that share a part, the second one moved by whole cells."""
    a, b = (tm.extract(two_rooms().points().astype(np.float32), name=name) for name in "ab")
    joined = fused(a, b, Sim3(0.0, (3.0, 0.0, 0.0)))

    def lattice(map: TopometricMap, metres: float = 0.0) -> set[tuple[int, ...]]:
        offset = np.round((map.grid.origin + (metres, 0, 0)) / 0.1)
        return {tuple(cell) for cell in (map.grid.cells + offset).astype(int).tolist()}

    of_a, of_b, both = lattice(a), lattice(b, 3.0), lattice(joined)
    assert joined.provenance.dtype == np.uint32 and len(both) == len(joined.grid)
    offset = np.round(joined.grid.origin / 0.1)
    drawn = 0  # to a wall of a that b shows a cell aside
    for cell, bits in zip((joined.grid.cells + offset).astype(int).tolist(), joined.provenance.tolist(), strict=True):
        seen = (tuple(cell) in of_a) + 2 * (tuple(cell) in of_b)
        assert bits == seen or (bits == 3 and seen == 1)
        drawn += bits != seen
    assert drawn < 0.02 * len(both)
    assert len((of_a | of_b) - both) < 0.05 * len(both)  # the copies, and cells that the extraction takes for noise


@pytest.mark.longer
def test_bits_of_joined_maps_follow(halves, joined):
    again = fused(joined, halves[1], truth(0, 2))
    assert np.bitwise_or.reduce(again.provenance) == 0b111
    full = replace(joined, provenance=np.full(len(joined.grid), 1 << 31, np.uint32))
    with pytest.raises(InputError, match="at most 32"):
        fused(full, halves[1], truth(0, 2))


def test_what_one_map_saw_empty_and_the_other_did_not_is_occupied(halves, joined):
    west, east = halves
    place = truth(0, 2).inverse().apply(joined.grid.compute_centroids()[joined.provenance == 1])
    assert east.free.find_rows(east.free.locate(place)).max() >= 0  # cells of the one stand in empty space of the other
    assert np.array_equal(joined.free.origin, joined.grid.origin) and joined.free.edge == 2 * joined.grid.edge
    assert not joined.grid.coarsen(2).contains(joined.free.cells).any()
    assert len(joined.free) > max(len(west.free), len(east.free))


@pytest.mark.parametrize("turn", [0.0, 0.3, np.pi / 4])
def test_a_turned_wall_stays_whole(turn):
    x, z = np.meshgrid(np.arange(60), np.arange(25), indexing="ij")
    wall = VoxelGrid.from_cells(np.stack([x, 0 * x + 5, z], axis=-1).reshape(-1, 3), edge=0.1)
    cells, rows = resample_cells(wall, Sim3(turn, (1.23, 4.56, 0.05)), np.zeros(3), 0.1)
    assert 0.7 * len(wall) < len(cells) < 1.35 * len(wall) and len(np.unique(cells, axis=0)) == len(cells)
    moved = Sim3(turn, (1.23, 4.56, 0.05)).apply(wall.compute_centroids())
    assert {tuple(c) for c in np.floor(moved / 0.1).astype(int).tolist()} <= {tuple(c) for c in cells.tolist()}  # none is lost
    away = np.linalg.norm((cells + 0.5) * 0.1 - moved[rows], axis=1)
    assert away.max() < 0.1 * np.sqrt(3) / 2 + 1e-9
    image = np.zeros(cells.max(axis=0)[:2] + 1, bool)
    image[tuple(cells[:, :2].T)] = True
    assert ndimage.label(image, np.ones((3, 3)))[1] == 1  # a walk along the wall meets no gap


@pytest.mark.parametrize("turn", [0.2, 0.6, np.pi / 4])
def test_a_turned_floor_has_no_holes(turn):
    x, y = np.meshgrid(np.arange(50), np.arange(40), indexing="ij")
    floor = VoxelGrid.from_cells(np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3), edge=0.1)
    cells, _ = resample_cells(floor, Sim3(turn, (0.03, 0.07, 0.0)), np.array([-9.0, -9.0, 0.0]), 0.1)
    image = np.zeros(cells.max(axis=0)[:2] + 2, bool)
    image[tuple(cells[:, :2].T)] = True
    assert np.array_equal(ndimage.binary_fill_holes(image), image) and (cells[:, 2] == cells[0, 2]).all()


def test_coarse_cells_are_filled():
    grid = VoxelGrid.from_cells(np.array([[0, 0, 0], [1, 0, 0]]), edge=0.2)
    cells, rows = resample_cells(grid, Sim3(), np.zeros(3), 0.1)
    assert len(cells) == 16 and np.bincount(rows).tolist() == [8, 8]


def test_a_map_laid_on_itself_is_itself(halves):
    a = halves[0]
    twice = fused(a, replace(a, source="again"), Sim3())
    assert len(twice.grid) == len(a.grid) and (twice.provenance == 3).all() and twice.source == "west + again"
    rooms, shared = match_common_rooms(a, a, Sim3())
    assert rooms[:, 0].tolist() == rooms[:, 1].tolist() == list(range(len(a.rooms))) and (shared > 0.99).all()


@pytest.mark.longer
def test_a_slice_fills_no_room_with_what_stands_in_it(halves):
    """Its furniture becomes walls as high as the room; where another map saw the floor, it only says that it saw something."""
    west = halves[0].grid.compute_cell_bounds(halves[0].grid.cells)[0] + 0.05
    cut = west[(west[:, 2] > 0.5) & (west[:, 2] < 0.65)]
    flat = tm.extract(cut.astype(np.float32), name="slice")
    assert is_extruded(flat.grid) and not any(is_extruded(m.grid) for m in halves)
    lower = Sim3(0.0, (0.0, 0.0, float(halves[0].storeys["floor"][0] - flat.storeys["floor"][0])))
    joined = fuse([halves[0], flat], [(0, Sim3()), (1, lower)])
    assert len(joined.rooms) == len(halves[0].rooms) and abs(len(joined.grid) - len(halves[0].grid)) < 0.02 * len(joined.grid)
    assert ((joined.provenance & 2) > 0).sum() > 0.5 * len(flat.grid) and (joined.provenance == 2).sum() < 0.02 * len(joined.grid)
    first = fuse([flat, halves[0]], [(0, Sim3()), (1, lower.inverse())])
    assert len(first.rooms) == len(joined.rooms) and np.bitwise_or.reduce(first.provenance) == 0b11


def scanned_rooms(seed: int, spread: float = 0.0) -> TopometricMap:
    """Two rooms from points anywhere on their surfaces, not from the middles of cells."""
    rng = np.random.default_rng(seed)
    points = two_rooms().points()
    points = points[rng.permutation(len(points))[: len(points) // 2]]
    return tm.extract((points + rng.normal(0, spread, points.shape)).astype(np.float32), name=f"scan {seed}")


def off_the_wall(map: TopometricMap) -> np.ndarray:
    """m of the cells of the wall at y = 0.017 from it."""
    at = compute_cell_means(map.grid) - (0, 0.017, 0)
    near = (np.abs(at[:, 1]) < 0.12) & (at[:, 0] > 0.3) & (at[:, 0] < 6.7) & (at[:, 2] > 0.4) & (at[:, 2] < 2.0)
    return np.abs(at[near, 1])


@pytest.mark.longer
def test_a_joined_wall_is_where_the_points_of_both_maps_are():
    a, frame = scanned_rooms(0), Sim3(0.4, (1.03, -2.02, 0.0))
    points = compute_cell_means(scanned_rooms(1).grid)
    b = tm.extract(frame.inverse().apply(points).astype(np.float32), name="turned")
    joined = fused(a, b, frame)
    assert joined.grid.properties["offset"].shape == (len(joined.grid), 3)
    assert np.median(off_the_wall(joined)) < 0.006 and np.quantile(off_the_wall(joined), 0.9) < 0.03
    plain = [replace(m, grid=VoxelGrid(m.grid.cells, m.grid.origin, m.grid.edge, m.grid.shape)) for m in (a, b)]
    assert "offset" not in fused(*plain, frame).grid.properties


def test_the_map_with_more_points_says_where_a_wall_is():
    cells = np.stack([np.arange(10), np.zeros(10), np.zeros(10)], axis=1).astype(np.int64)
    grid = VoxelGrid.from_cells(cells, edge=0.1)
    few, many = (
        grid.assign_properties(count=np.full(10, n), offset=np.tile(np.array([128, at, 128], np.uint8), (10, 1)))
        for n, at in ((1, 250), (99, 50))
    )
    joined = _JoinedCells(np.zeros(3), 0.1)
    for one in (few, many):
        laid, rows = resample_cells(one, Sim3(), np.zeros(3), 0.1)
        joined._add(
            laid,
            np.ones(10, np.uint32),
            np.zeros(10, np.int64),
            *transform_means(one, Placement(Sim3()), rows, laid, np.zeros(3), 0.1),
        )
    assert np.allclose(joined.convert_means()[:, 1], 0.1 * 52.5 / 256, atol=4e-4) and len(joined.codes) == 10


def test_a_cell_that_is_only_filled_says_little():
    """The wall stands at y = 0.09 of its cells; laid half a cell on, those beside them are filled, too."""
    grid = VoxelGrid.from_cells(np.array([[4, 0, 0]]), edge=0.1).assign_properties(offset=np.array([[128, 230, 128]], np.uint8))
    placement = Placement(Sim3(np.pi / 4))
    cells, rows = resample_cells(grid, placement, np.zeros(3), 0.1)
    means, points = transform_means(grid, placement, rows, cells, np.zeros(3), 0.1)
    true = placement.transform_points(compute_cell_means(grid))[0]
    inside = (np.floor(true / 0.1).astype(int) == cells).all(axis=1)
    assert len(cells) > 1 and inside.sum() == 1 and points[inside] == 1 and (points[~inside] < 0.05).all()
    assert np.allclose((cells[inside] + means[inside]) * 0.1, true)
    assert ((means >= 0) & (means <= 1)).all()
