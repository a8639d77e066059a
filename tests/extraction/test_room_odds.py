"""Odds of rooms: who was where, by the sensor's places or by what was seen; probabilities that do not depend on order or turn."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from tests import scenes
from tests.cases import list_longer
from topomerge.archive import VARIABLE, find_weights_file
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.extraction.room_odds import (
    GRID_FEATURES,
    POSE_FEATURES,
    ROOM_FEATURES,
    ROOM_ODDS_FILE,
    _iter_storey_floors,
    _measure_outline,
    add_room_probabilities,
    compute_pose_features,
    compute_room_features,
    measure_thin_share,
)
from topomerge.io import read_points
from topomerge.kernels.rays import is_seen_from
from topomerge.types import ROOM_ODDS, Array, PointCloud, Sim3, TopometricMap, add_outline_odds, is_mostly_unseen

LEFT, RIGHT = (2.0, 2.0, 1.4), (6.0, 2.0, 1.4)  # places of a sensor in both rooms


@pytest.fixture(scope="module")
def points() -> Array:
    return scenes.two_rooms().points(0.01)


@pytest.fixture(scope="module")
def glimpse(points: Array) -> Array:
    """A scanner at LEFT looks through the door, which is narrower than the room behind it."""
    beyond = points[:, 0] > 4.2
    slope = (points[:, 1] - 2) / np.maximum(points[:, 0] - 2.0, 0.1)
    rise = (points[:, 2] - 1.4) / np.maximum(points[:, 0] - 2.0, 0.1)
    return points[~beyond | ((np.abs(slope) < scenes.DOOR[0] / 2 / 2.0) & (rise < (scenes.DOOR[1] - 1.4) / 2.0))]


@pytest.fixture(scope="module")
def whole(points: Array) -> TopometricMap:
    """The map of both rooms, for tests that change nothing of it."""
    return extract(points, carve=False)


@pytest.fixture(scope="module")
def cone(glimpse: Array) -> TopometricMap:
    """The map of what the scanner sees."""
    return extract(glimpse, carve=False)


def scan(points: Array, *places: tuple[float, float, float]) -> PointCloud:
    """A cloud of which every place of the sensor saw an equal part."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    return PointCloud(points.astype(np.float32), poses=poses, pose_of=np.arange(len(points), dtype=np.int32) % len(places))


def side_rooms(map: TopometricMap) -> tuple[int, int]:
    """The left and the right room."""
    order = np.argsort(map.rooms["centroid"][:, 0])
    assert len(order) == 2
    return int(order[0]), int(order[1])


@pytest.mark.longer
def test_a_room_without_a_place_of_the_sensor_was_looked_into(points: Array, glimpse: Array) -> None:
    one = extract(scan(points, LEFT), carve=False)
    left, right = side_rooms(one)
    assert one.rooms["entered"][left] > 0.9 and not one.rooms["glimpsed"][left]
    assert one.rooms["entered"][right] < one.rooms["entered"][left]
    both = extract(scan(points, LEFT, RIGHT), carve=False)
    assert (both.rooms["entered"] > 0.9).all() and not both.rooms["glimpsed"].any()
    seen = extract(scan(glimpse, LEFT), carve=False)
    assert seen.rooms["glimpsed"].tolist() == [room == side_rooms(seen)[1] for room in range(2)]
    assert (one.rooms["glimpsed"] == (one.rooms["entered"] < 0.5)).all()
    assert np.array_equal(one.rooms["completeness"], both.rooms["completeness"])


def test_without_places_a_cone_through_the_door_was_looked_into(whole: TopometricMap, cone: TopometricMap) -> None:
    left, right = side_rooms(cone)
    assert cone.rooms["glimpsed"].tolist() == [room == right for room in range(2)]
    assert cone.rooms["entered"][left] > cone.rooms["entered"][right] + 0.3
    assert not whole.rooms["glimpsed"].any() and (whole.rooms["outside"] < 0.2).all()


