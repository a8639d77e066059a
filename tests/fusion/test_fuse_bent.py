"""Bent maps are fused: floors and walls without holes where they should lie, and an identity that changes nothing."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy import ndimage

import topomerge as tm
from tests.fusion.atlas.atlas_scenes import office_map, truth
from tests.types.test_deformation import deformation
from topomerge.fusion.fuse import find_joined_rooms, fuse, match_common_rooms
from topomerge.fusion.resampling import _linearise, _linearise_places, resample_cells
from topomerge.types import Array, Deformation, Placement, Sim3, TopometricMap, VoxelGrid

POSE = Sim3(0.4, (1.23, 4.56, 0.03))


def bent_by(seed: int, storeys: int = 1) -> Deformation:
    rng = np.random.default_rng(seed)
    return deformation(rng.normal(0, (0.25, 0.25, 0.03, 0.01), (5 * storeys, 4)), storeys=storeys)


def image_of(cells: Array) -> Array:
    low = cells.min(axis=0)[:2]
    image = np.zeros(cells.max(axis=0)[:2] - low + 1, bool)
    image[tuple((cells[:, :2] - low).T)] = True
    return image


@pytest.fixture(scope="module")
def halves() -> tuple[TopometricMap, TopometricMap]:
    return office_map(0), office_map(2)


@pytest.fixture(scope="module")
def straight(halves) -> TopometricMap:
    """The halves joined without a bend."""
    return fuse(halves, [(0, Sim3()), (1, truth(0, 2))])


@pytest.mark.parametrize("seed", range(3))
def test_a_bent_floor_has_no_holes(seed):
    x, y = np.meshgrid(np.arange(180), np.arange(60), indexing="ij")
    floor = VoxelGrid.from_cells(np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3), edge=0.1)
    cells, rows = resample_cells(floor, Placement(POSE, bent_by(seed)), np.array([-9.0, -9.0, 0.0]), 0.1)
    image = image_of(cells)
    assert np.array_equal(ndimage.binary_fill_holes(image), image) and np.ptp(cells[:, 2]) == 0
    assert ndimage.label(image)[1] == 1
    laid = Placement(POSE, bent_by(seed)).transform_points(floor.compute_centroids())
    away = np.linalg.norm((np.array([-9.0, -9.0, 0.0]) + (cells + 0.5) * 0.1 - laid[rows])[:, :2], axis=1)
    assert away.max() < 0.1


@pytest.mark.parametrize("spread", [40, 4000])
def test_columns_of_one_storey_are_bent_once(spread):
    """To the bit as cell by cell; cells that are far apart are no raster."""
    at = np.random.default_rng(0).integers(0, (spread, spread, 25), (900, 3))
    grid = VoxelGrid.from_cells(at, np.array([-5.0, 3.0, 0.1]), 0.1)
    places = grid.compute_centroids(grid.cells)
    once, each = _linearise(bent_by(1), grid.cells, places, grid), _linearise_places(bent_by(1), places, grid)
    for one, other in zip(once, each, strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize("seed", range(3))
def test_a_bent_wall_stays_whole(seed):
    x, z = np.meshgrid(np.arange(180), np.arange(25), indexing="ij")
    wall = VoxelGrid.from_cells(np.stack([x, 0 * x + 5, z], axis=-1).reshape(-1, 3), edge=0.1)
    cells, _ = resample_cells(wall, Placement(POSE, bent_by(seed)), np.zeros(3), 0.1)
    laid = Placement(POSE, bent_by(seed)).transform_points(wall.compute_centroids())
    assert {tuple(c) for c in np.floor(laid / 0.1).astype(int).tolist()} <= {tuple(c) for c in cells.tolist()}  # none is lost
    assert ndimage.label(image_of(cells), np.ones((3, 3)))[1] == 1 and 0.7 * len(wall) < len(cells) < 1.4 * len(wall)


def test_a_wall_through_two_storeys_that_part_has_no_gap():
    moves = np.zeros((10, 4))
    moves[5:, 1] = 0.3  # the upper storey goes aside
    x, z = np.meshgrid(np.arange(100), np.arange(55), indexing="ij")
    wall = VoxelGrid.from_cells(np.stack([x, 0 * x + 5, z], axis=-1).reshape(-1, 3), edge=0.1)
    cells, _ = resample_cells(wall, Placement(Sim3(), deformation(moves, storeys=2)), np.zeros(3), 0.1)
    for low, high in pairwise(np.unique(cells[:, 2])):
        assert high == low + 1
        here, there = (np.unique(cells[cells[:, 2] == level, 1]) for level in (low, high))
        assert abs(here[:, None] - there[None]).min() <= 1


@pytest.mark.longer
def test_bending_by_nothing_gives_the_same_bytes(halves, straight):
    poses = [(0, Sim3()), (1, truth(0, 2))]
    hardly = deformation(np.full((5, 4), (0.01, 0.01, 0.0, 0.0)))  # less than cells can tell
    for still in (deformation(np.zeros((5, 4))), deformation(np.zeros((0, 4))), hardly):
        bent = fuse(halves, poses, {0: still, 1: still})
        for name in ("room", "provenance", "rooms", "edges", "navigable_room"):
            assert getattr(bent, name).tobytes() == getattr(straight, name).tobytes(), name
        assert (
            bent.grid.cells.tobytes() == straight.grid.cells.tobytes()
            and bent.free.cells.tobytes() == straight.free.cells.tobytes()
        )


def test_what_drift_bent_is_joined_as_if_it_were_straight(halves, straight):
    """The east was bent; bending it back, the joined map has the rooms that it has without drift."""
    west, east = halves
    low, high = east.grid.bounds
    moves = np.array([[0.3, 0.2, 0.02, 0.0], [0.0, 0.0, 0.0, 0.0], [-0.2, 0.3, -0.02, 0.0]])
    anchors = low[:2] + (high - low)[:2] * np.array([[0.1], [0.5], [0.9]])
    none = np.full((3, 3, 3), np.nan)
    drift = Deformation(anchors, np.zeros(3, int), east.storeys["floor"][:1], moves, none, np.full(3, -1, np.int32), 4.0)
    cells, edge = resample_cells(east.grid, Placement(Sim3(), drift), low, east.grid.edge)[0], east.grid.edge
    grid = VoxelGrid.from_cells(cells - cells.min(axis=0), low + cells.min(axis=0) * edge, edge)
    bent_east = tm.extract(grid, name="bent")
    back = _inverse(drift)
    assert np.abs(back.apply(drift.apply(east.grid.compute_centroids())) - east.grid.compute_centroids()).max() < 0.03
    joined = fuse((west, bent_east), [(0, Sim3()), (1, truth(0, 2))], {1: back})
    assert len(joined.rooms) == len(straight.rooms)
    assert np.allclose(sorted(joined.rooms["area"]), sorted(straight.rooms["area"]), atol=1.0)
    of_east = find_joined_rooms(bent_east, joined, truth(0, 2), back)
    assert (of_east >= 0).all()
    rooms, shared = match_common_rooms(west, bent_east, truth(0, 2), (None, back))
    both = find_joined_rooms(west, joined, Sim3())
    assert len(rooms) and shared.max() > 0.9
    assert any(both[i] == of_east[j] for i, j in rooms.tolist())


def _inverse(bend: Deformation) -> Deformation:
    """The moves that undo those of a few wide pieces, finely sampled."""
    x, y = np.meshgrid(*(np.arange(lo - 4, hi + 4, 0.7) for lo, hi in zip(bend.anchors.min(0), bend.anchors.max(0), strict=True)))
    anchors = np.column_stack([x.ravel(), y.ravel()])
    level = np.column_stack([anchors, np.full(len(anchors), bend.floors[0])])
    moves = np.zeros((len(anchors), 4))
    moves[:, :2] = (bend.undo(level) - level)[:, :2]
    none = np.full((len(anchors), 3, 3), np.nan)
    return Deformation(anchors, np.zeros(len(anchors), int), bend.floors, moves, none, np.full(len(anchors), -1, np.int32), 0.7)
