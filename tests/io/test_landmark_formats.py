"""Landmarks in the files of other programs: what goes out comes back, and what is theirs comes in."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as xml

import numpy as np
import pytest

from tests.io.export_maps import two_floors
from tests.io.indoorgml_structure import check
from tests.io.scene_graphs import box_mesh, scene_graph, write_scene_graph
from tests.io.test_read_valetudo import two_rooms
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.extraction.landmarks import add_landmarks
from topomerge.io import read_points
from topomerge.io.exports import save_export
from topomerge.io.listing import save_json
from topomerge.io.room_names import load_landmark_source
from topomerge.types import Landmarks, TopometricMap, build_landmarks, join_landmarks

EVIL = "a<b>&\"'; <script>"


@pytest.fixture(scope="module")
def marked() -> TopometricMap:
    """Two storeys with names by room, a sign and an object by place, a tag by room alone, a reading of radio."""
    map = two_floors()
    middle = map.rooms["centroid"]
    parts = [
        build_landmarks("name", ["Lab", EVIL], "by hand", room=[0, 4]),
        build_landmarks("text", ["2.113"], "signs.csv", middle[3:4], confidence=0.5),
        build_landmarks("object", ["sofa"], "robot", middle[1:2]),
        build_landmarks("tag", ["t:1"], "robot", room=2),
        build_landmarks("radio", ["aa:bb"], "robot", middle[1:2], number=-60.0),
    ]
    return add_landmarks(map, join_landmarks(parts))


def rows(landmarks: Landmarks) -> list[tuple[int, str, int]]:
    return sorted(zip(landmarks.table["kind"].tolist(), landmarks.get_values(), landmarks.table["room"].tolist(), strict=True))


def test_json_and_geojson_come_back(marked: TopometricMap, tmp_path: Path) -> None:
    save_json(marked, tmp_path / "a.json")
    assert rows(load_landmark_source(tmp_path / "a.json")) == rows(marked.landmarks)
    without = rows(marked.landmarks.select(~marked.landmarks.is_kind("radio")))
    for origin in (None, "52.5,13.4"):
        save_export(marked, "geojson", tmp_path / "a.geojson", **({"origin": origin} if origin else {}))
        back = load_landmark_source(tmp_path / "a.geojson")
        assert rows(back) == without
        own = marked.landmarks.table[~marked.landmarks.is_kind("radio")]
        assert np.allclose(back.table["position"], own["position"], equal_nan=True)
    listing = json.loads((tmp_path / "a.geojson").read_text(encoding="utf-8"))["features"]
    names = {f["properties"]["room"]: f["properties"].get("name") for f in listing if f["properties"]["kind"] == "room"}
    assert names == {0: "Lab", 1: None, 2: None, 3: "2.113", 4: EVIL, 5: None}
    point = next(f for f in listing if f["properties"].get("value") == "sofa")
    assert point["geometry"]["type"] == "Point" and point["properties"]["of"] == "object"


def foreign(*features: dict[str, Any], **more: Any) -> str:
    return json.dumps({"type": "FeatureCollection", "features": list(features), **more})


def polygon(x: float, size: float = 4.0, **properties: Any) -> dict[str, Any]:
    ring = [[x, 0], [x + size, 0], [x + size, size], [x, size], [x, 0]]
    return {"type": "Feature", "properties": properties, "geometry": {"type": "Polygon", "coordinates": [ring]}}


def test_plans_of_others_in_geojson(tmp_path: Path) -> None:
    path = tmp_path / "plan.geojson"
    path.write_text(
        foreign(polygon(0, ref="1.01", level=1), polygon(5, name="Hall"), polygon(10), {"type": "Feature", "properties": None})
    )
    back = load_landmark_source(path)
    assert back.get_values().tolist() == ["1.01", "Hall"] and back.table["storey"].tolist() == [1, -1]
    assert back.table["position"].tolist() == [[2, 2, 1], [7, 2, 1]]
    path.write_text(foreign(polygon(13.4, 1e-4, name="Hall")))
    with pytest.raises(InputError, match=r"plan\.geojson: is in degrees of longitude and latitude"):
        load_landmark_source(path)


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        "3",
        "{}",
        foreign(3),  # type: ignore[arg-type]
        foreign({"properties": {"kind": "landmark", "of": "noise", "value": "x"}}),
        foreign({"properties": {"name": "x"}, "geometry": {"type": "Polygon", "coordinates": [[1, 2]]}}),
        foreign({"properties": {"name": "x"}, "geometry": {"type": "Polygon"}}),
        json.dumps({"landmarks": [{"kind": "text"}]}),
        json.dumps({"landmarks": []}),
        json.dumps({"nodes": [{}], "edges": []}),
        json.dumps({"nodes": [{"layer": 2, "attributes": {"name": "x", "position": "y"}}], "edges": []}),
        json.dumps({"nodes": [], "edges": [], "metadata": {"labelspaces": {"_l2p0": [3]}}}),
    ],
)
def test_damaged_json_is_told_in_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError) as caught:
        load_landmark_source(tmp_path / "a.json")
    assert "a.json" in str(caught.value) and "\n" not in str(caught.value)


def test_indoorgml_keeps_landmarks_and_names_of_cells(marked: TopometricMap, tmp_path: Path) -> None:
    save_export(marked, "indoorgml", tmp_path / "a.gml")
    check(xml.parse(tmp_path / "a.gml").getroot())
    back, own = load_landmark_source(tmp_path / "a.gml"), marked.landmarks.select(~marked.landmarks.is_kind("radio"))
    assert rows(back) == rows(own) and back.sources == ("by hand", "signs.csv", "robot")
    for column in ("position", "confidence", "storey", "sigma"):
        assert np.allclose(back.table[column], own.table[column], atol=1e-4, equal_nan=True)
    names = two_floors()
    save_export(names, "indoorgml", tmp_path / "names.gml")
    text = (tmp_path / "names.gml").read_text(encoding="utf-8").replace(">room 0<", ">Lab<")  # as others write it
    (tmp_path / "names.gml").write_text(text, encoding="utf-8")
    assert rows(add_landmarks(names, load_landmark_source(tmp_path / "names.gml")).landmarks) == [(5, "Lab", 0)]
    (tmp_path / "b.gml").write_text("<!DOCTYPE x [<!ENTITY a 'aaaa'>]><x>&a;</x>")
    for name, text, said in (
        ("b", None, "declares entities"),
        ("c", "<x>", "not IndoorGML"),
        ("d", "<x/>", "holds no landmarks"),
    ):
        if text is not None:
            (tmp_path / f"{name}.gml").write_text(text)
        with pytest.raises(InputError, match=said):
            load_landmark_source(tmp_path / f"{name}.gml")


def test_a_scene_graph_keeps_its_objects_and_names(marked: TopometricMap, tmp_path: Path) -> None:
    save_export(marked, "dsg", tmp_path / "a.json")
    back = add_landmarks(two_floors(), load_landmark_source(tmp_path / "a.json"))
    assert rows(back.landmarks) == [(0, "2.113", 3), (4, "sofa", 1), (5, "2.113", 3), (5, "Lab", 0), (5, EVIL, 4)]
    dsg = pytest.importorskip("spark_dsg")
    graph = dsg.DynamicSceneGraph.load(str(tmp_path / "a.json"))
    layer = graph.get_layer(dsg.DsgLayers.OBJECTS)
    assert sorted(node.attributes.name for node in layer.nodes) == ["2.113", "sofa"]
    assert all(node.has_parent() for node in layer.nodes)
    graph.save(str(tmp_path / "b.json"), False)
    again = add_landmarks(two_floors(), load_landmark_source(tmp_path / "b.json"))
    assert rows(again.landmarks) == rows(back.landmarks)


def test_the_objects_of_a_robots_graph_reach_the_map(tmp_path: Path) -> None:
    def node(layer: int, name: str, at: tuple[float, float, float], label: int = 2**32 - 1) -> dict[str, Any]:
        return {"id": layer, "layer": layer, "attributes": {"name": name, "position": at, "semantic_label": label}}

    graph = scene_graph(*box_mesh())
    graph["metadata"] = {"labelspaces": {"_l2p0": [[3, "chair"]], "_l4p0": [[1, "kitchen"]]}}
    graph["nodes"] = [
        node(2, "O(0)", (1, 1, 0.4), 3),
        node(2, "fire hose", (3.9, 1, 1)),
        node(2, "O(1)", (2, 2, 0), 99),  # nobody knows what
        node(3, "p(0)", (1, 1, 1)),
        node(4, "R(0)", (2, 1.5, 1), 1),
        {**node(4, "of a mesh", (2, 1, 1)), "partition": 1},
    ]
    cloud = read_points(write_scene_graph(tmp_path / "dsg_with_mesh.json", graph))
    assert cloud.landmarks is not None and rows(cloud.landmarks) == [(4, "chair", -1), (4, "fire hose", -1), (5, "kitchen", -1)]
    map = extract(cloud)
    assert {room for _, _, room in rows(map.landmarks)} == {0}
    save_export(map, "dsg", tmp_path / "out.json")
    assert [value for _, value, _ in rows(load_landmark_source(tmp_path / "out.json"))] == ["chair", "fire hose", "kitchen"]


def test_names_of_a_vacuum_robots_rooms(tmp_path: Path) -> None:
    path = tmp_path / "home.json"
    path.write_text(json.dumps(two_rooms()))
    cloud = read_points(path)
    assert cloud.landmarks is not None and rows(cloud.landmarks) == [(5, "Bath", -1)]
    x, y, z = cloud.landmarks.table["position"][0].tolist()
    inside = cloud.points[(np.abs(cloud.points[:, :2] + cloud.shift[:2] - (x, y)) < 0.06).all(axis=1)]
    assert len(inside) and 0 < z < 2, "its floor is there"
    assert rows(load_landmark_source(path)) == rows(cloud.landmarks)


def test_graphml_labels_rooms(marked: TopometricMap, tmp_path: Path) -> None:
    networkx = pytest.importorskip("networkx")
    save_export(marked, "graphml", tmp_path / "a.graphml")
    graph = networkx.read_graphml(tmp_path / "a.graphml")
    assert [graph.nodes[f"r{i}"]["label"] for i in range(6)] == ["Lab", "room 1", "room 2", "2.113", EVIL, "room 5"]


def test_a_building_model_comes_back(marked: TopometricMap, tmp_path: Path) -> None:
    ifcopenshell = pytest.importorskip("ifcopenshell")
    save_export(marked, "ifc", tmp_path / "a.ifc")
    model = ifcopenshell.open(str(tmp_path / "a.ifc"))
    assert {s.Name: s.LongName for s in model.by_type("IfcSpace")}["room 4"] == EVIL
    assert {a.ObjectType: a.Name for a in model.by_type("IfcAnnotation")} == {"text": "2.113", "object": "sofa"}
    cloud = read_points(tmp_path / "a.ifc")
    assert cloud.landmarks is not None
    placed = add_landmarks(two_floors(), cloud.landmarks)
    assert rows(placed.landmarks) == [(0, "2.113", 3), (4, "sofa", 1), (5, "2.113", 3), (5, "Lab", 0), (5, EVIL, 4)]
    sign = cloud.landmarks.is_kind("text")
    assert np.allclose(cloud.landmarks.table["position"][sign], marked.rooms["centroid"][3], atol=1e-3)


@pytest.mark.longer
def test_names_of_spaces_short_and_long(tmp_path: Path) -> None:
    ifcopenshell = pytest.importorskip("ifcopenshell")
    save_export(two_floors(), "ifc", tmp_path / "a.ifc")
    assert not len(read_points(tmp_path / "a.ifc").landmarks or ())
    model = ifcopenshell.open(str(tmp_path / "a.ifc"))
    space = model.by_type("IfcSpace")[0]
    space.Name, space.LongName = "A.01", "Office"
    model.write(str(tmp_path / "b.ifc"))
    found = read_points(tmp_path / "b.ifc").landmarks
    assert found is not None and rows(add_landmarks(two_floors(), found).landmarks) == [(5, "A.01", 0), (5, "Office", 0)]


@pytest.mark.longer
def test_maps_without_landmarks_are_exported_as_before(tmp_path: Path) -> None:
    """The same files but for what names and marks add: nothing of it."""
    for name, suffix in (("geojson", "geojson"), ("graphml", "graphml"), ("indoorgml", "gml"), ("dsg", "json")):
        save_export(two_floors(), name, tmp_path / f"a.{suffix}")
        text = (tmp_path / f"a.{suffix}").read_text()
        assert "landmark" not in text and "ObjectNodeAttributes" not in text
        save_export(replace(two_floors(), landmarks=Landmarks()), name, tmp_path / f"b.{suffix}")
        assert (tmp_path / f"b.{suffix}").read_text() == text