def test_features_of_a_cone(whole: TopometricMap, cone: TopometricMap) -> None:
    """The looker sees no wall that the door is in; a corner beside the door is seen from within only."""
    both = [compute_room_features(map) for map in (whole, cone)]
    column = {name: k for k, name in enumerate(ROOM_FEATURES)}
    assert all(x.shape == (2, len(ROOM_FEATURES)) and np.isfinite(x).all() for x in both)
    own, seen = (x[np.argsort(-x[:, column["log_area"]])][-1] for x in both)
    assert own[column["walls_hidden"]] > seen[column["walls_hidden"]] + 0.05
    assert seen[column["walls_hidden"]] < 0.1
    assert own[column["ceiling"]] > seen[column["ceiling"]] + 0.2


def test_rays_tell_who_was_where(points: Array, whole: TopometricMap) -> None:
    map = whole
    left, right = side_rooms(map)
    starts = np.where(np.arange(len(points))[:, None] % 4 > 0, LEFT, RIGHT)
    poses = compute_pose_features(map, (starts, points))
    assert poses is not None and poses.shape == (2, len(POSE_FEATURES)) and (poses[:, 0] == 1).all()
    assert poses[left, 1] == pytest.approx(0.75, abs=0.01) and poses[right, 1] == pytest.approx(0.25, abs=0.01)
    alone = compute_pose_features(map, (np.tile(LEFT, (len(points), 1)), points))
    assert alone is not None and alone[right].tolist() == [0, 0] and alone[left].tolist() == [1, 1]


@pytest.mark.longer
@pytest.mark.parametrize(
    "place", [(np.nan, 0.0, 0.0), (2.0, np.inf, 1.4), (500.0, 500.0, 1.4), (2.0, 2.0, 60.0)], ids=["nan", "inf", "far", "high"]
)
def test_places_over_no_room_say_nothing(points: Array, whole: TopometricMap, place: tuple[float, float, float]) -> None:
    """Poses that are no numbers, of another frame or of another building: the map is judged by what was seen of it."""
    map = whole
    starts = np.tile(place, (len(points), 1))
    assert compute_pose_features(map, (starts, points)) is None
    assert np.array_equal(add_room_probabilities(map, (starts, points)).rooms, add_room_probabilities(map).rooms)
    assert compute_pose_features(map, (np.zeros((0, 3)), np.zeros((0, 3)))) is None and compute_pose_features(map, None) is None
    some = np.where(np.arange(len(points))[:, None] % 3 > 0, LEFT, place)  # most are good ones: those count
    assert compute_pose_features(map, (some, points)) is not None


@pytest.mark.longer
def test_odds_are_probabilities_whatever_the_order_and_the_turn(glimpse: Array, cone: TopometricMap) -> None:
    plain = cone.rooms
    assert all(((plain[name] >= 0) & (plain[name] <= 1)).all() for name in ROOM_ODDS)
    shuffled = extract(np.random.default_rng(0).permutation(glimpse), carve=False).rooms
    assert np.array_equal(plain, shuffled)
    turned = extract(Sim3(np.pi / 2).apply(glimpse), carve=False).rooms
    order, other = np.argsort(plain["area"]), np.argsort(turned["area"])
    assert turned["glimpsed"][other].tolist() == plain["glimpsed"][order].tolist()
    for name in ROOM_ODDS:
        assert turned[name][other] == pytest.approx(plain[name][order], abs=0.15)


def test_no_rooms_no_odds(whole: TopometricMap) -> None:
    map = whole
    none = np.full(len(map.navigable), -1, np.int32)
    empty = replace(
        map,
        room=np.full(len(map.grid), -1, np.int32), navigable_room=none, navigable_area=none, rooms=map.rooms[:0],
        edges=map.edges[:0], areas=map.areas[:0], narrows=map.narrows[:0],
    )  # fmt: skip
    assert len(add_room_probabilities(empty).rooms) == 0 and compute_room_features(empty).shape == (0, len(ROOM_FEATURES))


@pytest.mark.longer
def test_by_the_outline_alone(points: Array, whole: TopometricMap) -> None:
    """Maps of the thesis' preset, and of earlier files."""
    rooms = whole.rooms.copy()
    rooms["completeness"] = (0.59, 0.6)
    odds = add_outline_odds(rooms)
    assert is_mostly_unseen(rooms).tolist() == odds["glimpsed"].tolist() == [True, False]
    assert odds["entered"].tolist() == [0, 1] and odds["whole"].tolist() == [0, 1]
    thesis = extract(points, preset="thesis").rooms
    assert np.array_equal(thesis["glimpsed"], is_mostly_unseen(thesis))


