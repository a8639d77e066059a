"""What plans show of analytic buildings."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fusion.plans_of import doubled, grid_of, office
from tests.scenes import HEIGHT, Scene
from topomerge.errors import InputError
from topomerge.registration.storeys import build_plans, find_slices, is_extruded
from topomerge.types import VoxelGrid


def at(plan, mask, x, y) -> bool:
    i, j = np.floor((np.array([x, y]) - plan.origin) / plan.edge).astype(int)
    return bool(mask[i, j])


@pytest.fixture(scope="module")
def room():
    return Scene().shell(0, 0, 6, 4).box(2, 1, 0, 3, 2, 0.75).points()


def test_walls_floor_and_furniture_of_a_room(room):
    (plan,) = build_plans(grid_of(room))
    assert plan.levels[0] == pytest.approx(0.021, abs=0.03)
    assert plan.levels[1] == pytest.approx(HEIGHT + 0.021, abs=0.06)
    assert at(plan, plan.free, 1, 3) and at(plan, plan.free, 5, 2)
    assert at(plan, plan.clutter, 2.5, 1.5) and not at(plan, plan.wall, 2.5, 1.5)
    assert at(plan, plan.wall, 3, 0.05) and at(plan, plan.wall, 6.05, 2)
    assert not (plan.wall & plan.free).any() and not (plan.clutter & (plan.wall | plan.free)).any()
    assert plan.free.sum() * plan.edge**2 == pytest.approx(6 * 4 - 1, rel=0.06)


def test_without_ceiling_and_without_all_that_is_low(room):
    (low,) = build_plans(grid_of(room[room[:, 2] < 2.4]))
    assert np.isfinite(low.levels[0]) and np.isnan(low.levels[1]) and at(low, low.free, 5, 2) and at(low, low.wall, 3, 0.05)
    (high,) = build_plans(grid_of(room[room[:, 2] > 1.0]))
    assert np.isnan(high.levels[0]) and high.levels[1] == pytest.approx(HEIGHT, abs=0.1)
    assert at(high, high.free, 5, 2) and at(high, high.wall, 3, 0.05)
    assert high.floor_guess == pytest.approx(0.0, abs=0.15)


def test_a_slice_shows_walls_and_what_rays_crossed(room):
    cut = room[np.abs(room[:, 2] - 0.3) < 0.04]
    grid = grid_of(cut)
    inside = np.argwhere(np.ones((50, 30), bool)) + 5
    free = grid.replace_cells(np.column_stack([inside, np.zeros(len(inside), int)]))
    (plan,) = build_plans(grid, free)
    assert plan.sliced and find_slices(grid)
    assert at(plan, plan.wall, 3, 0.05) and at(plan, plan.free, 4.5, 1)
    assert not build_plans(grid)[0].free.any()


def test_slices_of_two_storeys():
    scene = office(furnished=False).points()
    cut = scene[np.abs(scene[:, 2] - 0.3) < 0.04]
    above = cut + np.array([0, 0, 3.1], np.float32)
    found = build_plans(grid_of(np.concatenate([cut, above])))
    assert [p.sliced for p in found] == [True, True]
    assert found[1].levels[0] - found[0].levels[0] == pytest.approx(3.1, abs=0.05)


@pytest.mark.longer
def test_storeys_above_each_other():
    found = build_plans(grid_of(doubled(office())))
    assert len(found) == 2
    assert found[1].levels[0] - found[0].levels[0] == pytest.approx(HEIGHT + 0.3, abs=0.1)
    same = found[0].wall & found[1].wall
    assert same.sum() > 0.9 * found[0].wall.sum()


def test_a_tilted_floor_stays_free(room):
    tilted = room.copy()
    tilted[:, 2] += 0.06 * tilted[:, 0]  # 0.36 m over the room: more than a band
    (plan,) = build_plans(grid_of(tilted))
    assert plan.free.sum() * plan.edge**2 > 0.85 * 23


def test_extruded_drawings_are_maps():
    walls = Scene().wall((0, 0), (8, 0), height=2.5).wall((0, 5), (8, 5), height=2.5).wall((0, 0), (0, 5), height=2.5)
    scene = walls.floor(0, 0, 8, 5)
    (plan,) = build_plans(grid_of(scene.points()))
    assert at(plan, plan.wall, 4, 0.05) and at(plan, plan.free, 4, 2.5)


def test_an_empty_map_is_refused():
    with pytest.raises(InputError, match="no occupied cells"):
        build_plans(VoxelGrid.from_cells(np.zeros((0, 3), int)))


def test_a_slice_that_was_given_walls_stays_a_slice(room):
    """Its table is four legs at one height, and nothing is known of heights: extraction assumes walls and a floor."""
    layer = room[np.abs(room[:, 2] - 0.3) < 0.05] * (1, 1, 0)
    cells = grid_of(layer).cells
    walls = np.concatenate([cells + (0, 0, k) for k in range(1, 25)])
    inside = np.stack(np.meshgrid(np.arange(1, 59), np.arange(1, 39), [0]), -1).reshape(-1, 3)
    raised = VoxelGrid.from_cells(np.concatenate([walls, inside]).astype(np.int32))
    assert is_extruded(raised) and not is_extruded(grid_of(room))
    coarse = VoxelGrid.from_cells(raised.cells[raised.cells[:, 2] < 12], edge=0.2)  # what a sparse slice gets
    low = VoxelGrid.from_cells(raised.cells[raised.cells[:, 2] < 12], edge=0.1)
    assert is_extruded(coarse) and not is_extruded(low)
    (plan,) = build_plans(raised)
    assert plan.sliced and at(plan, plan.wall | plan.clutter, 2.5, 0.05) and at(plan, plan.free, 1, 3)
