"""Storeys above each other: registered, refused where they do not fit, joined by stairs that can be walked; twin wings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.buildings.stack import (
    COVER,
    DRAWN_WALLS,
    SURVEYED_WALLS,
    count_matching_rooms,
    iter_stacks,
    make_twin_wing,
    register,
    stack_storeys,
    stretch_building,
    transform_plan,
)
from topomerge.datasets.buildings.stairs import fit_flight
from topomerge.datasets.core.building import Opening, Plan
from topomerge.datasets.pairs.parts import find_twin_rooms, sample_two_parts
from topomerge.datasets.simulation.walk import plan_walk

from tests.datasets.boxes import BARE, room
from topomerge.errors import InputError


def storey(well: bool = True, extra: bool = False, height: float = 3.4) -> Plan:
    """A corridor of 20 by 2 m with three rooms and a stairwell of 3.4 by 6 m on one side, and perhaps a hall on the other."""
    rooms = [room("corridor", 0, 0, 20, 2, "corridor"), room("well", 0, 2.2, 3.4, 8.2, "stairs" if well else "office")]
    rooms += [room("a", 3.6, 2.2, 8, 8.2), room("b", 8.2, 2.2, 13, 8.2), room("c", 13.2, 2.2, 20, 8.2)]
    doors = [Opening("door", (x, 2.1), (x + 0.9, 2.1), 0.2) for x in (0.3, 5, 10, 16)]
    if extra:
        rooms.append(room("hall", 4, -9, 16, -0.2, "hall"))
        doors.append(Opening("door", (9, -0.1), (10.6, -0.1), 0.2))
    return Plan(tuple(rooms), openings=tuple(doors), height=height)


@pytest.mark.parametrize(("scale", "shift"), [(1.0, (0.0, 0.0)), (1.4, (30.0, -12.0)), (0.6, (-7.0, 55.0))])
def test_a_storey_in_a_frame_of_its_own_is_found(scale: float, shift: tuple[float, float]) -> None:
    low, high = storey(extra=True), storey()
    fit = register(low, transform_plan(high, scale, np.array(shift)))
    assert fit.walls > 0.9 and fit.cover > 0.9
    assert fit.scale == pytest.approx(1 / scale, rel=0.01)
    assert np.array(shift) * fit.scale + fit.shift == pytest.approx([0, 0], abs=0.2)


def test_storeys_that_do_not_fit_are_refused() -> None:
    turned = np.array([[0.8, 0.6], [-0.6, 0.8]])
    other = Plan(tuple(replace(r, polygon=r.polygon @ turned) for r in storey(extra=True).rooms))
    with pytest.raises(InputError, match="storeys do not fit: .* of the walls of storey 1"):
        stack_storeys([storey(), other])
    with pytest.raises(InputError, match="over floor"):
        stack_storeys([storey(), transform_plan(storey(), 1.0, np.array([15.0, 6.0]))], common=True)
    with pytest.raises(InputError, match="two storeys or more"):
        stack_storeys([storey()])


def test_two_storeys_become_a_building_with_stairs_that_are_walked() -> None:
    low, high = storey(extra=True), storey()
    result = stack_storeys([low, transform_plan(high, 1.25, np.array([3.0, 4.0]))])
    assert result.stairs == (1,) and result.plans[0].flights[0].kind == "dogleg"
    building = build_building(result.plans, BARE)
    (stair,) = building.stairs
    assert [building.rooms[r].name for r in stair["rooms"]] == ["well", "well"] and stair["storeys"].tolist() == [0, 1]
    assert len(set(building.find_components())) == 1
    names = {(r.name, r.storey): i for i, r in enumerate(building.rooms)}
    walk = plan_walk(building, [names["a", 0], names["c", 1]], np.random.default_rng(0))
    assert walk.points[:, 2].min() < 0.01 and walk.points[:, 2].max() > 3.39
    well = shapely.Polygon(stair["footprint"])
    faces = building.vertices[building.triangles].mean(axis=1)
    floor = faces[(np.abs(faces[:, 2] - 3.4) < 0.02) & (building.labels == 1)]
    assert not shapely.contains_xy(well.buffer(-0.2), floor[:, :2]).any(), "the slab is open over the flight"


def test_no_stairs_where_only_one_storey_has_a_stairwell() -> None:
    result = stack_storeys([storey(), storey(well=False)])
    assert result.stairs == (0,) and not result.plans[0].flights
    assert len(set(build_building(result.plans, BARE).find_components())) == 2


def test_a_flight_goes_on_over_the_one_from_below() -> None:
    result = stack_storeys([storey(), storey(), storey()])
    assert result.stairs == (1, 1) and result.plans[0].flights == result.plans[1].flights
    assert len(set(build_building(result.plans, BARE).find_components())) == 1
    assert stack_storeys([storey(), storey(height=4.6), storey()]).stairs == (1, 0), (
        "a storey that is too high for the same flight"
    )


def test_a_flight_leaves_the_doors_free() -> None:
    well = shapely.box(0, 0, 2.5, 5.6)
    assert fit_flight((well, well), (np.array([[1.2, -0.1]]),) * 2, 3.4) is not None
    assert fit_flight((well, well), (np.array([[1.2, -0.1], [1.2, 5.7]]),) * 2, 3.4) is None
    assert fit_flight((shapely.box(0, 0, 2, 2),) * 2, (np.array([[1.0, -0.1]]),) * 2, 3.4) is None


def test_parts_over_stairs() -> None:
    building = build_building(stack_storeys([storey(extra=True), storey()]).plans, BARE)
    a, b = sample_two_parts(building, 5, 0.6, np.random.default_rng(1), over_stairs=True)
    for part in (a, b):
        assert {building.rooms[i].storey for i in part} == {0, 1}
    a, b = sample_two_parts(building, 4, 0.0, np.random.default_rng(1), over_stairs=True)
    assert not set(a) & set(b)


def test_storeys_that_are_nearly_alike() -> None:
    low, high = storey(), storey()
    grown = replace(high.rooms[2], polygon=high.rooms[2].polygon * (1.0, 0.96) + (0.0, 0.1))
    high = replace(high, rooms=(*high.rooms[:2], grown, *high.rooms[3:]))
    assert count_matching_rooms(low, high) == 5
    twins = find_twin_rooms(build_building([low, high], BARE))
    assert twins == {i: i + 5 for i in range(5)}


@pytest.mark.longer
def test_a_twin_wing_is_nearly_the_same() -> None:
    building = make_building("hotel", 5)
    for seed in range(3):
        twin = make_twin_wing(building, seed)
        assert [r.kind for r in twin.rooms] == [r.kind for r in building.rooms]
        areas = [np.array([shapely.Polygon(r.polygon).area for r in b.rooms]) for b in (building, twin)]
        ratio = areas[1] / areas[0]
        assert ratio.min() > 0.6 and ratio.max() < 1.4 and (np.abs(ratio - 1) > 0.02).any() and (np.abs(ratio - 1) < 1e-3).any()
        assert all(shapely.Polygon(r.polygon).exterior.is_ccw for r in twin.rooms)
        plan_walk(twin, [0, len(twin.rooms) - 1], np.random.default_rng(0))
    same, other = make_twin_wing(building, 1), make_twin_wing(building, 2)
    assert same.vertices.tobytes() == make_twin_wing(building, 1).vertices.tobytes() != other.vertices.tobytes()


def test_bent_by_hand() -> None:
    building = make_building("house", 3)
    mirrored = stretch_building(building, 0, lambda x: x, mirrored=True)
    assert np.allclose(mirrored.vertices * (-1, 1, 1), building.vertices)
    corners = mirrored.vertices[mirrored.triangles].astype(float)
    before = building.vertices[building.triangles].astype(float)
    normal, old = (np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) for c in (corners, before))
    assert np.allclose(normal * (-1, 1, 1), old, atol=1e-4), "faces still look at the free space"
    wider = stretch_building(building, 0, lambda x: 2 * x)
    across = np.abs(np.sin(building.doors["direction"])) > 0.99
    assert np.allclose(wider.doors["width"][across], 2 * building.doors["width"][across], rtol=1e-6)
    assert np.allclose(wider.doors["width"][~across], building.doors["width"][~across], rtol=1e-6)


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(("folder", "stacks", "joined"), [("plans_schools_offices", 12, 8), ("sim_rmf_buildings", 3, 0)])
def test_real_storeys(data_dir: Path, folder: str, stacks: int, joined: int) -> None:
    stacks = dict(iter_stacks(data_dir / folder))
    fitting = [s for s in stacks.values() if not hasattr(s, "reason")]
    assert len(fitting) == stacks and sum(s.stairs[0] > 0 for s in fitting) == joined
    for result in fitting:
        assert (
            result.fits[0].walls >= (SURVEYED_WALLS if result.fits[0].common else DRAWN_WALLS) and result.fits[0].cover >= COVER
        )
        building = build_building(result.plans, BARE)
        walked = [p for p, r in zip(building.find_components(), building.rooms, strict=True) if r.kind != "lift"]
        assert len(set(walked)) == (1 if result.stairs[0] else 2), result.names
        for stair in building.stairs[building.stairs["kind"] != "lift"]:
            walk = plan_walk(building, stair["rooms"].tolist(), np.random.default_rng(0))
            assert walk.points[:, 2].max() > result.plans[0].height - 0.01
