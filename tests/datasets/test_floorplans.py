"""Plans from files: exact places and sizes in every format, reasoned refusals of all else, and the real data's counts."""

from __future__ import annotations

import io
import logging
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import plan_files as write
import pytest
import shapely
from topomerge.datasets.building import SURFACES
from topomerge.datasets.difficulty import Difficulty
from topomerge.datasets.erect import erect
from topomerge.datasets.floorplans import Refusal, iter_plans, read_plans, siblings, summarise
from topomerge.datasets.plan import Plan
from topomerge.datasets.plan_doors import place_door, sides
from topomerge.datasets.plan_raster import contacts, flood, outline
from topomerge.datasets.plan_sketch import outline as cut_open

from topomerge.errors import InputError


def areas(plan: Plan) -> list[float]:
    return [shapely.Polygon(room.polygon).area for room in plan.rooms]


def door(plan: Plan) -> tuple[list[float], float]:
    """Middle and width of the only door."""
    (opening,) = (o for o in plan.openings if o.kind in ("door", "opening"))
    start, end = np.array(opening.start), np.array(opening.end)
    return ((start + end) / 2).tolist(), float(np.hypot(*(end - start)))


def reason(path: Path) -> str:
    """Why the only plan of a file is refused, told the same way by both verbs."""
    ((_, result),) = iter_plans(path)
    assert isinstance(result, Refusal), result
    with pytest.raises(InputError) as caught:
        read_plans(path)
    assert "\n" not in str(caught.value) and str(caught.value).endswith(result.reason)
    return result.reason


def pack(path: Path, members: dict[str, bytes]) -> Path:
    with tarfile.open(path, "w:xz") as archive:
        for name, data in members.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
    return path


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
    building = erect(plans)
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


