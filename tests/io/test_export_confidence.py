"""Confidence of rooms, doors and windows in the exports, and exports of what is likely enough only."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np
import pytest

import topomerge
from tests.io.export_maps import doubted, nothing
from tests.io.indoorgml_structure import CORE, GML, check, positions
from tests.io.test_export_plans import geojson, with_areas, write
from tests.scenes_map import same
from topomerge.errors import InputError
from topomerge.io.exports import FORMATS
from topomerge.structure.plan_structure import build_plan_structure
from topomerge.types import ROOM_ODDS, filter_confident


def described(root: xml.Element, kind: str) -> dict[str, dict[str, str]]:
    """What the descriptions of a document's elements say, by id."""
    said = {}
    for element in root.iter(CORE + kind):
        pairs = (element.findtext(GML + "description") or "").split(":")
        said[element.get(GML + "id", "")] = {key: value.strip('"') for key, value in (p.split("=") for p in pairs if p)}
    return said


def test_doubtful_rooms_take_their_doors_along() -> None:
    map = doubted()
    sure = filter_confident(map, 0.7)
    assert sure.rooms["confidence"].tolist() == [0.9, 0.8, 0.7, 0.95], "what is as likely as asked for stays"
    assert np.array_equal(sure.rooms, map.rooms[[0, 2, 3, 4]])
    assert len(sure.edges) == 0, "rooms 1 and 5 took three of them along, one is doubtful itself"
    assert sure.windows["rooms"].tolist() == [[0, -1], [0, -1]]
    number = np.array([0, -1, 1, 2, 3, -1, -1])
    assert np.array_equal(sure.room, number[map.room]) and np.array_equal(sure.navigable_room, number[map.navigable_room])
    assert same(replace(sure, rooms=map.rooms, room=map.room, navigable_room=map.navigable_room, edges=map.edges), map)


def test_doors_have_the_new_numbers_of_their_rooms() -> None:
    map = doubted()
    sure = filter_confident(map, 0.5)
    assert sure.edges["rooms"].tolist() == [[2, 4], [3, 4], [1, 4]]
    assert sure.edges["centre"].tolist() == map.edges["centre"][2:].tolist()
    assert map.edges["rooms"].tolist()[2:] == [[3, 5], [4, 5], [2, 5]], "the map itself stays"


def test_a_window_between_two_rooms_stays_with_the_likely_one() -> None:
    map = doubted()
    rooms, windows = map.rooms.copy(), map.windows.copy()
    rooms["confidence"], windows["confidence"] = [0.1, 1, 1, 1, 1, 1], 1.0
    sure = filter_confident(replace(map, rooms=rooms, windows=windows), 0.5)
    assert sure.windows["rooms"].tolist() == [[1, -1]] and sure.windows["width"].tolist() == [0.6]


def test_areas_and_narrowings_go_with_their_room() -> None:
    map = with_areas()
    rooms = map.rooms.copy()
    rooms["confidence"] = [0.1, 1, 1, 1, 1, 1]
    sure = filter_confident(replace(map, rooms=rooms), 0.5)
    assert sure.areas["room"].tolist() == [0, 1, 2, 3, 4, 4] and sure.narrows["rooms"].tolist() == [[4, 5]]
    rooms["confidence"] = [1, 1, 1, 1, 1, 0.1]
    sure = filter_confident(replace(map, rooms=rooms), 0.5)
    assert sure.areas["room"].tolist() == [0, 1, 2, 3, 4] and len(sure.narrows) == 0


@pytest.mark.parametrize("least", [0.5, 0.7, 1.0])
def test_what_is_left_is_a_map(tmp_path: Path, least: float) -> None:
    sure = filter_confident(doubted(), least)
    topomerge.save_map(sure, tmp_path / "a.tmap")
    again = topomerge.load_map(tmp_path / "a.tmap")
    assert same(again, sure) and again.windows.tobytes() == sure.windows.tobytes()
    assert same(filter_confident(again, least), again), "all that is left is likely enough"


@pytest.mark.parametrize("name", ["geojson", "graphml", "indoorgml", "dsg"])
def test_zero_keeps_every_byte(tmp_path: Path, name: str) -> None:
    map = doubted()
    assert filter_confident(map, 0) is map and len(filter_confident(nothing(), 0.5).rooms) == 0
    (path,) = topomerge.save_export(map, name, tmp_path / "a", min_confidence=0)
    whole = path.read_bytes()
    assert whole == write(map, name, tmp_path / "b").read_bytes()
    (path,) = topomerge.save_export(map, name, tmp_path / "a", min_confidence=0.5)
    assert path.read_bytes() == write(filter_confident(map, 0.5), name, tmp_path / "b").read_bytes() != whole


@pytest.mark.parametrize("wrong", [-0.1, 1.1, float("nan"), float("inf")])
def test_what_is_no_probability_is_refused(tmp_path: Path, wrong: float) -> None:
    with pytest.raises(InputError, match=r"min_confidence \S+: is no probability; give a number from 0 to 1"):
        topomerge.save_export(doubted(), "geojson", tmp_path / "a.geojson", min_confidence=wrong)
    assert not list(tmp_path.iterdir())


def test_geojson_says_how_likely_things_are(tmp_path: Path) -> None:
    map = doubted()
    properties = {f["id"]: f["properties"] for f in geojson(map, tmp_path)["features"]}
    for name, table in (("room", map.rooms), ("edge", map.edges), ("window", map.windows)):
        assert [properties[f"{name} {i}"]["confidence"] for i in range(len(table))] == table["confidence"].tolist()
    assert [properties[f"room {r}"]["outside"] for r in range(6)] == map.rooms["outside"].tolist()


