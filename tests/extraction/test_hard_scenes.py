"""Split levels, roof terraces, stairwells, fixed seats and cubicles: what of them comes out as people would draw it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tests.cases import list_longer
from tests.scenes import HEIGHT, Scene, rectangle, stair
from topomerge.extraction.extract import extract
from topomerge.types import Array, PointCloud, TopometricMap

PARAPET = 1.0  # m
ROWS = 9  # of seats


def pairs(map: TopometricMap) -> set[tuple[int, int]]:
    return {(min(a, b), max(a, b)) for a, b in map.edges["rooms"].tolist()}


def room_at(map: TopometricMap, x: float, y: float, z: float) -> int:
    """Room of the navigable cell nearest to a point."""
    return int(map.navigable_room[np.linalg.norm(map.navigable.compute_centroids() - (x, y, z), axis=1).argmin()])


def flight(scene: Scene, x: float, y: tuple[float, float], low: float, high: float, tread: float = 0.28) -> None:
    """Seven steps up along +x."""
    rise = (high - low) / 7
    for k in range(7):
        scene.parts.append(rectangle((x + k * tread, y[0], low + k * rise), (0, y[1] - y[0], 0), (0, 0, rise)))
        scene.parts.append(rectangle((x + k * tread, y[0], low + (k + 1) * rise), (tread, 0, 0), (0, y[1] - y[0], 0)))


def half_house(scene: Scene, x: float, z: float) -> None:
    """A hall of 6 x 4 m and two rooms of 3 x 4 m behind it; its outer walls along x."""
    scene.floor(x, 0, x + 6, 8, z).floor(x, 0, x + 6, 8, z + HEIGHT)
    scene.wall((x, 4), (x + 6, 4), z, doors=(1.5, 4.5)).wall((x + 3, 4), (x + 3, 8), z)
    scene.wall((x, 0), (x + 6, 0), z).wall((x, 8), (x + 6, 8), z)


def split_levels(rise: float) -> Scene:
    """Two halves of a house on both sides of a flight of 2 x 1.2 m, which begins at x = 6 and ends at x = 8."""
    scene = Scene()
    half_house(scene, 0, 0.0)
    half_house(scene, 8, rise)
    scene.wall((0, 0), (0, 8)).wall((14, 0), (14, 8), rise)
    for x, z in ((6, 0.0), (8, rise)):  # the shaft is open to both halls, up to 2.1 m
        scene.wall((x, 0), (x, 0.4), z).wall((x, 1.6), (x, 8), z).wall((x, 0.4), (x, 1.6), z + 2.1, HEIGHT - 2.1)
    for y in (0.4, 1.6):
        scene.wall((6, y), (8, y), 0, rise + HEIGHT)
    scene.floor(6, 0.4, 8, 1.6, rise + HEIGHT)
    flight(scene, 6, (0.4, 1.6), 0.0, rise, 2 / 7)
    return scene


@pytest.mark.parametrize("rise", [1.4, *list_longer(1.2, 1.5)])
def test_two_half_levels_are_rooms_that_one_can_walk_between(rise: float) -> None:
    map = extract(split_levels(rise).points(0.005))
    places = [(3, 2, 0), (1.5, 6, 0), (4.5, 6, 0), (11, 2, rise), (9.5, 6, rise), (12.5, 6, rise)]
    lower, a, b, upper, c, d = rooms = [room_at(map, *place) for place in places]
    assert len(set(rooms)) == 6 and len(map.rooms) in (6, 7)  # the flight is a room of its own, or a part of a hall
    assert map.rooms["area"][rooms] == pytest.approx([24, 12, 12, 24, 12, 12], rel=0.12)
    assert map.rooms["centroid"][rooms, 2] == pytest.approx([0, 0, 0, rise, rise, rise], abs=0.15)
    joined = pairs(map)
    assert {(min(p), max(p)) for p in ((lower, a), (lower, b), (upper, c), (upper, d))} <= joined
    flight_of = next(iter(set(range(len(map.rooms))) - set(rooms)), lower)
    assert {(min(p), max(p)) for p in ((lower, flight_of), (upper, flight_of)) if p[0] != p[1]} <= joined


def three_half_levels(rise: float) -> Scene:
    """Levels at 0 and 2 rises on the left, at one rise on the right, two flights between them (x 6 to 8, y 0.4 to 2.8)."""
    scene, top = Scene(), 2 * rise + HEIGHT
    half_house(scene, 0, 2 * rise)
    half_house(scene, 8, rise)
    low = 2 * rise - 0.3
    scene.floor(0, 0, 6, 8).floor(0, 0, 6, 8, low).wall((0, 4), (6, 4), height=low, doors=(1.5, 4.5))
    scene.wall((3, 4), (3, 8), height=low).wall((0, 0), (6, 0), height=low).wall((0, 8), (6, 8), height=low)
    scene.wall((0, 0), (0, 8), height=top).wall((14, 0), (14, 8), rise)
    for x, z, h in ((6, 0.0, top), (8, rise, HEIGHT)):
        scene.wall((x, 2.8), (x, 8), z, h).wall((x, 0), (x, 0.4), z, h)
    scene.wall((6, 0.4), (6, 1.6), 2.1, top - 2.1).wall((6, 1.6), (6, 2.8), 0, 2 * rise)
    scene.wall((6, 1.6), (6, 2.8), 2 * rise + 2.1, HEIGHT - 2.1).wall((8, 0.4), (8, 2.8), rise + 2.1, HEIGHT - 2.1)
    for y in (0.4, 2.8):
        scene.wall((6, y), (8, y), 0, top)
    scene.floor(6, 0.4, 8, 2.8, top)
    tread, step = 2 / 7, rise / 7
    for k in range(7):
        for x, y, z, dx in ((6 + k * tread, 0.4, k * step, tread), (8 - k * tread, 1.6, rise + k * step, -tread)):
            scene.parts.append(rectangle((x, y, z), (0, 1.2, 0), (0, 0, step)))
            scene.parts.append(rectangle((x, y, z + step), (dx, 0, 0), (0, 1.2, 0)))
    return scene


@pytest.mark.longer
@pytest.mark.parametrize("rise", [1.5, *list_longer(1.3, 1.4)])
def test_three_half_levels_have_all_their_rooms(rise: float) -> None:
    map = extract(three_half_levels(rise).points(0.005))
    columns = [(3, 2), (1.5, 6), (4.5, 6)]
    places = [*((*c, z) for z in (0, 2 * rise) for c in columns), (11, 2, rise), (9.5, 6, rise), (12.5, 6, rise)]
    rooms = [room_at(map, *place) for place in places]
    assert len(set(rooms)) == 9
    assert map.rooms["area"][rooms] == pytest.approx([24, 12, 12] * 3, rel=0.12)
    assert np.ptp(map.rooms["storey"][rooms[:6]]) == 1  # one above the other: two storeys
    assert np.isin(map.edges["kind"], ("stairs", "ramp")).any()


def roof(parapet: float) -> Scene:
    """Two rooms, 7 x 6 and 3 x 6 m, and a flight through a hole in their roof, which is a terrace of 10 x 6 m."""
    scene, z = Scene(), 3.0
    hole = (1.0, 4.8, 1.0 + 0.29 * 17, 6.0)
    for a, b in (((0, 0), (10, 0)), ((0, 6), (10, 6)), ((0, 0), (0, 6)), ((10, 0), (10, 6))):
        scene.wall(a, b, 0, z + parapet)
    scene.wall((7, 0), (7, 6), 0, 2.7, doors=(2.0,))
    scene.floor(0, 0, 10, 6).floor(0, 0, 10, 6, z, hole).floor(0, 0, 10, 6, 2.7, hole)
    stair(scene, 1.0, 4.8, 6.0, 0.0, z)
    return scene


def test_a_roof_terrace_with_a_parapet_is_a_storey() -> None:
    map = extract(roof(PARAPET).points(0.005))
    assert map.storeys["floor"] == pytest.approx([0.0, 3.0], abs=0.12) and np.isnan(map.storeys["ceiling"][1])
    terrace = room_at(map, 8, 2, 3.0)
    assert len(map.rooms) == 3 and map.rooms["storey"][terrace] == 1
    assert map.rooms["area"][terrace] == pytest.approx(60, rel=0.1) and map.rooms["height"][terrace] == 0
    assert [str(e["kind"]) for e in map.edges if terrace in e["rooms"]] == ["stairs"]


def test_a_roof_that_nobody_could_be_seen_on_leaves_the_rooms_below_as_they_are() -> None:
    map = extract(roof(0.0).points(0.005))
    assert len(map.storeys) == 1 and sorted(map.rooms["area"]) == pytest.approx([18, 42], rel=0.1)


def walked(points: Array, places: Array) -> PointCloud:
    """Points (n, 3), each seen from the nearest of the places (k, 3)."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    return PointCloud(points, poses=poses, pose_of=cKDTree(places).query(points)[1].astype(np.int32))


