"""Rooms from the plans of the storeys: what sensors and buildings do to them must not change them."""

from __future__ import annotations

import numpy as np
import pytest

from tests import scenes
from tests.extraction.segments import find_rooms_of_segments
from topomerge.extraction.extract import extract
from topomerge.extraction.navigable import compute_navigable_volume, has_floor
from topomerge.extraction.parameters import PRESETS, DefaultParameters
from topomerge.extraction.plans.passages import (
    DOOR_FEATURES,
    Passage,
    compute_clearance,
    compute_door_features,
    find_passages,
    predict_door,
    segment_regions,
)
from topomerge.extraction.plans.plan import _find_box_around, build_storey_plan
from topomerge.extraction.plans.plan_network import COARSEST_STRIDE, compute_column_probabilities
from topomerge.extraction.plans.storey_floor import FLOOR_PROPERTIES, join_floor
from topomerge.extraction.scan import Scan
from topomerge.extraction.segment import LEAST_FLAT_ROOM, LEAST_ROOM, _is_upper_side, score_by_plan
from topomerge.extraction.slices import is_slice
from topomerge.extraction.storeys import find_storeys, measure_floor_to_ceiling
from topomerge.extraction.voxels import voxelise
from topomerge.types import STOREY_DTYPE, Array, PointCloud, TopometricMap, VoxelGrid

CORRIDOR_ROOMS = [(x, y) for x in (2, 6, 10, 14) for y in (2, 8)]


def room_at(result: TopometricMap, x: float, y: float, z: float = 0.0) -> int:
    distance = np.linalg.norm(result.navigable.compute_centroids() - (x, y, z), axis=1)
    return int(result.navigable_room[distance.argmin()])


def is_the_corridor(result: TopometricMap, z: float = 0.0) -> None:
    """Nine rooms: the corridor whole, and eight beside it."""
    hall = {room_at(result, x, 5, z) for x in np.arange(0.5, 16, 0.5)}
    beside = {room_at(result, x, y, z) for x, y in CORRIDOR_ROOMS}
    assert len(hall) == 1 and len(beside) == 8 and not hall & beside and len(result.rooms) == 9


def turned(points: Array, degrees: float) -> Array:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return (points @ np.array([(c, s, 0), (-s, c, 0), (0, 0, 1.0)])).astype(np.float32)


def agreement(a: TopometricMap, b: TopometricMap, back: float = 0.0) -> float:
    """Mean IoU of the rooms of a with their best in b, on a's floor; b is turned by `back` degrees against a."""
    places = turned(a.navigable.compute_centroids(), back)
    row = b.navigable.find_rows(b.navigable.locate(places))
    row = np.where(row >= 0, row, b.navigable.find_rows(b.navigable.locate(places) + (0, 0, 1)))
    label = np.where(row >= 0, b.navigable_room[np.maximum(row, 0)], -1)
    best = []
    for r in range(len(a.rooms)):
        mine = a.navigable_room == r
        others = (label == k for k in np.unique(label[mine]) if k >= 0)
        best.append(max(((mine & other).sum() / (mine | other).sum() for other in others), default=0))
    return float(np.mean(best))


@pytest.fixture(scope="module")
def corridor() -> Array:
    return scenes.corridor().points(0.01)


@pytest.mark.longer
def test_without_lintels(corridor: Array) -> None:
    scene = scenes.Scene().shell(0, 0, 16, 10)
    for y in (4, 6):
        scene.wall((0, y), (16, y), doors=(2.0, 6.0, 10.0, 14.0), lintel=False)
    for x in (4, 8, 12):
        scene.wall((x, 0), (x, 4)).wall((x, 6), (x, 10))
    is_the_corridor(extract(scene.points(0.01)))


@pytest.mark.longer
def test_nothing_above_two_metres(corridor: Array) -> None:
    is_the_corridor(extract(corridor[corridor[:, 2] < 2.0]))


def test_furniture_hides_the_floor_and_stays_in_the_room() -> None:
    scene = scenes.two_rooms()
    scene.box(0.0, 3.5, 0.0, 3.9, 5.0, 0.75)  # a counter through the room
    scene.box(1.0, 0.0, 0.0, 2.0, 0.6, 1.95)  # a cupboard
    points = scene.points(0.005)
    under = (points[:, 0] < 3.85) & (points[:, 1] > 3.55) & (points[:, 2] < 0.7) & (points[:, 1] < 4.9)
    result = extract(points[~under])
    assert len(result.rooms) == 2
    assert result.rooms["area"][room_at(result, 2, 2)] == pytest.approx(20, rel=0.08)
    standing = result.navigable.properties["standing"]
    on_counter = (np.abs(result.navigable.compute_centroids()[:, :2] - (2, 4.2)) < 0.4).all(axis=1)
    assert on_counter.any() and not standing[on_counter].any() and standing.mean() > 0.6


