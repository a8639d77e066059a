"""Rows of equal modules: moved by a period a row lies on itself, wall by wall, door by door and thing by thing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from topomerge.datasets.buildings.modules import (
    MODULE_LAYOUTS,
    ModuleRow,
    copy_furniture,
    draw_module,
    find_module_rooms,
    make_row,
    replace_clutter,
    replace_furniture,
    replace_things,
)
from topomerge.datasets.core.building import SURFACES, Difficulty

COUNT = 4  # modules


@pytest.fixture(scope="module", params=[(layout, both) for layout in MODULE_LAYOUTS for both in (False, True)])
def row(request) -> ModuleRow:
    layout, both = request.param
    module = replace(draw_module(layout, np.random.default_rng(3)), both=both)
    return make_row(module, COUNT, Difficulty(), 3, "row")


def shifted(row: ModuleRow, k: int) -> np.ndarray:
    return np.array([k * row.period, 0.0])


def test_inner_modules_are_congruent_a_period_apart(row) -> None:
    rooms = row.building.rooms
    first, second = find_module_rooms(row.module, 1), find_module_rooms(row.module, 2)
    assert len(first) == len(second) >= 2 and len(rooms) == COUNT * len(first)
    for i, j in zip(first, second, strict=True):
        assert rooms[i].kind == rooms[j].kind
        assert np.allclose(np.sort(rooms[i].polygon + shifted(row, 1), axis=0), np.sort(rooms[j].polygon, axis=0), atol=2e-3)


def test_doors_stand_at_the_same_place_of_each_module_and_stand_open_alike(row) -> None:
    doors = row.building.doors[(row.module[row.building.doors["rooms"]] == 1).all(axis=1)]
    others = row.building.doors[(row.module[row.building.doors["rooms"]] == 3).all(axis=1)]
    assert len(doors) == len(others) > 0
    for door in doors:
        far = np.linalg.norm(others["centre"][:, :2] - door["centre"][:2] - shifted(row, 2), axis=1)
        same = others[far.argmin()]
        assert far.min() < 2e-3 and same["width"] == pytest.approx(door["width"], abs=2e-3) and same["state"] == door["state"]


def test_all_modules_can_be_reached_on_foot(row) -> None:
    assert len(set(row.building.find_components().tolist())) == 1


def test_windows_repeat_with_the_period(row) -> None:
    """Middles of the panes of an inner bay, and of the next one."""
    building = row.building
    panes = building.vertices[building.triangles[building.labels == SURFACES.index("glass")]].astype(float).mean(axis=1)
    first, second = (panes[(panes[:, 0] > k * row.period) & (panes[:, 0] < (k + 1) * row.period)] for k in (1, 2))
    assert len(first) == len(second) > 0
    far = np.linalg.norm((first + [*shifted(row, 1), 0.0])[:, None] - second[None], axis=2)
    assert far.min(axis=1).max() < 5e-3


def test_furniture_is_copied_thing_by_thing(row) -> None:
    source, target = find_module_rooms(row.module, 1), find_module_rooms(row.module, 3)
    filled = replace_furniture(row.building, source, 1.3, 0.8, np.random.default_rng(0))
    both = copy_furniture(filled, source, target, shifted(row, 2))
    things = both.things[both.things["kind"] != "leaf"]
    here, there = (things[np.isin(things["room"], rooms)] for rooms in (source, target))
    assert len(here) == len(there) > 0
    assert np.allclose(here["centre"][:, :2] + shifted(row, 2), there["centre"][:, :2])
    assert here["kind"].tolist() == there["kind"].tolist() and np.allclose(here["yaw"], there["yaw"])
    loose = both.things["kind"] != "leaf"
    numbers = (np.flatnonzero(loose & np.isin(both.things["room"], rooms)) for rooms in (source, target))
    for one, other in zip(*numbers, strict=True):
        meshes = [both.vertices[both.triangles[both.thing_of == k]] for k in (one, other)]
        assert np.allclose(meshes[0] + [*shifted(row, 2), 0], meshes[1], atol=1e-4)


def test_what_is_replaced_leaves_the_shell_alone(row) -> None:
    rng = np.random.default_rng(0)
    filled = replace_furniture(row.building, range(len(row.building.rooms)), 1.3, 0.8, rng)
    shell = [b.vertices[b.triangles[b.thing_of < 0]] for b in (row.building, filled)]
    assert np.array_equal(*shell)
    bare = replace_furniture(filled, range(len(row.building.rooms)), 0.0, 0.0, rng)
    assert set(bare.things["kind"]) <= {"leaf", "column"} and len(bare.things) == len(row.building.things)
    gone = np.zeros(len(filled.things), bool)
    same = replace_things(filled, gone, [])
    assert np.array_equal(same.vertices[same.triangles], filled.vertices[filled.triangles])
    assert np.array_equal(same.thing_of, filled.thing_of)


@pytest.mark.longer
def test_only_clutter_is_strewn_anew(row) -> None:
    rng = np.random.default_rng(1)
    rooms = range(len(row.building.rooms))
    filled = replace_furniture(row.building, rooms, 1.0, 2.0, rng)
    again = replace_clutter(filled, rooms, 2.0, rng)
    lasting = [b.things[b.things["kind"] != "clutter"] for b in (filled, again)]
    assert np.array_equal(*lasting)
    strewn = [b.things[b.things["kind"] == "clutter"]["centre"] for b in (filled, again)]
    assert len(strewn[1]) > 0 and not np.array_equal(*strewn)