@pytest.mark.parametrize(
    "change", [{"features": ["none"]}, {"entered": [1.0]}, {"scale": [float("nan")] * 13}, {"open": {}}, {"grids": [1.0]}]
)
def test_damaged_weights_are_named(whole: TopometricMap, change: dict[str, object], tmp_path, monkeypatch) -> None:
    values = json.loads(find_weights_file("topomerge.extraction", ROOM_ODDS_FILE).read_text())
    (tmp_path / ROOM_ODDS_FILE).write_text(json.dumps({**values, **change}))
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    with pytest.raises(InputError, match="room_odds.json: .*task=room_odds"):
        add_room_probabilities(whole)


@pytest.mark.longer
def test_sight_ends_at_what_is_not_free() -> None:
    free = np.ones((9, 9), bool)
    free[4] = False
    free[4, 4] = True  # a door
    targets = np.array([[6, 4], [6, 8], [8, 6], [5, 0]])
    assert is_seen_from(free, targets, np.array([[0, 4]]), 20.0).tolist() == [True, False, False, False]
    assert is_seen_from(free, targets, np.array([[0, 4], [2, 3]]), 20.0).tolist() == [True, False, True, False]
    assert not is_seen_from(free, targets, np.array([[0, 4]]), 5.0).any()
    assert not is_seen_from(free, targets, np.zeros((0, 2), np.int64), 20.0).any()


@pytest.fixture(scope="module")
def fan_grid(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., TopometricMap]:
    """Maps of a picture of two rooms of 6 m x 5 m with a door, and of rays that left through a window of the right one."""

    def make(cell: float, spread: float, window: float, reach: float) -> TopometricMap:
        """The map, with a window `window` m wide, rays within +- `spread` rad, `reach` m long."""
        size = np.array([13.0 + reach, max(6.0, 2 * reach * np.sin(spread) + window + 1)])
        x, y = np.meshgrid(*((np.arange(int(s / cell)) + 0.5) * cell for s in size), indexing="ij")
        y = y - size[1] / 2
        image = np.full(x.shape, 205, np.uint8)
        building = (x > 0.3) & (x < 12.7) & (np.abs(y) < 2.7)
        wall = building & ((x < 0.5) | (x > 12.5) | (np.abs(y) > 2.5) | ((np.abs(x - 6.5) < 0.1) & (np.abs(y) > 0.5)))
        image[building] = 254
        image[wall] = 0
        out = (x > 12.4) & (np.abs(y) < window / 2 + (x - 12.7).clip(0) * np.tan(spread)) & (x < 12.7 + reach)
        angle = np.arctan2(y, x - 11.5)
        image[out & ((np.sin(angle * 40) > -0.4) | (x < 14.0))] = 254  # single rays, farther away
        path = tmp_path_factory.mktemp("fan") / "map.png"
        Image.fromarray(image.T[::-1]).save(path)
        return extract(read_points(path, resolution=cell))

    return make


FANS = [(0.05, 0.5, 1.5, 5.0), (0.05, 0.2, 1.2, 8.0), (0.1, 0.7, 2.0, 4.0), (0.04, 0.35, 2.5, 6.0)]


@pytest.mark.parametrize(("cell", "spread", "window", "reach"), [FANS[0], *list_longer(*FANS[1:])])
def test_rays_through_a_window_of_a_grid_are_only_looked_into(fan_grid, cell, spread, window, reach) -> None:
    """Rays that end nowhere bound no room; the rooms that the robot stood in are not held for looked into because of them."""
    rooms = fan_grid(cell, spread, window, reach).rooms
    outside = rooms["centroid"][:, 0] > 12.7
    assert outside.any() and rooms["glimpsed"][outside].all() and (rooms["entered"][outside] < 0.3).all()
    large = ~outside & (rooms["area"] > 15)
    assert large.any() and not rooms["glimpsed"][large].any() and (rooms["outside"][large] < 0.3).all()
    assert (rooms["outside"][outside] > 0.1).all() and (rooms["outside"][outside].min() > rooms["outside"][large].max())