@pytest.mark.longer
def test_sparse_points_get_larger_cells(corridor: Array) -> None:
    few = corridor[np.random.default_rng(0).random(len(corridor)) < 0.05]
    result = extract(few)
    assert result.grid.edge == pytest.approx(0.2) and any("sparse" in w for w in result.warnings)
    is_the_corridor(result)
    assert extract(corridor).grid.edge == 0.1


@pytest.mark.longer
@pytest.mark.parametrize("poses", [True, False])
def test_a_slice_gets_walls_and_a_floor(corridor: Array, poses: bool) -> None:
    points = corridor[np.abs(corridor[:, 2] - 0.3) < 0.04]
    assert is_slice(voxelise(points, 0.1, []))
    cloud = PointCloud(points)
    if poses:  # a laser in the middle of every room, and along the corridor
        places = np.array([(x, y) for x, y in CORRIDOR_ROOMS] + [(x, 5.0) for x in range(1, 16)])
        seen_by = np.linalg.norm(points[:, None, :2] - places, axis=2).argmin(axis=1)
        stand = np.tile(np.eye(4), (len(places), 1, 1))
        stand[:, :2, 3], stand[:, 2, 3] = places, 0.3
        cloud = PointCloud(points, poses=stand, pose_of=seen_by.astype(np.int32))
    result = extract(cloud)
    assert any("slice" in w for w in result.warnings)
    is_the_corridor(result, 0.2)


@pytest.mark.longer
def test_the_upper_half_gets_a_floor(corridor: Array) -> None:
    upper = corridor[corridor[:, 2] > 1.0]
    grid = voxelise(upper, 0.1, [])
    _, navigable = compute_navigable_volume(Scan(grid), DefaultParameters(assume=False))
    assert not has_floor(grid, navigable, 1.75)
    result = extract(upper)
    assert any("no floor was seen" in w for w in result.warnings)
    is_the_corridor(result, float(result.storeys["floor"][0]))
    whole = voxelise(corridor, 0.1, [])
    assert has_floor(whole, compute_navigable_volume(Scan(whole), PRESETS["default"])[1], 1.75)


@pytest.mark.longer
def test_turning_shuffling_and_other_cells_change_little(corridor: Array) -> None:
    result = extract(corridor)
    shuffled = extract(corridor[np.random.default_rng(0).permutation(len(corridor))], carve=False)
    assert (shuffled.room == result.room).all() and (shuffled.rooms == result.rooms).all()
    assert agreement(result, extract(turned(corridor, 27.0)), 27.0) > 0.9
    for edge in (0.05, 0.15):
        assert len(extract(corridor, voxel_size=edge).rooms) == 9


@pytest.mark.parametrize("degrees", [0, 180])
def test_a_room_is_there_without_its_floor_where_walls_and_ceiling_were_seen(degrees: int) -> None:
    points = scenes.two_rooms().points(0.01)
    points = points[(points[:, 0] < 4.3) | (points[:, 2] > 0.3)]  # a camera that was held level in the small room
    result = extract(turned(points, degrees))
    left, right = (room_at(result, *turned(np.array([[x, 2.5, 0.0]]), degrees)[0]) for x in (2, 5.5))
    assert len(result.rooms) == 2 and left != right
    assert result.rooms["area"][[left, right]] == pytest.approx((20, 14), abs=2)


