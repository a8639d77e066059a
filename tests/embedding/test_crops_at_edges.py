"""Crops of all kinds at the edge of what was seen and beyond it: of the right size, empty where nothing was seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes_map import building
from topomerge import load_embedder
from topomerge.embedding.quarter_turns import TurnedRows
from topomerge.embedding.sheets import build_sheet_arrays
from topomerge.embedding.surroundings import CROP_PART, CROP_SHAPES, DOOR_PART, SHEET_PLANES, WIDE_PART, WIDE_STEP, cut_crops
from topomerge.types import Array, TopometricMap

SIDES = (40, 24)  # pixels of the sheet
STEP = {CROP_PART: 1, WIDE_PART: WIDE_STEP, DOOR_PART: 1}  # pixels of the sheet on a side of each of the crop's
PLACES = {  # middle, and at which place of the sheet its crop is: what lies outside is taken to be at the edge
    "middle": ((20.0, 12.0), (20, 12)),
    "first corner": ((0.0, 0.0), (0, 0)),
    "last corner": ((40.0, 24.0), (40, 24)),
    "one edge": ((7.0, 24.0), (7, 24)),
    "just beyond": ((-3.0, 30.0), (0, 24)),
    "far beyond": ((-5000.0, 12.0), (0, 12)),
    "beyond both": ((1e5, -1e5), (40, 0)),
}


def all_seen(middle: tuple[float, float]) -> dict[str, Array]:
    """Arrays of a sheet all of whose pixels are full, and of one room in it, with a door in its middle."""
    doors = np.full((1, 8, 2), np.nan, np.float32)
    doors[0, 0] = middle
    planes = np.full((*SIDES, len(SHEET_PLANES)), 255, np.uint8)
    return {
        "sheet": planes,
        "sheet_room": np.zeros(SIDES, np.int16),
        "anchor": np.array([middle], np.float32),
        "door_anchor": doors,
    }


def share_seen(part: str, at: tuple[int, int]) -> Array:
    """(side, side) how much of each pixel of a crop about a place of the sheet lies on the sheet."""
    side, step = CROP_SHAPES[part][-2], STEP[part]
    along = []
    for middle, size in zip(at, SIDES, strict=True):
        pixels = middle - side * step // 2 + np.arange(side * step)
        along.append(((pixels >= 0) & (pixels < size)).reshape(side, step).mean(axis=1))
    return np.outer(*along)


@pytest.mark.parametrize("part", CROP_SHAPES)
@pytest.mark.parametrize("place", PLACES)
def test_crops_show_what_lies_on_the_sheet_and_nothing_beyond(part: str, place: str) -> None:
    middle, at = PLACES[place]
    shown = cut_crops(all_seen(middle), part)
    assert shown.shape == (1, *CROP_SHAPES[part]) and shown.dtype == np.uint8
    crop = shown[0, 0] if part == DOOR_PART else shown[0]
    expected = share_seen(part, at)
    assert 0 < expected.sum() < expected.size
    assert np.abs(crop - 255 * expected[..., None]).max() < 1  # rounded down
    if part == DOOR_PART:  # the room has one door
        assert not shown[0, 1:].any()


def far_off(map: TopometricMap) -> TopometricMap:
    """The map with the middle of its first room, and all of its doors, a kilometre outside of what was seen."""
    rooms, edges = map.rooms.copy(), map.edges.copy()
    rooms["centroid"][0, :2] += 1000.0
    edges["centre"][:, 1] -= 1000.0
    return replace(map, rooms=rooms, edges=edges)


def without_walls(map: TopometricMap) -> TopometricMap:
    """The map's lowest layer of cells only."""
    floor = map.grid.cells[:, 2] == 0
    return replace(map, grid=map.grid.replace_cells(map.grid.cells[floor]), room=map.room[floor])


def unseen(map: TopometricMap) -> TopometricMap:
    """The map's rooms without any cell."""
    none = np.zeros((0, 3), np.int32)
    labels = np.zeros(0, np.int32)
    grids = {"grid": map.grid.replace_cells(none), "navigable": map.navigable.replace_cells(none)}
    return replace(map, **grids, room=labels, navigable_room=labels, navigable_area=None)


@pytest.mark.parametrize("part", CROP_SHAPES)
@pytest.mark.parametrize("change", [far_off, without_walls, unseen])
def test_odd_maps_have_crops_of_all_kinds(part: str, change) -> None:
    map = change(building(2))
    shown = cut_crops(build_sheet_arrays(map), part)
    assert shown.shape == (len(map.rooms), *CROP_SHAPES[part])
    if change is not far_off:
        assert not shown[..., SHEET_PLANES.index("wall")].any()
    elif part != DOOR_PART:  # its doors lie beyond the other side, where the sheet ends with the map
        assert not shown[0].any()
    assert shown[..., SHEET_PLANES.index("floor")].any() == (change is not unseen)


@pytest.mark.parametrize("change", [far_off, without_walls, unseen])
def test_odd_maps_have_rows(change) -> None:
    rows = load_embedder()(change(building(2)))
    assert isinstance(rows, TurnedRows) and np.isfinite(rows.rows).all()
    assert np.linalg.norm(rows.rows, axis=2) == pytest.approx(1.0)