MAKERS: dict[str, Callable[[Path], Path]] = {
    "r2v": lambda folder: write.r2v(folder / "a.txt"),
    "campus": lambda folder: write.campus(folder / "a.xml"),
    "rmf": lambda folder: write.rmf(folder / "a.building.yaml"),
    "mall": lambda folder: write.mall(folder / "F1"),
    "amrl": lambda folder: write.amrl(folder / "a.vectormap.json"),
    "bwi": lambda folder: write.bwi(folder / "1"),
    "ipa": write.ipa,
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_erects_to_the_same_rooms_and_door(make: Callable[[Path], Path], tmp_path: Path) -> None:
    (plan,) = read_plans(make(tmp_path))
    building = erect([plan])
    assert len(building.rooms) == 2 and len(building.doors) == 1
    assert sorted(building.doors["rooms"][0].tolist()) == [0, 1]
    middle, width = door(plan)
    assert np.allclose(building.doors["centre"][0, :2], middle) and building.doors["width"][0] == pytest.approx(width)


# Refusals


def test_r2v_refusals(tmp_path: Path) -> None:
    assert reason(write.r2v(tmp_path / "a.txt", close=False)).startswith("not closed")
    assert reason(write.r2v(tmp_path / "b.txt", door=0)).startswith("zero-width doors")
    (tmp_path / "c.txt").write_text("1 2 3 x wall 1 1\n")
    assert reason(tmp_path / "c.txt").startswith("bad line: 1")
    (tmp_path / "d.txt").write_bytes(b"\x00\xff\xfe")
    assert reason(tmp_path / "d.txt").startswith("bad line")
    (tmp_path / "e.txt").write_text("")
    assert reason(tmp_path / "e.txt").startswith("no walls")
    # doors of 75 px are taken as narrow ones: the rooms come out tiny
    assert reason(write.r2v(tmp_path / "f.txt", door=75)).startswith("absurd scale")


@pytest.mark.parametrize(
    ("change", "start"),
    [
        ({"outline": [(0, 0), (150, 0)]}, "not closed"),
        ({"outline": [(0, 0), (150, 160), (150, 0), (0, 160)]}, "crosses itself"),
        ({"rooms": ((0, 0, 200, 160), (120, 0, 300, 160))}, "overlapping rooms"),
        ({"centimetres": 0}, "no scale"),
        ({"centimetres": 3}, "absurd scale"),
        ({"centimetres": 20_000}, "absurd scale"),
        ({"rooms": ((0, 0, 150, 160), (400, 0, 500, 160))}, "no doors"),
    ],
)
def test_campus_refusals(change: dict[str, object], start: str, tmp_path: Path) -> None:
    assert reason(write.campus(tmp_path / "a.xml", **change)).startswith(start)  # type: ignore[arg-type]


def test_xml_with_entities_is_not_read(tmp_path: Path) -> None:
    bomb = '<!DOCTYPE b [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><building>&b;</building>'
    for encoding in ("utf-8", "utf-16"):
        (tmp_path / "a.xml").write_bytes(f'<?xml version="1.0" encoding="{encoding}"?>{bomb}'.encode(encoding))
        assert "DOCTYPE" in reason(tmp_path / "a.xml")
    (tmp_path / "a.xml").write_text("<building><floor>")
    assert reason(tmp_path / "a.xml").startswith("damaged XML")
    (tmp_path / "a.xml").write_text("<kml/>")
    assert reason(tmp_path / "a.xml").startswith("not a campus plan")


def test_yaml_refusals(tmp_path: Path) -> None:
    path = tmp_path / "a.building.yaml"
    assert reason(write.rmf(path, system="wgs84")).startswith("wrong version")
    assert reason(write.rmf(path, measurements="[]")).startswith("no scale")
    assert reason(write.rmf(path, measurements="[[0, 1, {distance: [3, 1000.0]}]]")).startswith("absurd scale")
    for text, start in (
        ("levels: [", "damaged YAML"),
        ("a: 1", "not an RMF plan"),
        ("!!python/object:os.system {}", "damaged YAML"),
    ):
        path.write_text(text)
        assert reason(path).startswith(start)
    path.write_text("levels: {L1: {measurements: [[0, 1, {distance: [3, 1]}]], vertices: [[0, 0], [9, 0]], walls: [[0, 7]]}}")
    assert reason(path).startswith("bad line")


def test_mall_refusals(tmp_path: Path) -> None:
    assert reason(write.mall(tmp_path / "F1", info=False)).startswith("missing file: floor_info.json")
    assert reason(write.mall(tmp_path / "F2", width=90.0)).startswith("absurd scale")
    path = write.mall(tmp_path / "F3")
    path.write_bytes(path.read_bytes()[:200])
    assert reason(path).startswith("damaged JSON")


def test_amrl_refusals(tmp_path: Path) -> None:
    path = write.amrl(tmp_path / "a.vectormap.json", size=1000)
    assert reason(path).startswith("absurd scale")
    for text, start in (("[", "damaged JSON"), ("[]", "no walls"), ('[{"a": 1}]', "not a line map"), ("3", "not a line map")):
        path.write_text(text)
        assert reason(path).startswith(start)


def test_grid_refusals(tmp_path: Path) -> None:
    assert reason(write.bwi(tmp_path / "1", doors=False)).startswith("missing file: doors.yaml")
    assert reason(write.bwi(tmp_path / "2", resolution=7.0)).startswith("absurd scale")
    path = write.bwi(tmp_path / "3")
    (tmp_path / "3" / "3.png").write_bytes(b"not an image")
    assert reason(path).startswith("damaged image")
    (tmp_path / "3" / "3.png").unlink()
    assert reason(path).startswith("missing file")
    path = write.ipa(tmp_path)
    (tmp_path / "flat.png").unlink()
    assert reason(path) == "missing file: flat.png"


def test_ifc_refusals(tmp_path: Path) -> None:
    pytest.importorskip("ifcopenshell")
    assert reason(write.ifc(tmp_path / "a.ifc", spaces=0)).startswith("no rooms")
    assert reason(write.ifc(tmp_path / "b.ifc", spaces=1)).startswith("too few rooms")
    (tmp_path / "c.ifc").write_text("ISO-10303-21; nothing")
    assert reason(tmp_path / "c.ifc").startswith("damaged IFC")


def test_unknown_and_missing_files(tmp_path: Path) -> None:
    (tmp_path / "a.dwg").write_text("x")
    with pytest.raises(InputError, match="not a known format"):
        read_plans(tmp_path / "a.dwg")
    with pytest.raises(InputError, match="missing file"):
        read_plans(tmp_path / "gone.xml")
    with pytest.raises(InputError, match="no such file"):
        list(iter_plans(tmp_path / "gone"))
    assert list(iter_plans(tmp_path)) == []


# Archives and folders


def test_archive_is_read_in_memory_and_one_bad_member_is_one_refusal(tmp_path: Path) -> None:
    good = write.r2v(tmp_path / "good.txt").read_bytes()
    path = pack(
        tmp_path / "all.tar.xz", {"./00/a.txt": good, "../b.txt": b"x", "c.txt": b"1" * (2 << 20), "d.md": b"", "e.txt": good}
    )
    results = dict(iter_plans(path))
    assert [name for name, r in results.items() if isinstance(r, Plan)] == ["00/a", "e"]
    assert results["c"].reason.startswith("absurd size")  # type: ignore[union-attr]
    assert summarise(results.items()) == {"taken": 2, "bad line": 1, "absurd size": 1}
    assert len(read_plans(f"{path}::00/a")) == 1
    with pytest.raises(InputError, match="no plan"):
        read_plans(f"{path}::zz")
    assert sorted(p.name for p in tmp_path.parent.glob("b.txt")) == []


def test_truncated_archive_is_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    good = write.r2v(tmp_path / "good.txt").read_bytes()
    path = pack(tmp_path / "all.tar.xz", {f"{k}.txt": good + rng.bytes(2000).hex().encode() for k in range(50)})
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    refusals = [r for _, r in iter_plans(path) if isinstance(r, Refusal) and r.reason.startswith("damaged archive")]
    assert len(refusals) == 1
    path.write_bytes(b"")
    assert reason(path).startswith("damaged archive")


def test_absurdly_large_archive_is_not_read_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("topomerge.datasets.plan_r2v.MAX_TOTAL", 1 << 20)
    path = pack(tmp_path / "all.tar.xz", {"zeros.bin": bytes(2 << 20), "a.txt": write.r2v(tmp_path / "a.txt").read_bytes()})
    assert reason(path).startswith("absurd size")


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_damaged_bytes_never_raise(make: Callable[[Path], Path], tmp_path: Path) -> None:
    path = make(tmp_path)
    whole, rng = path.read_bytes(), np.random.default_rng(1)
    for _ in range(25):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), 4):
            data[at] = rng.integers(256)
        path.write_bytes(bytes(data[: rng.integers(1, len(data) + 1)]) if rng.random() < 0.3 else bytes(data))
        assert all(isinstance(r, Plan | Refusal) for _, r in iter_plans(path))