def test_a_room_is_there_without_floor_and_ceiling_where_rays_crossed_it() -> None:
    """A camera with a narrow view, carried through both rooms, sees the walls of the second one only."""
    points = scenes.two_rooms().points(0.01)
    points = points[(points[:, 0] < 4.3) | ((points[:, 2] > 0.3) & (points[:, 2] < 2.2))]
    right = points[:, 0] > 4.07
    stands = np.tile(np.eye(4), (2, 1, 1))
    stands[:, :3, 3] = (2.0, 2.5, 1.5), (5.5, 2.5, 1.5)
    walked = extract(PointCloud(points, poses=stands, pose_of=right.astype(np.int32)))
    places = walked.navigable.compute_centroids()[walked.navigable_room == room_at(walked, 5.5, 2.5)]
    assert room_at(walked, 2, 2.5) != room_at(walked, 5.5, 2.5)
    assert len(places) * walked.navigable.edge**2 == pytest.approx(14, abs=2) and places[:, 0].min() > 3.8
    unknown = extract(points)  # where the camera was is not known: nothing tells that the middle of the second room is empty
    middle = np.abs(unknown.navigable.compute_centroids()[unknown.navigable_room >= 0][:, :2] - (5.5, 2.5)).max(axis=1) < 1
    assert not middle.any()


def test_a_plan_without_anything_beyond_is_as_large_as_its_floor() -> None:
    scan = Scan(voxelise(scenes.two_rooms().points(0.01), 0.1))
    scan, navigable = compute_navigable_volume(scan, PRESETS["default"])
    _, storey = find_storeys(navigable, measure_floor_to_ceiling(scan.grid, navigable, 1.75))
    plan = build_storey_plan(scan.grid, navigable, storey, 0)
    reach = np.ptp(navigable.cells[:, :2], axis=0) + 1
    assert (np.array(plan.wall.shape) == reach + 12).all()  # 0.6 m on all sides


def test_a_plan_grows_by_strides_of_the_network_at_its_beginning() -> None:
    inside = np.zeros((200, 200), bool)
    inside[100:120, 100:120] = True
    first, last, margin = np.array([94, 94]), np.array([125, 125]), 6
    assert _find_box_around(inside, first, last, margin) == (slice(94, 126), slice(94, 126))
    inside[80, 100] = inside[110, 140] = True
    assert _find_box_around(inside, first, last, margin) == (slice(94 - 2 * COARSEST_STRIDE, 126), slice(94, 147))


def test_a_wide_opening_keeps_both_readings() -> None:
    scene = scenes.Scene().shell(0, 0, 10, 5).wall((5, 0), (5, 1.2)).wall((5, 3.8), (5, 5))  # 2.6 m open, no lintel
    result = extract(scene.points(0.005))
    assert len(result.areas) == 2
    assert len(result.rooms) == 2 or (len(result.narrows) == 1 and result.narrows["width"][0] == pytest.approx(2.6, abs=0.4))
    whole = extract(scenes.table().points(0.005))
    assert len(whole.rooms) == len(whole.areas) == 1 and not len(whole.narrows)


@pytest.mark.longer
def test_free_space_is_what_rays_crossed() -> None:
    points = scenes.two_rooms().points()
    right = points[:, 0] > 4.3
    stand = np.eye(4)
    stand[:3, 3] = (2.0, 2.5, 1.5)
    cloud = PointCloud(points[~right], poses=stand[None], pose_of=np.zeros((~right).sum(), np.int32))
    free = extract(cloud).free
    assert free is not None and free.edge == pytest.approx(0.2)
    places = free.compute_centroids()
    assert places[:, 0].max() < 4.4 and (places[:, 2] > -0.1).all() and (places[:, 2] < 2.8).all()
    assert len(free) * free.edge**3 == pytest.approx(4 * 5 * 2.7, rel=0.25)
    swept = extract(points).free  # the sensor's place unknown: swept from views
    assert swept is not None and swept.contains(swept.locate(np.array([(5.5, 2.5, 1.2)])))[0]
    assert not swept.contains(swept.locate(np.array([(4.0, 4.0, 1.2)])))[0]
    assert extract(points, carve=False).free is None


def test_the_upper_side_of_a_ceiling_is_no_storey() -> None:
    """Walls that rise above a thin ceiling, as in building models, make no attic."""
    scene = scenes.Scene().floor(0, 0, 8, 5).floor(0, 0, 8, 5, 2.6)
    for a, b in (((0, 0), (8, 0)), ((0, 5), (8, 5)), ((0, 0), (0, 5)), ((8, 0), (8, 5))):
        scene.wall(a, b, 0.0, 3.6)
    result = extract(scene.points(0.005))
    assert len(result.storeys) == 1 and len(result.rooms) == 1


