"""Walls unrolled: what stands where in rooms that are drawn point by point."""

from __future__ import annotations

import numpy as np
import pytest

from tests.extraction.elevations.doors import SHUT_DOOR, three_doors
from topomerge.extraction.elevations.elevation import ACROSS, ALONG, BANDS, BEFORE, PAST_ENDS, Elevations, unroll
from topomerge.extraction.extract import gather_evidence, read_navigable
from topomerge.extraction.parameters import PRESETS
from topomerge.extraction.voxels import voxelise
from topomerge.progress import Stopwatch
from topomerge.types import VoxelGrid

CLOUD = three_doors().points()


@pytest.fixture(scope="module")
def found():
    """Navigable cells and the faces of segments."""
    scan, navigable = read_navigable(CLOUD, 0.1, PRESETS["default"], Stopwatch())
    walls = gather_evidence(scan, navigable, PRESETS["default"], Stopwatch()).walls
    assert walls is not None
    return navigable, walls.elevations.faces


def wall_elevations(found, cells, crossed=None) -> Elevations:
    navigable, faces = found
    return unroll(faces, navigable, cells, crossed)


def between(faces, x):
    """Rows of the faces that lie along y at x."""
    turned = np.abs(faces["along"] @ (1.0, 0.0)) < 0.05
    return np.flatnonzero(turned & (np.abs(faces["start"][:, 0] - x) < 0.04))


def test_each_face_has_its_room_before_it_and_the_wall_behind(found):
    faces = found[1]
    left, right = between(faces, 3.925 + 0.013), between(faces, 4.075 + 0.013)
    assert len(left) and len(right)
    assert (faces["out"][left] @ (1.0, 0.0) > 0.99).all() and (faces["out"][right] @ (1.0, 0.0) < -0.99).all()
    assert len({*faces["room"][left]}) == len({*faces["room"][right]}) == 1
    assert faces["length"][left].max() == pytest.approx(5 + 2 * PAST_ENDS, abs=0.4)


def test_a_leaf_that_lies_back_shows_and_an_open_door_is_empty(found):
    walls = wall_elevations(found, voxelise(CLOUD, 0.05))
    face = max(between(walls.faces, 3.925 + 0.013), key=lambda f: walls.faces["length"][f])
    strip = walls.strips[walls.first[face] : walls.first[face + 1]]
    y = walls.faces["start"][face][1] + walls.faces["along"][face][1] * (np.arange(len(strip)) + 0.5) * ALONG
    depth = (np.arange(strip.shape[1]) + 0.5) * ACROSS - BEFORE
    standing = strip[:, :, 2:10].mean(axis=2)  # 0.3 to 1.9 m
    wall = (y > 0.4) & (y < 1.0)
    leaf, open_door = np.abs(y - SHUT_DOOR) < 0.35, np.abs(y - 4.0) < 0.35
    assert abs(depth[standing[wall].mean(axis=0)[depth < 0.05].argmax()]) <= ACROSS
    front = standing[leaf].mean(axis=0)
    assert front[np.abs(depth) < 0.03].max() < 0.1 * front.max()  # nothing where the face would be
    assert depth[front.argmax()] == pytest.approx(0.05, abs=0.03) or depth[front.argmax()] == pytest.approx(0.09, abs=0.03)
    assert standing[open_door].max() < 0.2 and strip[open_door][:, :, 11].max() > 0.3  # the lintel is above it
    assert strip[open_door][..., BANDS].mean() > 0.15  # where one can walk


def test_rays_went_through_the_open_door_and_not_through_the_shut_one(found):
    """Cells that are free on both sides of the wall, in the open doorway, and before the leaf."""
    cell = 0.2
    nx, ny, nz = 36, 26, 14
    grid = VoxelGrid.from_cells(np.array([(0, 0, 0)]), np.zeros(3), cell, (nx, ny, nz))
    x, y, z = (grid.compute_centroids(np.argwhere(np.ones((nx, ny, nz), bool))))[:, :3].T
    free = (np.abs(x - 4) > 0.2) | ((np.abs(y - 4.0) < 0.4) & (z < 2.2))
    crossed = grid.replace_cells(np.argwhere(np.ones((nx, ny, nz), bool))[free])
    walls, unknown = wall_elevations(found, voxelise(CLOUD, 0.05), crossed=crossed), wall_elevations(found, voxelise(CLOUD, 0.05))
    face = max(between(walls.faces, 3.925 + 0.013), key=lambda f: walls.faces["length"][f])
    strip = walls.strips[walls.first[face] : walls.first[face + 1], :, BANDS + 1 :]
    y = walls.faces["start"][face][1] + walls.faces["along"][face][1] * (np.arange(len(strip)) + 0.5) * ALONG
    depth = (np.arange(strip.shape[1]) + 0.5) * ACROSS - BEFORE
    shut, opened = np.abs(y - SHUT_DOOR) < 0.3, np.abs(y - 4.0) < 0.3
    inside, before = np.abs(depth - 0.075) < 0.05, depth < -0.15
    assert (strip[opened][:, inside] > 0.9).all() and (strip[shut][:, inside] == 0).all()
    assert (strip[shut][:, before] == 1).all() and (strip[opened][:, before] == 1).all()
    assert (
        not unknown.strips[..., BANDS + 1 :].any() and (unknown.strips[..., : BANDS + 1] == walls.strips[..., : BANDS + 1]).all()
    )


def test_strips_hold_shares_and_cover_all_faces(found):
    walls = wall_elevations(found, voxelise(CLOUD, 0.05))
    assert walls.strips.shape == (walls.first[-1], 32, BANDS + 4) and len(walls.first) == len(walls.faces) + 1
    assert walls.strips.min() >= 0 and walls.strips.max() <= 1 and not (np.diff(walls.first) % 2).any()
