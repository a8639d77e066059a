from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest
import shapely
from topomerge.datasets.buildings.layouts import SHAPES
from topomerge.datasets.buildings.procedural import BUILDING_KINDS, is_connected, make_building
from topomerge.datasets.core.building import SURFACES, Building, Difficulty

from topomerge.errors import InputError

EMPTY = Difficulty(furniture=0, clutter=0)
REALISTIC = {"room": (2.0, 320.0), "door": (0.7, 2.5)}


def digest(building: Building) -> str:
    arrays = (building.vertices, building.triangles, building.labels, building.doors, building.stairs, building.things)
    return hashlib.sha256(b"".join(a.tobytes() for a in arrays)).hexdigest()


@pytest.mark.longer
@pytest.mark.parametrize("kind", BUILDING_KINDS)
@pytest.mark.parametrize("storeys", [1, 3])
def test_buildings_of_every_kind_are_sound(kind: str, storeys: int) -> None:
    building = make_building(kind, 3, storeys, EMPTY)
    assert len(building.storeys) == storeys and is_connected(building)
    shapes = [shapely.Polygon(r.polygon) for r in building.rooms]
    assert all(s.is_valid and s.exterior.is_ccw for s in shapes)
    areas = np.array([s.area for s in shapes])
    assert areas.min() > REALISTIC["room"][0] and areas.max() < REALISTIC["room"][1]
    for a, b in shapely.STRtree(shapes).query(shapes, "intersects").T.tolist():
        if a < b and building.rooms[a].storey == building.rooms[b].storey:
            assert shapes[a].intersection(shapes[b]).area < 1e-6
    widths = building.doors["width"]
    assert widths.min() >= REALISTIC["door"][0] and widths.max() <= REALISTIC["door"][1]
    assert all(r.ceiling - r.floor >= 1.9 for r in building.rooms)
    assert (building.stairs["riser"] <= 0.19).all()
    climbed = building.stairs[building.stairs["riser"] > 0]
    assert (climbed["tread"] >= 0.25).all()


@pytest.mark.longer
@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_of_corridor_can_be_asked_for(shape: str) -> None:
    building = make_building("office", 5, 1, EMPTY, shape=shape)
    assert is_connected(building) and len(building.rooms) >= 5


@pytest.mark.longer
@pytest.mark.parametrize("stairs", ["straight", "dogleg", "spiral", "ramp"])
def test_every_kind_of_stairs_can_be_asked_for(stairs: str) -> None:
    building = make_building("office", 5, 2, EMPTY, stairs=stairs)
    assert stairs in building.stairs["kind"].tolist()


def test_the_same_seed_gives_the_same_bytes() -> None:
    assert digest(make_building("house", 4)) == digest(make_building("house", 4)) != digest(make_building("house", 5))


@pytest.mark.longer
def test_storeys_repeat_or_differ_as_the_difficulty_says() -> None:
    same = make_building("office", 6, 3, replace(EMPTY, differ=0, atria=0))
    other = make_building("office", 6, 3, replace(EMPTY, differ=1, atria=0))

    def outlines(building: Building, storey: int) -> list[bytes]:
        return [r.polygon.tobytes() for r in building.rooms if r.storey == storey]

    assert outlines(same, 0) == outlines(same, 1) == outlines(same, 2)
    assert outlines(other, 0) != outlines(other, 1)


def test_hotels_have_near_identical_rooms_with_a_bath() -> None:
    building = make_building("hotel", 2, 1, EMPTY)
    areas = [shapely.Polygon(r.polygon).area for r in building.rooms if r.kind == "hotel"]
    assert len(areas) >= 8 and np.std(areas) < 0.1 * np.mean(areas)
    assert sum(r.kind == "bath" for r in building.rooms) >= 8


@pytest.mark.longer
def test_each_difficulty_does_what_it_says() -> None:
    def share(difficulty: Difficulty, label: str) -> float:
        building = make_building("office", 8, 1, difficulty, shape="double")
        return float((building.labels == SURFACES.index(label)).sum())

    assert share(EMPTY, "furniture") == 0 < share(Difficulty(), "furniture") < share(Difficulty(furniture=2), "furniture")
    assert share(replace(EMPTY, glass=0, windows=0), "glass") == 0 < share(replace(EMPTY, glass=1, windows=0), "glass")
    assert share(replace(EMPTY, lamps=0, beams=0, ducts=0), "beam") == 0 < share(replace(EMPTY, lamps=1), "beam")
    doors = {n: make_building("office", 8, 1, replace(EMPTY, lintels=n), shape="double").doors["lintel"] for n in (0, 1)}
    assert doors[0].mean() < 0.2 and doors[1].all()
    shut = make_building("office", 8, 1, replace(EMPTY, open=0, half=0), shape="double").doors
    assert set(shut["state"].tolist()) <= {"shut", "none"}


def test_furniture_stands_in_its_room_and_clear_of_the_doors() -> None:
    building = make_building("office", 9, 1, Difficulty(furniture=2))
    stands = building.things[building.things["kind"] != "leaf"]
    assert len(stands) > 30
    for thing in stands:
        shape = shapely.Polygon(building.rooms[thing["room"]].polygon)
        assert shape.covers(shapely.Point(thing["centre"][:2]))
    for door in building.doors:
        assert np.hypot(*(stands["centre"][:, :2] - door["centre"][:2]).T).min() > 0.5


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (("castle", 1, 1), "building kind 'castle'"),
        (("office", 1, 9), "storeys must be 1 to 8, not 9"),
        (("office", 1, 0), "not 0"),
    ],
)
def test_wrong_arguments_are_refused(wrong: tuple[str, int, int], reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        make_building(*wrong)
    with pytest.raises(InputError, match="shape 'star'"):
        make_building("office", 1, shape="star")


@pytest.mark.longer
def test_rooms_of_a_kind_differ_and_closets_are_cut_out() -> None:
    def areas(difficulty: Difficulty) -> np.ndarray:
        rooms = [r for seed in range(4) for r in make_building("office", seed, 1, difficulty, shape="double").rooms]
        return np.array([shapely.Polygon(r.polygon).area for r in rooms if r.kind != "corridor"])

    plain, mixed = areas(replace(EMPTY, closets=0, spread=0)), areas(replace(EMPTY, closets=0.5, spread=0.5))
    assert (plain < 5).mean() < 0.02 < 0.08 < (mixed < 5).mean()
    assert np.quantile(mixed, 0.9) > 1.2 * np.quantile(plain, 0.9)


def test_furniture_in_rows_is_not_aligned_to_the_millimetre() -> None:
    building = make_building("school", 3, 1, Difficulty(closets=0))
    seats = building.things[building.things["kind"] == "seat"]
    turn = (seats["yaw"] + np.pi / 4) % (np.pi / 2) - np.pi / 4
    assert len(seats) > 10 and 0.01 < turn.std() < 0.06


def test_ducts_hang_below_the_ceiling_and_above_the_heads() -> None:
    building = make_building("lab", 5, 1, replace(EMPTY, lamps=0, beams=0, ducts=1.0, slopes=0))
    low = building.vertices[building.triangles[building.labels == SURFACES.index("beam")], 2].min(axis=1)
    assert len(low) > 12 and low.min() > 2.1 and low.max() < max(r.ceiling for r in building.rooms)


@pytest.mark.longer
def test_each_building_has_its_own_make_of_doors() -> None:
    widths = [make_building("school", seed, 1, EMPTY).doors["width"] for seed in range(3)]
    assert len({round(float(np.median(w)), 2) for w in widths}) > 1
    assert all(len(np.unique(np.round(w, 2))) > 3 for w in widths)