def test_folder_names_are_unique_and_siblings_are_found(tmp_path: Path) -> None:
    for name in (
        "site/Sabadell2",
        "site/Sabadell1",
        "site/Lone",
        "site/hillgroundfloor",
        "site/hillsecondfloor",
        "other/Sabadell1",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write.campus(tmp_path / f"{name}_updated.xml")
    write.rmf(tmp_path / "two.building.yaml", levels=2)
    for floor in ("B1", "F1", "F2"):
        write.mall(tmp_path / floor)
    names = [name for name, result in iter_plans(tmp_path) if isinstance(result, Plan)]
    assert len(names) == len(set(names)) == 11 and "B1" in names and "two/L2" in names
    assert siblings(tmp_path) == [
        ["B1", "F1", "F2"],
        ["site/Sabadell1", "site/Sabadell2"],
        ["site/hillgroundfloor", "site/hillsecondfloor"],
        ["two/L1", "two/L2"],
    ]


def test_rooms_that_no_door_reaches_are_left_out_and_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rooms = ((0, 0, 150, 160), (150, 0, 300, 160), (400, 0, 450, 60))
    with caplog.at_level(logging.INFO):
        (plan,) = read_plans(write.campus(tmp_path / "a.xml", rooms=rooms, labels=("CLASSROOM", "CORRIDOR", "CLOSET")))
    assert len(plan.rooms) == 2 and "kept 2 of 3 rooms" in caplog.text
    far = ((0, 0, 150, 160), (150, 0, 300, 160), (400, 0, 900, 160))
    refused = reason(write.campus(tmp_path / "b.xml", rooms=far, labels=("CLASSROOM", "CORRIDOR", "HALL")))
    assert refused.startswith("disconnected: the largest part")


# Geometry


def test_hole_is_cut_open_and_closes_again() -> None:
    ring = shapely.box(0, 0, 10, 10).difference(shapely.union_all([shapely.box(2, 2, 4, 4), shapely.box(6, 6, 8, 8)]))
    shape = shapely.Polygon(cut_open(ring))
    assert shape.is_valid and not shape.interiors
    assert shape.area == pytest.approx(92, abs=0.01)
    healed = shapely.set_precision(shape, 1e-3)
    assert len(healed.interiors) == 2 and healed.area == pytest.approx(92)


def test_slit_of_a_hole_becomes_no_wall(tmp_path: Path) -> None:
    (plan,) = read_plans(write.campus(tmp_path / "a.xml", rooms=((0, 0, 300, 300), (100, 40, 250, 250)), portal=(100, 150)))
    building = erect([plan], Difficulty(furniture=0, clutter=0, columns=0, beams=0, lamps=0))
    middles = building.vertices[building.triangles][building.labels == SURFACES.index("wall")].mean(axis=1)[:, :2]
    walls = shapely.union_all([shapely.box(0, -15, 15, 0).exterior, shapely.box(5, -12.5, 12.5, -2).exterior])
    assert shapely.distance(walls, shapely.points(middles)).max() < 0.3


def test_place_door_where_rooms_face_each_other() -> None:
    a, b = shapely.box(0, 0, 4, 4), shapely.box(4.2, 1, 8, 9)
    opening = place_door(a, b, 0.9, 0.5, np.array([4.0, 0.0]))
    assert opening is not None
    assert sorted([opening.start, opening.end]) == [pytest.approx((4.1, 1.1), abs=0.06), pytest.approx((4.1, 2.0), abs=0.06)]
    assert place_door(a, b, 0.9, 0.1) is None
    assert place_door(a, shapely.box(4.1, 3.7, 8, 9), 0.9, 0.5) is None  # they share 0.3 m only


def test_sides_are_left_and_right() -> None:
    shapes = [shapely.box(0, 0, 4, 4), shapely.box(4, 0, 8, 4)]
    found = sides(np.array([[4.0, 1], [0, 1]]), np.array([[4.0, 2], [0, 2]]), shapes, 0.3)
    assert found.tolist() == [[0, 1], [-1, 0]]


def test_flood_meets_in_the_narrowest_place() -> None:
    free = np.ones((9, 21), bool)
    free[:, 8] = False
    free[3:6, 8] = True
    seeds = np.zeros((9, 21), np.int32)
    seeds[4, 1], seeds[4, 19] = 1, 2
    height = np.where(free, 2, 0)
    height[3:6, 8] = 1
    labels = flood(seeds, free, height)
    assert (labels[:, :8] == 1).all() and (labels[:, 9:] == 2).all() and (labels[:3, 8] == 0).all()
    ((a, b, ends),) = contacts(labels, 0.1, np.zeros(2))
    assert (a, b) == (1, 2) and np.ptp(ends, axis=0) == pytest.approx([0, 0.3])
    assert outline(labels == 1, 0.1, np.array([5.0, 0])).bounds[:2] == pytest.approx((5.0, 0.0))


# Real data


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
    groups = siblings(data_dir / "plans_schools_offices")
    assert ["school/Sabadell1", "school/Sabadell2", "school/Sabadell3"] in groups
    (plan,) = read_plans(data_dir / "plans_schools_offices/school/Sabadell1_updated.xml")
    building = erect([plan])
    assert len(building.rooms) == 18 and len(set(building.parts().tolist())) == 1


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
@pytest.mark.parametrize(("folder", "least"), [("plans_malls", 13), ("utexas_amrl_vectormaps", 12)])
def test_large_formats_come_through(folder: str, least: int, data_dir: Path) -> None:
    assert summarise(iter_plans(data_dir / folder))["taken"] >= least
