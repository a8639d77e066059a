"""Plans from files: exact places and sizes in every format, and the real data's counts."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import shapely
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.core.building import Plan
from topomerge.datasets.plans.floorplans import Refusal, group_siblings, iter_plans, read_plans, summarise

from tests.datasets.plans import plan_files as write
from tests.datasets.plans.plan_checks import MAKERS, areas, door

# One plan of each format


def test_r2v(tmp_path: Path) -> None:
    (plan,) = read_plans(write.r2v(tmp_path / "a.txt"))
    scale = 0.75 / 40
    assert areas(plan) == pytest.approx([(150 * scale - 0.12) ** 2] * 2)
    assert [room.kind for room in plan.rooms] == ["bedroom", "kitchen"]
    assert plan.rooms[0].polygon[:, 0].max() == pytest.approx(150 * scale - 0.06)
    middle, width = door(plan)
    assert middle == pytest.approx([150 * scale, -40 * scale])  # y up: the upper half of the drawing is the higher y
    assert width == pytest.approx(0.75)


def test_r2v_opening_to_the_balcony_is_a_window(tmp_path: Path) -> None:
    seeds = "300 20 400 20 wall 1 1\n300 120 400 120 wall 1 1\n400 20 400 120 wall 1 1\n"
    seeds += "340 60 350 70 balcony 1 1\n300 40 300 100 door 3 1"
    (plan,) = read_plans(write.r2v(tmp_path / "a.txt", seeds=seeds))
    assert len(plan.rooms) == 2
    (glass,) = (o for o in plan.openings if o.kind == "window")
    assert glass.start[0] == pytest.approx(300 * 0.75 / 40)


def test_a_home_that_a_robot_mapped(tmp_path: Path) -> None:
    (plan,) = read_plans(write.valetudo(tmp_path))
    assert areas(plan) == pytest.approx([12, 12], rel=0.05)
    middle, width = door(plan)
    assert middle == pytest.approx([14.1, -6.45], abs=0.06) and width == pytest.approx(0.9, abs=0.06)  # x right, y up
    assert [o.kind for o in plan.openings] == ["door"]


def test_what_a_robot_drove_around_is_no_hole_in_a_room(tmp_path: Path) -> None:
    path = write.valetudo(tmp_path)
    about = json.loads(path.read_text())
    runs = np.array(about["layers"][0]["compressedPixels"]).reshape(-1, 3).tolist()
    table = [[x, y, n] for x, y, n in runs if n < 80 or not 125 <= y < 135]  # 0.5 m of the floor under a table of 1 m
    table += [part for x, y, n in runs if n == 80 and 125 <= y < 135 for part in ([x, y, 30], [x + 50, y, 30])]
    about["layers"][0]["compressedPixels"] = [n for run in table for n in run]
    path.write_text(json.dumps(about))
    (plan,) = read_plans(path)
    assert areas(plan) == pytest.approx([12, 12], rel=0.05)


def test_campus(tmp_path: Path) -> None:
    (plan,) = read_plans(write.campus(tmp_path / "a.xml"))
    assert areas(plan) == pytest.approx([(7.5 - 0.15) * (8 - 0.15)] * 2)
    assert [room.kind for room in plan.rooms] == ["classroom", "corridor"]
    middle, width = door(plan)
    assert middle == pytest.approx([7.5, -2.0], abs=0.03)
    assert width == pytest.approx(0.9)


def test_campus_draws_small_overlaps_apart_and_islands_out(tmp_path: Path) -> None:
    (plan,) = read_plans(write.campus(tmp_path / "a.xml", rooms=((0, 0, 152, 160), (148, 0, 300, 160))))
    assert shapely.Polygon(plan.rooms[0].polygon).distance(shapely.Polygon(plan.rooms[1].polygon)) > 0.1
    (plan,) = read_plans(write.campus(tmp_path / "b.xml", rooms=((0, 0, 300, 300), (100, 40, 250, 250)), portal=(100, 150)))
    ring, island = sorted(areas(plan), reverse=True)
    assert ring == pytest.approx(15**2 - 7.5 * 10.5 - 0.075 * (4 * 15 + 2 * 18), rel=1e-2)
    assert island == pytest.approx(7.35 * 10.35)


def test_campus_scale_follows_usual_rooms_where_the_file_is_wrong(tmp_path: Path) -> None:
    rooms = ((0, 0, 150, 160), (150, 0, 300, 160), (0, 160, 150, 320))
    path = write.campus(tmp_path / "a.xml", rooms=rooms, labels=("CLASSROOM",) * 3, centimetres=100)
    (plan,) = read_plans(path)
    assert areas(plan)[0] == pytest.approx((7.5 - 0.15) * (8 - 0.15))


def test_rmf(tmp_path: Path) -> None:
    (plan,) = read_plans(write.rmf(tmp_path / "a.building.yaml"))
    assert areas(plan) == pytest.approx([(5 - 0.12) * (5 - 0.12)] * 2)
    assert door(plan) == (pytest.approx([5.0, -1.5]), pytest.approx(1.0))
    assert [room.kind for room in sorted(plan.rooms, key=lambda r: r.polygon[:, 0].min())] == ["", "kitchen"]


def test_rmf_levels_share_their_lift(tmp_path: Path) -> None:
    plans = read_plans(write.rmf(tmp_path / "a.building.yaml", levels=2))
    assert [len(p.rooms) for p in plans] == [3, 3] and [len(p.flights) for p in plans] == [1, 0]
    assert plans[0].height == pytest.approx(3.5)
    building = build_building(plans)
    assert len(building.stairs) == 1 and building.stairs["kind"][0] == "lift"
    assert np.allclose(building.stairs["lower"][0, :2], [9, -4])


def test_mall(tmp_path: Path) -> None:
    (plan,) = read_plans(write.mall(tmp_path / "F1"))
    assert areas(plan) == pytest.approx([9.8 * 19.8, 19.8 * 19.8 - 2.2 * 2.2], rel=2e-3)
    middle, width = door(plan)
    shop = plan.rooms[0].polygon
    assert middle == pytest.approx([shop[:, 0].max() + 0.1, (shop[:, 1].min() + shop[:, 1].max()) / 2], abs=0.1)
    assert width == pytest.approx(2.4)


def test_amrl(tmp_path: Path) -> None:
    (plan,) = read_plans(write.amrl(tmp_path / "a.vectormap.json"))
    assert areas(plan) == pytest.approx([25, 25], rel=0.1)
    middle, width = door(plan)
    assert middle == pytest.approx([5.0, 3.5], abs=0.1)
    assert width == pytest.approx(0.9, abs=0.15)


def test_bwi(tmp_path: Path) -> None:
    (plan,) = read_plans(write.bwi(tmp_path / "1"))
    assert areas(plan) == pytest.approx([4.9 * 4.9] * 2, rel=0.03)
    assert [room.name for room in plan.rooms] == ["lab", "hall"]
    middle, width = door(plan)
    assert middle == pytest.approx([5.0, 2.5], abs=0.1)
    assert width == pytest.approx(1.0)


def test_ipa(tmp_path: Path) -> None:
    (plan,) = read_plans(write.ipa(tmp_path))
    assert areas(plan) == pytest.approx([25, 25], rel=0.05)
    middle, width = door(plan)
    assert middle == pytest.approx([6.0, 4.5], abs=0.1)  # of 7 m, the doorway is 2 to 3 m below the upper rim
    assert width == pytest.approx(1.0, abs=0.1)


def test_ifc(tmp_path: Path) -> None:
    pytest.importorskip("ifcopenshell")
    (plan,) = read_plans(write.ifc(tmp_path / "a.ifc"))
    assert areas(plan) == pytest.approx([20, 20])
    assert [room.kind for room in plan.rooms] == ["office", "office"]
    assert door(plan) == (pytest.approx([5.1, 3.0]), pytest.approx(1.0))
    assert plan.ceiling == pytest.approx(2.6)


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_erects_to_the_same_rooms_and_door(make: Callable[[Path], Path], tmp_path: Path) -> None:
    (plan,) = read_plans(make(tmp_path))
    building = build_building([plan])
    assert len(building.rooms) == 2 and len(building.doors) == 1
    assert sorted(building.doors["rooms"][0].tolist()) == [0, 1]
    middle, width = door(plan)
    assert np.allclose(building.doors["centre"][0, :2], middle) and building.doors["width"][0] == pytest.approx(width)


# Real data


@pytest.mark.longer
@pytest.mark.data
def test_first_apartments(data_dir: Path) -> None:
    results = [r for _, (_, r) in zip(range(150), iter_plans(data_dir / "plans_r2v_apartments"), strict=False)]
    plans = [p for p in results if isinstance(p, Plan)]
    assert len(plans) >= 125
    for plan in plans:
        shapes = [shapely.Polygon(room.polygon) for room in plan.rooms]
        assert all(shape.is_valid for shape in shapes) and 8 < sum(shape.area for shape in shapes) < 250
        width = [np.hypot(*np.subtract(o.start, o.end)) for o in plan.openings if o.kind == "door"]
        assert not width or 0.5 <= np.median(width) <= 1.3


@pytest.mark.data
@pytest.mark.slow
def test_apartments_come_through(data_dir: Path) -> None:
    counts = summarise(iter_plans(data_dir / "plans_r2v_apartments"))
    assert sum(counts.values()) == 1279 and counts["taken"] >= 1000, counts


@pytest.mark.data
@pytest.mark.slow
def test_schools_and_offices_come_through(data_dir: Path) -> None:
    results = list(iter_plans(data_dir / "plans_schools_offices"))
    counts = summarise(results)
    assert sum(counts.values()) == 70 and counts["taken"] >= 60, counts
    assert any(isinstance(r, Refusal) and "absurd scale" in r.reason and "dentist" in n for n, r in results)


@pytest.mark.data
def test_school_storeys(data_dir: Path) -> None:
    groups = group_siblings(data_dir / "plans_schools_offices")
    assert ["school/Sabadell1", "school/Sabadell2", "school/Sabadell3"] in groups
    (plan,) = read_plans(data_dir / "plans_schools_offices/school/Sabadell1_updated.xml")
    building = build_building([plan])
    assert len(building.rooms) == 18 and len(set(building.find_components().tolist())) == 1


@pytest.mark.longer
@pytest.mark.data
@pytest.mark.parametrize(
    ("folder", "least"),
    [("sim_rmf_buildings", 7), ("ifc_buildings", 8), ("grids_ipa_room_segmentation", 8), ("utexas_gdc_floors", 5)],
)
def test_other_formats_come_through(folder: str, least: int, data_dir: Path) -> None:
    if folder == "ifc_buildings":
        pytest.importorskip("ifcopenshell")
    assert summarise(iter_plans(data_dir / folder))["taken"] >= least


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(("folder", "least"), [("plans_malls", 9), ("utexas_amrl_vectormaps", 8)])
def test_large_formats_come_through(folder: str, least: int, data_dir: Path) -> None:
    assert summarise(iter_plans(data_dir / folder))["taken"] >= least