def test_passages_measure_the_door() -> None:
    grid = voxelise(scenes.two_rooms().points(0.005), 0.1, [])
    _, navigable = compute_navigable_volume(Scan(grid), PRESETS["default"])
    _, storey = find_storeys(navigable, measure_floor_to_ceiling(grid, navigable, 1.75))
    plan = build_storey_plan(grid, navigable, storey, 0)
    clearance = compute_clearance(plan)
    probability = compute_column_probabilities(plan)
    region = segment_regions(plan, probability)
    passages = find_passages(plan, clearance, region, probability)
    x = plan.origin[0] + 0.5 * grid.edge
    at_the_door = [p for p in passages.values() if abs(x + p.place[0] * grid.edge - 4.0) < 0.3]
    assert len(at_the_door) == 1
    values = dict(zip(DOOR_FEATURES, compute_door_features(at_the_door[0], (2.0, 1.5), (20.0, 15.0)), strict=True))
    assert values["width"] == pytest.approx(scenes.DOOR[0], abs=0.11)
    assert values["lintel"] == pytest.approx(scenes.HEIGHT - scenes.DOOR[1], abs=0.15) and values["lintel_cover"] > 0.8
    assert values["jamb"] > 0.8 and values["opens"] > 1.0 and values["length"] < 0.5
    assert predict_door(compute_door_features(at_the_door[0], (2.0, 1.5), (20.0, 15.0))[None])[0] > 0.9
    parted = find_rooms_of_segments(region, clearance, passages, score_by_plan)
    never = find_rooms_of_segments(region, clearance, passages, lambda x, _: np.zeros(len(x)))
    always = find_rooms_of_segments(region, clearance, passages, lambda x, _: np.ones(len(x)), 0.0)
    sizes = np.bincount(region[region >= 0])
    assert len(np.unique(parted[sizes * 0.01 > 1])) == 2
    assert len(np.unique(never)) == 1 and len(np.unique(always)) == len(sizes)


@pytest.mark.parametrize(
    ("side", "least", "rooms"),
    [(7, LEAST_ROOM, 3), (5, LEAST_ROOM, 2), (7, LEAST_FLAT_ROOM, 2), (9, LEAST_FLAT_ROOM, 3)],
    ids=["a room", "tiny", "tiny, of a slice", "a room of a slice"],
)
def test_what_is_tiny_is_part_of_its_neighbour(side: int, least: float, rooms: int) -> None:
    region = np.zeros((20, 60), np.int64)
    region[:, 30:] = 1
    region[:side, 60 - side :] = 2  # squares of 0.81, 0.49 and 0.25 m2
    passage = Passage((0, 0), 0.8, (1.0, 0.0), (0.0,) * 12)
    passages = {(0, 1): passage, (1, 2): passage}
    of_segment = find_rooms_of_segments(region, np.ones(region.shape), passages, lambda x, _: np.full(len(x), 0.9), least)
    assert len(np.unique(of_segment)) == rooms


def test_what_nothing_is_above_at_the_height_of_a_ceiling_is_no_storey() -> None:
    levels = np.array([(0.0, 2.6, 90.0), (2.5, np.nan, 20.0)], STOREY_DTYPE)
    assert _is_upper_side(levels[1], levels[:1])
    for floor, ceiling in ((2.9, np.nan), (2.5, 5.1)):  # a slab above it; something above it
        levels[1] = (floor, ceiling, 20.0)
        assert not _is_upper_side(levels[1], levels[:1])
    assert not _is_upper_side(levels[0], levels[:0])


def test_a_storey_without_a_room_of_its_own_is_none() -> None:
    """Stray cells beside a room that the room reaches: they are its own, not a second storey."""
    floor = np.argwhere(np.ones((20, 20, 1), bool))
    stray = floor[-3:] + (1, 0, 0)
    grid = VoxelGrid.from_cells(np.concatenate([floor, stray]), np.zeros(3), 0.1, (21, 20, 2))
    storeys = np.array([(0.05, 0.35, 0.0), (0.15, np.nan, 0.0)], STOREY_DTYPE)
    cells = np.concatenate([floor, stray])
    number = np.repeat([0, 1], [len(floor), len(stray)])  # of the storey; the stray cells have no room
    tables = dict(zip(FLOOR_PROPERTIES, (np.ones(len(cells), bool), number, -number, -number), strict=True))
    _, used, of_cell = join_floor(grid, storeys, cells, tables)
    assert len(used) == 1 and used["area"][0] == pytest.approx(4.0, abs=0.05)
    assert (of_cell["storey"] == 0).all() and (of_cell["room"] == 0).all()