@pytest.mark.longer
@pytest.mark.parametrize("name", ["graphml", "indoorgml", "dsg", "ros", "rviz", "ply", "las", "ifc"])
def test_every_format_of_the_likely_part(tmp_path: Path, name: str) -> None:
    if FORMATS[name].needs is not None:
        pytest.importorskip(FORMATS[name].needs[0])
    files = topomerge.save_export(doubted(), name, tmp_path / "a", min_confidence=0.5)
    assert files and all(file.stat().st_size for file in files)


@pytest.mark.longer
def test_ifc_says_how_likely_doors_are_and_what_is_outside(tmp_path: Path) -> None:
    ifcopenshell = pytest.importorskip("ifcopenshell")
    import ifcopenshell.util.element as element

    map = doubted()
    model = ifcopenshell.open(str(write(map, "ifc", tmp_path / "a.ifc")))
    for kind, name, rows in (("IfcDoor", "Door", map.edges[:4]), ("IfcStair", "Stairs", map.edges[4:])):
        facts = [element.get_psets(product)[f"Topomerge_{name}"] for product in model.by_type(kind)]
        assert [f["Confidence"] for f in facts] == rows["confidence"].tolist() and all(f["Open"] is True for f in facts)
    windows = [element.get_psets(product)["Topomerge_Window"]["Confidence"] for product in model.by_type("IfcWindow")]
    assert windows == map.windows["confidence"].tolist()
    spaces = model.by_type("IfcSpace")
    assert [space.PredefinedType for space in spaces] == ["INTERNAL"] * 3 + ["EXTERNAL"] + ["INTERNAL"] * 2
    sides = {(b.RelatingSpace.Name, b.RelatedBuildingElement.Name): b.InternalOrExternalBoundary for space in spaces
             for b in space.BoundedBy}  # fmt: skip
    assert sides["room 5", "door 2"] == "EXTERNAL" and sides["room 3", "door 2"] == "INTERNAL", "what lies beyond the door"
    assert sides["room 0", "window 0"] == "NOTDEFINED" and sides["room 0", "window 2"] == "INTERNAL"
    opening = map.edges.copy()
    opening["kind"][0], opening["open"][1] = "opening", False
    model = ifcopenshell.open(str(write(replace(map, edges=opening), "ifc", tmp_path / "a.ifc")))
    (virtual,) = model.by_type("IfcVirtualElement")
    assert element.get_psets(virtual)["Topomerge_Opening"]["Confidence"] == 0.4
    assert element.get_psets(model.by_type("IfcDoor")[0])["Topomerge_Door"]["Open"] is False


def test_indoorgml_says_how_likely_things_are(tmp_path: Path) -> None:
    map = doubted()
    root = xml.parse(write(map, "indoorgml", tmp_path / "a.gml")).getroot()
    check(root)
    cells, ways, states = (described(root, kind) for kind in ("CellSpace", "CellSpaceBoundary", "Transition"))
    for r, room in enumerate(map.rooms):
        assert {name: float(cells[f"C{r}"][name]) for name in ROOM_ODDS} == {name: room[name] for name in ROOM_ODDS}
    assert [float(ways[f"B{i}"]["confidence"]) for i in range(4)] == map.edges["confidence"][:4].tolist()
    assert [float(states[f"T{i}"]["confidence"]) for i in range(5)] == map.edges["confidence"].tolist(), "of stairs, too"
    assert [float(ways[f"P{k}"]["confidence"]) for k in range(3)] == map.windows["confidence"].tolist()


def test_windows_of_indoorgml(tmp_path: Path) -> None:
    map = doubted()
    root = xml.parse(write(map, "indoorgml", tmp_path / "a.gml")).getroot()
    panes = {b.get(GML + "id"): b for b in root.iter(CORE + "CellSpaceBoundary") if b.get(GML + "id", "")[0] == "P"}
    assert list(panes) == ["P0", "P1", "P2"] and all(pane.find(CORE + "duality") is None for pane in panes.values())
    for pane, window, seen in zip(panes.values(), build_plan_structure(map).windows, map.windows, strict=True):
        low, high = positions(pane).min(axis=0), positions(pane).max(axis=0)
        assert high[2] - low[2] == pytest.approx(window["head"] - window["sill"], abs=1e-3)
        assert low[2] == pytest.approx(seen["centre"][2] + window["sill"], abs=1e-3)
        assert np.hypot(*(high - low)[:2]) == pytest.approx(seen["width"], abs=1e-3)
        assert (low + high)[:2] / 2 == pytest.approx(seen["centre"][:2], abs=0.1)
    said = described(root, "CellSpaceBoundary")
    assert said["P0"] == {"kind": "window", "width": "1.20", "sill": "0.90", "head": "2.10", "confidence": "0.88"}
    assert "sill" not in said["P1"], "what was not seen is left out"


def test_windows_of_geojson_lie_in_their_walls(tmp_path: Path) -> None:
    map = doubted()
    features = json.loads(write(map, "geojson", tmp_path / "a.geojson").read_text())["features"]
    panes = [f["properties"] for f in features if f["properties"].get("of") == "window"]
    assert (
        [pane["window"] for pane in panes] == np.flatnonzero(build_plan_structure(map).windows["wall"] >= 0).tolist() == [0, 1, 2]
    )