def way(z: float) -> Array:
    """(k, 3) places of a sensor carried 1.5 m above a level, around the hole of the stair."""
    x, y = np.meshgrid(np.linspace(1, 9, 9), (1.5, 3.5))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z + 1.5)])


@pytest.mark.longer
def test_a_terrace_without_a_parapet_that_somebody_walked_on_is_a_storey() -> None:
    points = roof(0.0).points(0.005)
    below, all_over = (extract(walked(points, places)) for places in (way(0.0), np.concatenate([way(0.0), way(3.0)])))
    assert len(below.storeys) == 1
    assert all_over.storeys["floor"] == pytest.approx([0.0, 3.0], abs=0.12)
    terrace = room_at(all_over, 8, 2, 3.0)
    assert all_over.rooms["storey"][terrace] == 1 and all_over.rooms["area"][terrace] == pytest.approx(60, rel=0.15)
    assert any(terrace in e["rooms"] and e["kind"] == "stairs" for e in all_over.edges)


HOLE = (2.0, 3.0, 5.0, 5.0)


def seen_through_the_hole(below: Array, floor: float) -> Array:
    """(n,) bool: which points does somebody see who looks through the hole in a floor with its slab of 0.3 m, from its edges?"""
    seen = np.zeros(len(below), bool)
    for eye in np.array([(1.5, 4, 4.6), (5.5, 4, 4.6), (3.5, 2.5, 4.6), (3.5, 5.5, 4.6)]):
        through = below[:, 2] < floor - 0.3
        for level in (floor, floor - 0.3):
            at = eye + (below - eye) * ((level - eye[2]) / np.minimum(below[:, 2] - eye[2], -1e-9))[:, None]
            through &= (at[:, 0] > HOLE[0]) & (at[:, 0] < HOLE[2]) & (at[:, 1] > HOLE[1]) & (at[:, 1] < HOLE[3])
        seen |= through
    return seen


