"""Doors between rooms drawn by hand, one cell of floor after the other: where they are, how wide, which way they lead."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.extraction.plans.storey_plan import Floor
from topomerge.extraction.topology import _find_columns, find_edges
from topomerge.types import STOREY_DTYPE, Array, VoxelGrid

EDGE = 0.05
ORIGIN = np.array([5.0, -2.0, 0.3])


def edges_of(plan: Array, body: float = 0.0, above: Array | float = 2.0, storey_of_room: tuple[int, ...] = (0, 0)) -> Array:
    """Edges of a plan (nx, ny) of rooms, -1 none: floor at one height.

    Args:
        body: m, how much wider than the plan passages are.
        above: m of empty space above the cells (nx, ny).
        storey_of_room: of each room.
    """
    x, y = np.nonzero(plan >= 0)
    columns = np.column_stack([x, y, np.zeros(len(x), int)])
    floor_to_ceiling = np.broadcast_to(above, plan.shape)[x, y]
    cells = VoxelGrid.from_cells(columns, ORIGIN, EDGE, (*plan.shape, 1), {"room": plan[x, y], "above": floor_to_ceiling})
    room, none = cells.properties["room"].astype(np.int32), np.zeros(len(cells), np.int32)
    floor = Floor(cells, np.zeros(1, STOREY_DTYPE), none, room, room, np.arange(2, dtype=np.int32), none, body)
    return find_edges(floor, room, np.array(storey_of_room), cells.properties["above"])


def rooms_with_gap(width: int, thick: int = 3, start: int = 20) -> Array:
    """Two rooms of 3 x 3 m side by side along x, a wall between them with a gap `width` cells wide that belongs to the first."""
    plan = np.full((120 + thick, 60), -1)
    plan[:60], plan[60 + thick :] = 0, 1
    plan[60 : 60 + thick, start : start + width] = 0
    return plan


@pytest.mark.parametrize("width", [9, 14, 18, 20, 26])
def test_a_door_is_as_wide_as_the_gap_in_the_wall(width):
    (door,) = edges_of(rooms_with_gap(width))
    assert door["width"] == pytest.approx(width * EDGE, abs=0.6 * EDGE)
    assert door["centre"][:2] == pytest.approx(ORIGIN[:2] + np.array([61.5, 20 + width / 2]) * EDGE, abs=2 * EDGE)
    assert door["centre"][2] == pytest.approx(ORIGIN[2] + EDGE / 2) and door["rooms"].tolist() == [0, 1]
    assert door["kind"] == "door" and door["open"]


def test_a_door_is_wider_than_where_a_body_fits():
    """Where cells tell where a body's middle may be, half a body is free on both sides of them."""
    (door,) = edges_of(rooms_with_gap(12), body=0.3)
    assert door["width"] == pytest.approx(12 * EDGE + 0.3, abs=0.6 * EDGE)


@pytest.mark.parametrize(("width", "kind"), [(30, "door"), (34, "opening")])
def test_what_is_wider_than_160_cm_is_an_opening(width, kind):
    assert edges_of(rooms_with_gap(width, start=10))["kind"].tolist() == [kind]


def test_the_direction_is_the_normal_of_the_wall():
    along_x, along_y = edges_of(rooms_with_gap(18))["direction"][0], edges_of(rooms_with_gap(18).T.copy())["direction"][0]
    assert min(along_x, np.pi - along_x) < 0.05 and along_y == pytest.approx(np.pi / 2, abs=0.05)


def test_the_height_is_that_of_the_lintel():
    plan = rooms_with_gap(18)
    above = np.full(plan.shape, 2.7)
    above[60:63] = 2.05
    assert edges_of(plan, above=above)["height"][0] == pytest.approx(2.05)


def test_two_doors_of_one_wall_are_two_and_a_post_in_a_door_parts_none():
    plan = rooms_with_gap(16, start=5)
    plan[60:63, 40:56] = 0
    left, right = edges_of(plan)
    assert [left["centre"][1], right["centre"][1]] == pytest.approx([ORIGIN[1] + 13 * EDGE, ORIGIN[1] + 48 * EDGE], abs=2 * EDGE)
    post = rooms_with_gap(22)
    post[60:63, 30:32] = -1
    assert len(edges_of(post)) == 1


def test_rooms_of_two_storeys_meet_at_stairs():
    assert edges_of(rooms_with_gap(18), storey_of_room=(0, 1))["kind"].tolist() == ["stairs"]


def test_rooms_without_a_gap_have_no_door():
    assert not len(edges_of(rooms_with_gap(0)))


def test_each_column_comes_once_in_ascending_order():
    cells = np.random.default_rng(0).integers(0, 9, (200, 3)).astype(np.int32)
    columns = _find_columns(cells)
    np.testing.assert_array_equal(columns, np.unique(cells[:, :2], axis=0))
    assert columns.dtype == cells.dtype
