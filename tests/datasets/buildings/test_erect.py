from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.core.building import SURFACES, Building, Difficulty, Opening, Plan, Wall

from tests.datasets.boxes import BARE, one_room, room, tower, two_rooms
from topomerge.errors import InputError


def area(building: Building, label: str, keep: object = None) -> float:
    corners = building.vertices[building.triangles[building.labels == SURFACES.index(label)]].astype(float)
    if callable(keep):
        corners = corners[keep(corners.mean(axis=1))]
    a, b, c = np.moveaxis(corners, 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def inside(points: np.ndarray) -> np.ndarray:
    """On the faces of the room of 4 by 5 m."""
    return (points[:, :2] > -1e-3).all(axis=1) & (points[:, :2] < np.array([4, 5]) + 1e-3).all(axis=1)


def test_the_surfaces_of_one_room_have_the_areas_that_geometry_says() -> None:
    building = build_building([one_room()], BARE)
    assert area(building, "floor", inside) == pytest.approx(20.0, abs=1e-3)
    assert area(building, "ceiling", inside) == pytest.approx(20.0, abs=1e-3)
    assert area(building, "wall", inside) == pytest.approx(18 * 2.7 - 2.0 - 0.9 * 2.1, abs=0.01)
    assert area(building, "glass") == pytest.approx(2.0, abs=1e-3)
    (true,) = building.rooms
    assert shapely.Polygon(true.polygon).area == pytest.approx(20.0)
    assert (true.floor, true.ceiling, true.storey, true.kind) == (0.0, 2.7, 0, "office")


def test_walls_face_the_free_space() -> None:
    building = build_building([replace(one_room(), openings=())], BARE)
    corners = building.vertices[building.triangles[building.labels == 0]].astype(float)
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    towards = np.array([2, 2.5, 1.35]) - a
    assert (np.einsum("ni,ni->n", normal, towards) > 0).all()


def test_a_door_is_where_it_was_drawn_and_its_reveals_are_walls() -> None:
    building = build_building([two_rooms()], BARE)
    (door,) = building.doors
    assert door["rooms"].tolist() == [0, 1]
    assert door["centre"] == pytest.approx([4.1, 2.45, 0.0])
    assert (door["width"], door["height"], door["direction"]) == pytest.approx((0.9, 2.1, 0.0))
    assert door["thickness"] == pytest.approx(0.2, abs=0.05) and door["lintel"] and door["state"] == "open"
    reveals = area(building, "wall", lambda p: (p[:, 0] > 4.001) & (p[:, 0] < 4.199))
    assert reveals == pytest.approx(0.2 * (2 * 2.1 + 0.9), abs=0.01)


def test_a_door_without_lintel_reaches_the_lower_ceiling() -> None:
    plan = two_rooms(top=0.0)
    plan = replace(plan, rooms=(replace(plan.rooms[0], ceiling=2.6), replace(plan.rooms[1], ceiling=2.4)))
    (door,) = build_building([plan], replace(BARE, lintels=0)).doors
    assert door["height"] == pytest.approx(2.4) and not door["lintel"]


def test_polygons_along_centre_lines_lose_their_walls() -> None:
    rooms = (room("a", 0, 0, 4, 5), room("b", 4, 0, 8, 5))
    holes = (Opening("door", (4, 2), (4, 2.9)), Opening("door", (20, 2), (20, 2.9)))
    building = build_building([Plan(rooms, (Wall((4, 0), (4, 5), 0.2),), holes)], BARE)
    assert [shapely.Polygon(r.polygon).area for r in building.rooms] == pytest.approx([19.5, 19.5])
    assert building.doors["rooms"].tolist() == [[0, 1]], "the opening that leads nowhere is left out"


@pytest.mark.parametrize(("state", "low", "high"), [("shut", 0, 1), ("half", 25, 65), ("open", 75, 110)])
def test_leaves_hang_in_their_frame_and_stand_as_the_door_says(state: str, low: float, high: float) -> None:
    building = build_building([two_rooms(state=state)], BARE, 3)
    (leaf,) = building.things
    assert leaf["kind"] == "leaf" and leaf["door"] == 0
    assert leaf["pivot"][0] == pytest.approx(4.1, abs=0.13) and min(abs(leaf["pivot"][1] - [2.0, 2.9])) < 0.02
    points_to = leaf["centre"][:2] - leaf["pivot"]
    other_jamb = 2.45 - leaf["pivot"][1]
    angle = np.degrees(np.arccos(points_to[1] * np.sign(other_jamb) / np.hypot(*points_to)))
    assert low <= angle <= high
    assert np.hypot(*points_to) == pytest.approx(leaf["size"][0] / 2)


def test_glass_walls_are_panes_with_the_door_left_out() -> None:
    plan = two_rooms()
    plan = replace(plan, walls=(Wall((4.1, 0.2), (4.1, 4.8), 0.2, glass=True),))
    building = build_building([plan], BARE)
    panes = 4.6 - 0.9 - 2 * (0.08 + 0.0)
    assert area(building, "glass") == pytest.approx(panes * 2.6, rel=0.1)


def test_triangles_are_finite_and_have_an_area() -> None:
    building = build_building([two_rooms()], Difficulty(beams=1, lamps=1, slopes=1), 5)
    a, b, c = np.moveaxis(building.vertices[building.triangles].astype(float), 1, 0)
    assert np.isfinite(building.vertices).all()
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 1e-7


@pytest.mark.parametrize(
    ("kind", "width", "length"), [("straight", 1.3, 5.04), ("dogleg", 2.5, 3.8), ("spiral", 2.8, 2.8), ("ramp", 2.5, 17.5)]
)
def test_stairs_can_be_climbed(kind: str, width: float, length: float) -> None:
    building = build_building(tower(kind, 3, width, length), BARE)
    assert building.stairs["storeys"].tolist() == [[0, 1], [1, 2]]
    assert building.find_components().tolist() == [0, 0, 0]
    stair = building.stairs[0]
    assert stair["upper"][2] - stair["lower"][2] == pytest.approx(3.2)
    if kind != "ramp":
        assert stair["riser"] <= 0.19 and stair["tread"] >= 0.25
    assert (np.diff(stair["path"][:, 2]) > -1e-6).all()
    assert head_room(building, stair["path"]) >= 2.0


def head_room(building: Building, path: np.ndarray) -> float:
    """Least height above the feet along a path, m."""
    o3d = pytest.importorskip("open3d", exc_type=ImportError)

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(building.vertices), o3d.core.Tensor(building.triangles.astype(np.uint32)))
    at = np.linspace(0, len(path) - 1, 100)
    feet = np.stack([np.interp(at, np.arange(len(path)), path[:, k]) for k in range(3)], axis=1) + [0, 0, 0.25]
    rays = np.concatenate([feet, np.broadcast_to([0, 0, 1.0], feet.shape)], axis=1).astype(np.float32)
    return float(scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy().min()) + 0.25