def test_rays_have_an_open_outline_and_are_thin(fan_grid) -> None:
    map = fan_grid(*FANS[0])
    x = dict(zip(GRID_FEATURES, compute_room_features(map, GRID_FEATURES).T, strict=True))
    outside = map.rooms["centroid"][:, 0] > 12.7
    assert (x["open_outline"][outside] > 0.3).all() and (x["open_outline"][~outside] < 0.1).all()
    assert (x["thin"][~outside & (map.rooms["area"] > 15)] < 0.05).all()


@pytest.mark.parametrize("edge", [0.05, 0.1, 0.2])
def test_a_single_ray_is_thin_and_a_room_is_not(edge: float) -> None:
    room, ray = np.zeros((2, 100, 100), bool)
    room[10:50, 10:50] = True
    ray[10:90, 10 : 10 + round(0.4 / edge)] = True
    assert measure_thin_share(room, edge) < 0.01 and measure_thin_share(ray, edge) == 1
    joined = room.copy()
    joined[50:90, 20 : 20 + round(0.4 / edge)] = True
    assert measure_thin_share(joined, edge) == pytest.approx((joined & ~room).sum() / joined.sum(), abs=0.1)


def test_grids_and_scans_are_weighed_by_models_of_their_own(whole: TopometricMap) -> None:
    scan, grid = add_room_probabilities(whole).rooms, add_room_probabilities(whole, None, raised=True).rooms
    assert not np.array_equal(scan["entered"], grid["entered"]) and ((grid["entered"] >= 0) & (grid["entered"] <= 1)).all()


def house_and_garden(rough: float, plants: int) -> Array:
    """Points of two rooms with ceilings, and of 8 m x 8 m of uneven ground before an open door of 1.6 m, with bushes on it."""
    rng = np.random.default_rng(3)
    rooms = scenes.two_rooms().points(0.03)
    low, high = rooms.min(axis=0), rooms.max(axis=0)
    middle = (low[1] + high[1]) / 2
    door = (rooms[:, 0] > high[0] - 0.3) & (abs(rooms[:, 1] - middle) < 0.8) & (rooms[:, 2] > 0.1) & (rooms[:, 2] < 2.1)
    x, y = np.meshgrid(np.arange(high[0] - 0.3, high[0] + 8, 0.05), np.arange(middle - 4, middle + 4, 0.05), indexing="ij")
    bumps = rough * (np.sin(x * 1.3) + np.cos(y * 1.7 + x))
    ground = np.column_stack([x.ravel(), y.ravel(), np.where(x > high[0] + 0.3, bumps, 0).ravel()])
    at = np.array([high[0] + 1.5, middle - 4, 0]) + rng.random((plants, 3)) * (6.5, 8, 0)
    leaves = [place + rng.normal(0, 1, (400, 3)) * (0.3, 0.3, 0.3) + (0, 0, 0.5) for place in at]
    return np.concatenate([rooms[~door], ground, *leaves])


@pytest.mark.longer
@pytest.mark.parametrize(("rough", "plants"), [(0.0, 0), (0.04, 6), (0.08, 15)])
def test_a_garden_seen_from_a_house_is_outside(rough: float, plants: int) -> None:
    """Ground without a ceiling lies out of doors where the rooms of that scan have one."""
    rooms = extract(house_and_garden(rough, plants), carve=False).rooms
    indoors = rooms["centroid"][:, 0] < 8.0
    garden = ~indoors & (rooms["area"] > 10)
    assert garden.any() and (rooms["outside"][garden] > 0.5).all()
    assert (rooms["outside"][indoors & (rooms["area"] > 5)] < 0.3).all()


def test_an_outline_is_the_same_in_the_box_of_its_room_and_in_the_whole_raster(points: Array) -> None:
    storey = next(_iter_storey_floors(extract(points, name="two")))
    told = []
    for pad in ((0, 0), (7, 3), (40, 40)):
        room, wall = np.pad(storey.room, pad, constant_values=-1), np.pad(storey.wall, pad)
        told.append(_measure_outline(replace(storey, room=room, wall=wall), 0, (slice(None), slice(None))))
    assert told[0]["contact"] > 0 and told[0]["walls_hidden"] > 0
    for name in ("thin", "contact", "log_width", "open_outline"):
        assert len({one[name] for one in told}) == 1
