"""Maps whose cells lie: rooms strewn over more ground than a building has, storeys that no grid can hold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.scenes_map import building
from topomerge.errors import InputError
from topomerge.io.exports.ros import rasterize_occupancy
from topomerge.io.maps import load_map, save_map
from topomerge.types import TopometricMap, VoxelGrid


def strewn(cells: list[tuple[int, int]], rooms: list[int]) -> TopometricMap:
    """A map whose floor is these cells, with the room of each."""
    map = building(1, 1)
    floor = np.column_stack([np.array(cells), np.zeros(len(cells), int)]).astype(np.int32)
    grid = VoxelGrid.from_cells(floor, np.zeros(3), 0.1)
    label = {(x, y): room for (x, y), room in zip(cells, rooms, strict=True)}
    of = np.array([label[x, y] for x, y in grid.cells[:, :2].tolist()], np.int32)
    none = np.full(len(of), -1, np.int32)
    return replace(map, grid=grid, room=of, navigable=grid, navigable_room=of, navigable_area=none, edges=map.edges[:0])


def test_one_room_at_two_ends_of_the_world(tmp_path: Path) -> None:
    """Two cells 20 km apart: what draws the room would need 40 GB."""
    path = tmp_path / "a.tmap"
    save_map(strewn([(0, 0), (200_000, 200_000)], [0, 0]), path)
    with pytest.raises(InputError, match=r"a\.tmap: damaged \(has rooms that span 4e\+10 columns of cells, the largest 4e\+10"):
        load_map(path)


def test_rooms_that_are_all_over_the_floor(tmp_path: Path) -> None:
    """Each of three rooms may span 49 million columns, all together 100 million."""
    corners = [(0, 0), (6_999, 6_999), (1, 0), (7_000, 6_999), (2, 0), (7_001, 6_999)]
    two, three = tmp_path / "two.tmap", tmp_path / "three.tmap"
    save_map(strewn(corners, [0, 0, 1, 1, -1, -1]), two)
    assert len(load_map(two).rooms) == 3
    save_map(strewn(corners, [0, 0, 1, 1, 2, 2]), three)
    with pytest.raises(InputError, match=r"span 1\.5e\+08 columns of cells, the largest 4\.9e\+07"):
        load_map(three)


def test_far_cells_of_no_room_are_no_harm(tmp_path: Path) -> None:
    """What a laser saw through a window, 20 km away."""
    path = tmp_path / "a.tmap"
    save_map(strewn([(0, 0), (1, 0), (200_000, 200_000)], [0, 1, -1]), path)
    assert len(load_map(path).navigable) == 3


def test_a_storey_that_no_grid_holds() -> None:
    with pytest.raises(InputError, match=r"storey 0 spans 800 by 800 m in cells of 0.1 m: .*extract with larger cells"):
        rasterize_occupancy(strewn([(0, 0), (7_997, 7_997)], [0, 1]), 0)
    assert rasterize_occupancy(strewn([(0, 0), (30, 30)], [0, 1]), 0).free.shape == (33, 33)


@pytest.mark.parametrize(
    ("table", "column", "value", "said"),
    [
        ("edges", "confidence", -7.0, "edges has a confidence that is not from 0 to 1"),
        ("edges", "confidence", 1.5, "edges has a confidence that is not from 0 to 1"),
        ("rooms", "area", -1.0, "rooms has an area below 0"),
        ("storeys", "area", -1.0, "storeys has an area below 0"),
    ],
)
def test_areas_and_probabilities_that_are_none(tmp_path: Path, table: str, column: str, value: float, said: str) -> None:
    map = building(1, 2)
    rows = getattr(map, table).copy()
    rows[column][0] = value
    path = tmp_path / "a.tmap"
    save_map(replace(map, **{table: rows}), path)
    with pytest.raises(InputError, match=said):
        load_map(path)