@pytest.mark.longer
def test_what_is_seen_through_a_stairwell_is_one_storey_below_and_changes_nothing_above() -> None:
    upper = Scene().shell(0, 0, 12, 8, 3.0)
    floor = upper.parts[0]
    hole = (floor[:, 0] > HOLE[0]) & (floor[:, 0] < HOLE[2]) & (floor[:, 1] > HOLE[1]) & (floor[:, 1] < HOLE[3])
    upper.parts[0] = floor[~hole]
    upper.wall((7, 0), (7, 8), 3.0, doors=(2.0,))
    below = np.concatenate(Scene().shell(0, 0, 12, 8, ceiling=False).parts)
    upper.parts.append(below[seen_through_the_hole(below, 3.0)])
    map = extract(upper.points(0.005))
    assert map.storeys["floor"] == pytest.approx([0.0, 3.0], abs=0.12)
    own = map.rooms[map.rooms["storey"] == 1]
    assert len(own) == 2 and sorted(own["area"]) == pytest.approx([40, 56], rel=0.05)
    assert (map.rooms["storey"] == 0).sum() == 1 and map.rooms["completeness"][map.rooms["storey"] == 0][0] < 0.5


def seats(scene: Scene, rows) -> Scene:
    """Rows of benches with backs, each from and to where `rows` say, m."""
    for k in range(ROWS):
        for a, b in rows:
            scene.box(a, 1.5 + k, 0, b, 2.0 + k, 0.45).box(a, 1.92 + k, 0.45, b, 2.0 + k, 0.9)
    return scene


WITH_AND_WITHOUT_AISLE = pytest.mark.parametrize("rows", list_longer((((4.0, 16.0),),), (((3.5, 9.4), (10.6, 16.5)),)))


@WITH_AND_WITHOUT_AISLE
def test_a_hall_with_rows_of_seats_and_a_counter_is_one_room(rows) -> None:
    scene = seats(Scene().shell(0, 0, 20, 12, height=4.0).box(18.6, 3, 0, 19.2, 9, 1.1), rows)
    points = scene.points(0.005)[::3]
    map = extract(points)
    assert len(map.rooms) == 1 and map.rooms["area"][0] == pytest.approx(240, rel=0.03)


def cubicles(height: float) -> Scene:
    """An office of 12 x 10 m with two rows of four cubicles of 2.5 x 2.5 m, each open by 1 m to the aisle between them."""
    scene = Scene().shell(0, 0, 12, 10, height=3.0)
    for back, front in ((0.0, 2.5), (10.0, 7.5)):
        for k in range(5):
            scene.wall((1 + 2.5 * k, back), (1 + 2.5 * k, front), height=height, thick=0.05)
        for x in 1 + 2.5 * np.arange(4):
            scene.wall((x, front), (x + 0.75, front), height=height, thick=0.05)
            scene.wall((x + 1.75, front), (x + 2.5, front), height=height, thick=0.05)
    return scene


def test_an_office_with_cubicles_is_one_room() -> None:
    map = extract(cubicles(1.5).points(0.005))
    assert len(map.rooms) == 1 and map.rooms["area"][0] == pytest.approx(120, rel=0.03)


def test_cells_with_light_walls_below_the_ceiling_are_rooms() -> None:
    """Nobody looks over walls of 2.2 m: people call such cells rooms."""
    map = extract(cubicles(2.2).points(0.005))
    cells = [room_at(map, 2.25 + 2.5 * k, y, 0) for k in range(4) for y in (1.2, 8.8)]
    aisle = room_at(map, 6, 5, 0)
    assert len(set(cells)) == 8 and aisle not in cells
    assert map.rooms["area"][cells] == pytest.approx(np.full(8, 2.5 * 2.5), rel=0.15)
    assert {(min(aisle, c), max(aisle, c)) for c in cells} <= pairs(map)
