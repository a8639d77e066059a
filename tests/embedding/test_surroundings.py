"""Storeys from above and crops about rooms: where things stand, that turned maps give turned crops, and what is left empty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from tests.matching.turned_maps import turned
from tests.scenes_map import building
from topomerge.embedding.sheets import build_sheet_arrays, rasterise_sheet
from topomerge.embedding.surroundings import (
    CEILING_UNIT,
    CROP,
    CROP_PART,
    CROP_PLANES,
    DOOR_CROP,
    DOOR_PART,
    SHEET_PIXEL,
    SHEET_PLANES,
    WIDE_PART,
    cut_crops,
)
from topomerge.structure.lines import estimate_wall_directions
from topomerge.types import TopometricMap

PLANE = {name: k for k, name in enumerate(CROP_PLANES)}


def views(map: TopometricMap) -> np.ndarray:
    return cut_crops(build_sheet_arrays(map)).astype(float) / 255


def test_a_crop_shows_the_room_in_its_middle_its_walls_and_what_lies_beyond():
    map = building(2)
    room = views(map)[0]  # 4 by 5 m, its walls 0.1 m wide about it
    middle = CROP // 2
    assert room[middle - 4 : middle + 4, middle - 4 : middle + 4, PLANE["room"]].all()
    assert room[..., PLANE["room"]].sum() * SHEET_PIXEL**2 == pytest.approx(20.0, rel=0.1)
    assert room[middle - 8 : middle + 8, :, PLANE["wall"]].sum() > 20
    floor = room[..., PLANE["floor"]].sum() * SHEET_PIXEL**2
    assert floor > 2 * 20.0  # of the corridor and the rooms beside it as well
    assert not room[middle, middle, PLANE["wall"]] and not room[..., PLANE["low"]].any()


def test_doors_stand_where_the_edges_are():
    map = building(1)
    drawn = rasterise_sheet(map)
    planes = drawn.planes[..., SHEET_PLANES.index("door")] > 0
    middle = np.argwhere(planes).mean(axis=0) + 0.5
    expected = map.edges["centre"][:, :2].mean(axis=0) - map.rooms["centroid"][0, :2]
    assert middle - drawn.anchor[0] == pytest.approx(expected / SHEET_PIXEL, abs=0.6)


def alike(one: np.ndarray, other: np.ndarray) -> float:
    """Correlation of two stacks of crops, a little blurred: what lies on the border of two pixels falls into either."""
    a, b = (ndimage.uniform_filter(x, (1, 3, 3, 1)).ravel() for x in (one, other))
    return float(np.corrcoef(a, b)[0, 1])


@pytest.mark.parametrize("pairs", [1, 2, 3])
def test_a_map_that_was_turned_has_crops_that_are_turned(pairs):
    map = building(pairs)
    other, _ = turned(map, (30.0, -7.0, 2.0))
    right = [alike(views(other), np.rot90(views(map), k, (1, 2))) for k in range(4)]
    assert right[1] > 0.97 and right[1] == max(right)
    assert right[3] < 0.9


def test_a_map_that_was_moved_has_the_same_crops():
    assert alike(views(building(2)), views(building(2, origin=(-31.0, 12.0, 4.5)))) > 0.999


def test_no_crop_shows_another_storey():
    one, two = building(2), building(2, storeys=2)
    half = len(two.rooms) // 2
    same = [PLANE[name] for name in ("wall", "floor", "low", "high")]
    assert alike(views(two)[:half][..., same], views(one)[..., same]) > 0.99
    upper, lower = views(two)[half:], views(two)[:half]
    assert alike(upper[..., [PLANE["wall"]]], lower[..., [PLANE["wall"]]]) > 0.99


def test_ceilings_tell_their_height():
    ceiling = views(building(1))[..., PLANE["ceiling"]]
    heights = ceiling[ceiling > 0] * 255 * CEILING_UNIT
    assert np.median(heights) == pytest.approx(3.0, abs=0.1)
    middle = CROP // 2
    assert (ceiling[:2, middle - 4 : middle + 4, middle - 4 : middle + 4] > 0).all()


def test_beyond_the_edge_of_a_map_nothing_is_seen():
    room = views(building(1))[0]
    assert not room[: CROP // 2 - 12].any()


def test_a_storey_without_walls_stands_as_its_map_does():
    map = building(1)
    floor = map.grid.cells[:, 2] == 0
    flat = replace(map, grid=map.grid.replace_cells(map.grid.cells[floor]), room=map.room[floor])
    drawn = rasterise_sheet(flat)
    assert drawn.turn.tolist() == [0.0] and not drawn.planes[..., 0].any()
    assert cut_crops(build_sheet_arrays(flat)).shape == (len(map.rooms), CROP, CROP, len(CROP_PLANES))


@pytest.mark.parametrize("degrees", [0.0, 0.3, 17.0, 44.9, 45.2, 89.6])
def test_the_direction_of_walls_is_that_of_most_of_them(degrees):
    rng = np.random.default_rng(0)
    along = np.column_stack([rng.uniform(0, 30, 900), np.repeat([0.0, 4.0, 9.0], 300)])
    across = np.column_stack([np.repeat([2.0, 11.0], 150), rng.uniform(0, 9, 300)])
    slanted = np.column_stack([rng.uniform(0, 9, 150)] * 2)
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    walls = (np.concatenate([along, across, slanted]) + rng.normal(0, 0.02, (1350, 2))) @ turn
    off = np.degrees(estimate_wall_directions(walls)[0]) - degrees
    assert abs((off + 45) % 90 - 45) < 0.35


@pytest.mark.parametrize("between", [18.0, 36.0, 50.0])
def test_walls_of_a_second_wing_have_a_direction_of_their_own(between):
    rng = np.random.default_rng(1)
    wings = []
    for degrees, length in ((12.0, 30.0), (12.0 + between, 18.0)):
        along = np.column_stack([rng.uniform(0, length, 900), np.repeat([0.0, 4.0, 9.0], 300)])
        across = np.column_stack([np.repeat([2.0, 11.0], 150), rng.uniform(0, 9, 300)])
        angle = np.radians(degrees)
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        wings.append(np.concatenate([along, across])[: 1200 if length > 20 else 700] @ turn + (0, length))
    walls = np.concatenate(wings) + rng.normal(0, 0.02, (1900, 2))
    assert np.degrees(estimate_wall_directions(walls)) == pytest.approx([12.0, 12.0 + between], abs=0.5)
    assert len(estimate_wall_directions(wings[0])) == 1


def test_a_sheet_of_another_direction_is_turned_by_it():
    flat = rasterise_sheet(building(3))
    tilted = rasterise_sheet(building(3), tilt=np.radians(30))
    assert flat.tilts == () and np.degrees(tilted.turn - flat.turn) == pytest.approx(30.0)
    ways = [(sheet.anchor[0] - sheet.anchor[-1]) @ np.array([1, 1j]) for sheet in (flat, tilted)]
    assert np.degrees(np.angle(ways[1] / ways[0])) == pytest.approx(-30.0, abs=0.1)


def test_no_walls_have_no_direction():
    assert estimate_wall_directions(np.zeros((0, 2))) == (0.0,)


def test_a_wide_crop_shows_twice_as_far_in_means_of_pixels():
    arrays = build_sheet_arrays(building(3))
    fine, wide = (cut_crops(arrays, part).astype(float) for part in (CROP_PART, WIDE_PART))
    inner = wide[:, 8:24, 8:24]  # the 16 m of the finer crop
    means = fine.reshape(len(fine), 16, 4, 16, 4, -1).mean(axis=(2, 4))
    assert np.abs(inner - means).max() < 1.0
    assert wide[..., PLANE["floor"]].sum() * 16 > fine[..., PLANE["floor"]].sum()


def test_crops_of_doors_have_the_door_in_their_middle_and_show_which_room_is_meant():
    arrays = build_sheet_arrays(building(2))
    shown, doors = cut_crops(arrays, DOOR_PART), np.isfinite(arrays["door_anchor"]).all(axis=2).sum(axis=1)
    middle = DOOR_CROP // 2
    for room, count in zip(shown, doors, strict=True):
        assert (room[:count, middle - 1 : middle + 1, middle - 1 : middle + 1, PLANE["door"]] > 0).all()
        assert not room[count:].any() and count
        assert (room[:count, ..., PLANE["room"]].sum(axis=(1, 2)) > 0).all()


def test_doors_stand_in_the_same_place_where_a_room_was_only_looked_into():
    """Half a room has its middle elsewhere; what is seen about its door is the same."""
    map = building(2)
    far = map.navigable.compute_centroids()[:, 1] > np.median(map.navigable.compute_centroids()[map.navigable_room == 0, 1])
    half = replace(map, navigable_room=np.where((map.navigable_room == 0) & far, -1, map.navigable_room))
    one, other = (cut_crops(build_sheet_arrays(m), DOOR_PART)[0, 0, ..., PLANE["wall"]] for m in (map, half))
    assert np.array_equal(one, other) and one.any()
