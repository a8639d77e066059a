"""A niche and a cupboard at known places: where they are, and that they stay in files, exports and joined maps."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import topomerge as tm
from tests.extraction.elevations.doors import niche
from tests.extraction.elevations.recesses import CUPBOARD, NICHE, niche_and_cupboard
from tests.scenes import two_rooms
from topomerge.errors import InputError
from topomerge.extraction.elevations.fixtures import fixtures_in_map
from topomerge.fusion.atlas.store import tile_map
from topomerge.structure.plan_structure import plan_structure
from topomerge.types import Sim3, TopometricMap, confident, of_rooms
from topomerge.viz.report import report_html

MOVE = Sim3(0.7, (12.0, -5.0, 1.0))
MIDDLES = {"niche": ((NICHE[0] + NICHE[1]) / 2, 5.0), "cupboard": (0.0, (CUPBOARD[0] + CUPBOARD[1]) / 2)}
SIZES = {"niche": (NICHE[1] - NICHE[0], *NICHE[2:]), "cupboard": (CUPBOARD[1] - CUPBOARD[0], CUPBOARD[2], 0.0, CUPBOARD[3])}
INTO = {"niche": np.pi / 2, "cupboard": np.pi}


def extracted(points: np.ndarray, move: Sim3 | None = None) -> TopometricMap:
    return tm.extract((points if move is None else move.apply(points)).astype(np.float32))


@pytest.fixture(scope="module")
def map() -> TopometricMap:
    return extracted(niche_and_cupboard())


@pytest.fixture(scope="module")
def moved() -> TopometricMap:
    return extracted(niche_and_cupboard(), MOVE)


def check_places(map: TopometricMap, move: Sim3 | None = None) -> None:
    """Are there the niche and the cupboard of the scene, and nothing else?"""
    assert sorted(map.fixtures["kind"].tolist()) == ["cupboard", "niche"]
    for fixture in map.fixtures:
        kind = str(fixture["kind"])
        centre = fixture["centre"] if move is None else move.inverse().apply(fixture["centre"][None])[0]
        assert centre[:2] == pytest.approx(MIDDLES[kind], abs=0.1)
        width, *sizes = SIZES[kind]
        assert fixture["width"] == pytest.approx(width, abs=0.25), "a place of 0.1 m at either end"
        assert [float(fixture[name]) for name in ("depth", "bottom", "top")] == pytest.approx(sizes, abs=0.15)
        turned = fixture["direction"] - INTO[kind] - (0 if move is None else move.yaw)
        assert np.cos(turned) > 0.99 and 0 <= fixture["direction"] < 2 * np.pi
        assert fixture["confidence"] >= 0.8


def test_a_niche_and_a_cupboard_are_where_they_are(map):
    check_places(map)
    (left,) = set(map.fixtures["room"].tolist())
    assert map.rooms["centroid"][left, 0] < 4 and len(map.edges) == 1 and not len(map.windows)


def test_a_moved_map_has_them_moved(moved):
    check_places(moved, MOVE)


@pytest.mark.parametrize("depth", [0.1, 0.2])
def test_a_niche_between_two_rooms_is_of_the_one_that_sees_it(depth: float):
    map = extracted(niche(depth, 0.6, 1.0, 1.6, 0.15).points(0.003))
    (fixture,) = map.fixtures
    assert fixture["kind"] == "niche" and map.rooms["centroid"][fixture["room"], 0] < 4
    assert fixture["depth"] == pytest.approx(depth, abs=0.03) and np.cos(fixture["direction"]) > 0.99


def test_plain_walls_have_neither():
    assert not len(extracted(two_rooms().points()).fixtures)
    assert not len(tm.extract(niche_and_cupboard().astype(np.float32), walls=False).fixtures)


def test_where_a_door_is_there_is_none(map):
    at_door = map.fixtures[:1].copy()
    at_door["centre"], at_door["direction"], at_door["width"] = map.edges["centre"][0], map.edges["direction"][0], 0.9
    assert not len(fixtures_in_map(map, at_door)) and len(fixtures_in_map(map, map.fixtures)) == 2


def test_files_keep_them_and_older_ones_have_none(map, tmp_path: Path):
    tm.save_map(map, tmp_path / "a.tmap")
    assert (tm.load_map(tmp_path / "a.tmap").fixtures == map.fixtures).all()
    tm.save_map(replace(map, fixtures=map.fixtures[:0]), tmp_path / "older.tmap")
    with np.load(tmp_path / "a.tmap") as newer, np.load(tmp_path / "older.tmap") as older:
        assert "fixtures" in newer and "fixtures" not in older, "a file without them is as earlier versions wrote it"
    assert not len(tm.load_map(tmp_path / "older.tmap").fixtures)
    tm.save_json(map, tmp_path / "a.json")
    listed = json.loads((tmp_path / "a.json").read_text())["fixtures"]
    assert [f["kind"] for f in listed] == map.fixtures["kind"].tolist() and set(listed[0]) == set(map.fixtures.dtype.names)


def test_what_was_not_seen_is_null(map, tmp_path: Path):
    fixtures = map.fixtures.copy()
    for name in ("depth", "bottom", "top"):
        fixtures[name] = np.nan
    unseen = replace(map, fixtures=fixtures)
    tm.save_map(unseen, tmp_path / "a.tmap")
    assert np.isnan(tm.load_map(tmp_path / "a.tmap").fixtures["depth"]).all()
    tm.save_json(unseen, tmp_path / "a.json")
    assert json.loads((tmp_path / "a.json").read_text())["fixtures"][0]["top"] is None


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("room", 7, "room does not exist"),
        ("kind", "shelf", "kind that is none of niche, cupboard"),
        ("width", 0.0, "not wide, deep or high"),
        ("depth", -0.1, "not wide, deep or high"),
        ("top", 0.0, "not wide, deep or high"),
        ("centre", np.nan, "no number"),
        ("confidence", 2.0, "not from 0 to 1"),
    ],
)
def test_damaged_tables_are_refused(map, tmp_path: Path, column: str, value: object, words: str):
    fixtures = map.fixtures.copy()
    fixtures[column][0] = value
    damaged = replace(map)
    object.__setattr__(damaged, "fixtures", fixtures)  # a map itself refuses some of them
    tm.save_map(damaged, tmp_path / "a.tmap")
    with pytest.raises(InputError, match=f"a.tmap: damaged .*{words}"):
        tm.load_map(tmp_path / "a.tmap")


@pytest.mark.parametrize("room", [-1, 2])
def test_fixtures_of_no_room_are_refused(map, room: int):
    fixtures = map.fixtures.copy()
    fixtures["room"] = room
    with pytest.raises(ValueError, match="a fixture's room does not exist"):
        replace(map, fixtures=fixtures)


def test_rooms_that_are_left_out_take_them_along(map):
    left = int(map.fixtures["room"][0])
    stays = np.arange(len(map.rooms)) != left
    assert not len(of_rooms(map, stays).fixtures)
    alone = of_rooms(map, ~stays)
    assert len(alone.rooms) == 1 and alone.fixtures["room"].tolist() == [0, 0]
    assert len(tile_map(map, [left]).fixtures) == 2 and not len(tile_map(map, [1 - left]).fixtures)
    fixtures = map.fixtures.copy()
    fixtures["confidence"] = [0.3, 0.9]
    assert len(confident(replace(map, fixtures=fixtures), 0.5).fixtures) == 1


def test_a_joined_map_has_each_once(map, moved):
    merged = tm.merge([map, moved], force=True)
    assert merged.map is not None
    check_places(merged.map)


def test_geojson_and_a_building_model_hold_them(map, tmp_path: Path):
    tm.save_export(map, "geojson", tmp_path / "a.geojson")
    features = {f["id"]: f for f in json.loads((tmp_path / "a.geojson").read_text())["features"]}
    drawn = [features[f"fixture {k}"] for k in range(2)]
    assert [f["properties"]["kind"] for f in drawn] == map.fixtures["kind"].tolist()
    for feature, fixture in zip(drawn, map.fixtures, strict=True):
        assert np.mean(feature["geometry"]["coordinates"], axis=0) == pytest.approx(fixture["centre"], abs=1e-3)
    ifcopenshell = pytest.importorskip("ifcopenshell")
    import ifcopenshell.util.element as element

    tm.save_export(map, "ifc", tmp_path / "a.ifc")
    model = ifcopenshell.open(str(tmp_path / "a.ifc"))
    (recess,) = [o for o in model.by_type("IfcOpeningElement") if o.PredefinedType == "RECESS"]
    assert recess.VoidsElements[0].RelatingBuildingElement.is_a("IfcWall") and not recess.HasFillings
    assert element.get_psets(recess)["Topomerge_Niche"]["DepthSeen"] is True
    (cupboard,) = model.by_type("IfcFurniture")
    left = int(map.fixtures["room"][0])
    assert cupboard.ContainedInStructure[0].RelatingStructure.Name == f"room {left}"
    assert element.get_psets(cupboard)["Topomerge_Cupboard"]["Confidence"] >= 0.8


def test_a_building_model_has_them_where_they_are(map, tmp_path: Path):
    ifcopenshell = pytest.importorskip("ifcopenshell")
    geometry = pytest.importorskip("ifcopenshell.geom")
    tm.save_export(map, "ifc", tmp_path / "a.ifc")
    model = ifcopenshell.open(str(tmp_path / "a.ifc"))
    settings = geometry.settings()
    settings.set("use-world-coords", True)
    (recess,) = [o for o in model.by_type("IfcOpeningElement") if o.PredefinedType == "RECESS"]
    for product, low, high in (
        (model.by_type("IfcFurniture")[0], (0.0, CUPBOARD[0], 0.0), (CUPBOARD[2], CUPBOARD[1], CUPBOARD[3])),
        (recess, (NICHE[0], 5.0, NICHE[3]), (NICHE[1], 5.0 + NICHE[2], NICHE[4])),
    ):
        corners = np.array(geometry.create_shape(settings, product).geometry.verts).reshape(-1, 3)
        assert corners.min(axis=0) == pytest.approx(low, abs=0.15) and corners.max(axis=0) == pytest.approx(high, abs=0.15)


def test_what_was_not_seen_has_a_usual_size_in_a_building_model(map, tmp_path: Path):
    ifcopenshell = pytest.importorskip("ifcopenshell")
    import ifcopenshell.util.element as element

    fixtures = map.fixtures.copy()
    for name in ("depth", "bottom", "top"):
        fixtures[name] = np.nan
    unseen = replace(map, fixtures=fixtures)
    placed = plan_structure(unseen).fixtures
    assert placed["depth"].tolist() == [0.45, 0.1] and placed["bottom"].tolist() == [0.0, 0.9] and (placed["wall"] >= 0).all()
    tm.save_export(unseen, "ifc", tmp_path / "a.ifc")
    model = ifcopenshell.open(str(tmp_path / "a.ifc"))
    (cupboard,) = model.by_type("IfcFurniture")
    facts = element.get_psets(cupboard)["Topomerge_Cupboard"]
    assert not facts["DepthSeen"] and not facts["BottomSeen"] and not facts["TopSeen"]
    assert report_html(unseen).count('class="fixture ') == 2


def test_the_plan_draws_them_faintly(map):
    page = report_html(map)
    assert page.count('class="fixture niche"') == 1 and page.count('class="fixture cupboard"') == 1
    assert "sign-niche" in page and "sign-cupboard" in page