def test_a_stair_that_is_too_steep_is_refused() -> None:
    with pytest.raises(InputError, match=r"tread 0\.\d+ m: too steep"):
        build_building(tower("straight", length=3.0), BARE)
    with pytest.raises(InputError, match="ends in no room"):
        build_building([tower("straight")[0], replace(tower("straight")[1], rooms=(room("a", 20, 0, 24, 9),))], BARE)


def test_an_atrium_goes_through_two_storeys() -> None:
    lower = Plan((room("hall", 0, 0, 8, 8, "atrium", ceiling=5.8), room("side", 8.2, 0, 12, 8)))
    upper = Plan((room("hall above", 0, 0, 8, 8, "void", ceiling=2.6), room("side above", 8.2, 0, 12, 8)))
    building = build_building([lower, upper], BARE)
    assert [r.name for r in building.rooms] == ["hall", "side", "side above"]
    assert building.rooms[0].ceiling == pytest.approx(5.8)
    over = area(building, "ceiling", lambda p: (p[:, 0] < 8) & (p[:, 2] < 3.3))
    assert over == pytest.approx(0.0)


def test_the_same_seed_gives_the_same_bytes_and_another_one_does_not() -> None:
    one, same, other = (build_building([two_rooms(top=0.0)], Difficulty(), seed) for seed in (1, 1, 2))
    assert one.vertices.tobytes() == same.vertices.tobytes() and one.things.tobytes() == same.things.tobytes()
    assert one.vertices.tobytes() != other.vertices.tobytes()


def test_difficulty_refuses_shares_beyond_one() -> None:
    with pytest.raises(InputError, match="lintels must be 0 to 1, not 1.5"):
        Difficulty(lintels=1.5)
    with pytest.raises(InputError, match="must not exceed 1"):
        Difficulty(open=0.8, half=0.4)
