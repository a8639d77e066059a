"""IndoorGML, IFC and Spark-DSG: structure, what is in them, and opened by the libraries that read them."""

from __future__ import annotations

import importlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as xml

import numpy as np
import pytest
import shapely

import topomerge
from tests.io.export_maps import AT, GRID, doubted, flat, nothing, rectangles, stair_scene, two_floors, without_doors
from tests.io.indoorgml_structure import CORE, GML, check, is_closed, positions, volume
from tests.io.test_export_plans import with_areas, write
from tests.scenes import HEIGHT, THICK, corridor, two_rooms
from topomerge.structure.plan_structure import build_plan_structure
from topomerge.types import TopometricMap


def courtyard() -> TopometricMap:
    plan = np.ones((60, 60), bool)
    plan[20:40, 20:40] = False
    return flat(plan)


@pytest.mark.parametrize("make", [two_floors, nothing, without_doors, courtyard, doubted, lambda: two_floors(GRID)])
def test_indoorgml_has_the_structure_of_its_schema(tmp_path, make):
    map = make()
    root = xml.parse(write(map, "indoorgml", tmp_path / "a.gml")).getroot()
    check(root)
    assert all(is_closed(solid) and volume(solid) > 0 for solid in root.iter(GML + "Solid"))
    solids = [
        solid for cell in root.iter(CORE + "CellSpace") if cell.get(GML + "id")[0] == "C" for solid in cell.iter(GML + "Solid")
    ]
    assert len(solids) == len(map.rooms)
    for solid, room in zip(solids, map.rooms, strict=True):
        assert volume(solid) == pytest.approx(room["volume"] or room["area"] * room["height"], rel=0.03)


def test_indoorgml_graph(tmp_path):
    map = two_floors()
    root = xml.parse(write(map, "indoorgml", tmp_path / "a.gml")).getroot()
    assert len(list(root.iter(CORE + "State"))) == 6 and len(list(root.iter(CORE + "Transition"))) == 5
    assert len(list(root.iter(CORE + "CellSpaceBoundary"))) == 4, "stairs have no door"
    doors = [positions(b) for b in root.iter(CORE + "CellSpaceBoundary")]
    assert doors[0].mean(axis=0)[:2] == pytest.approx(map.edges["centre"][0][:2], abs=0.3)
    assert np.ptp(doors[0], axis=0) == pytest.approx([1.0, 0.0, 2.0])
    stairs = [positions(t) for t in root.iter(CORE + "Transition")][-1]
    assert len(stairs) == 4 and stairs[0, 2] < 1 and stairs[1] == pytest.approx(map.edges["lower"][4])
    assert stairs[2] == pytest.approx(map.edges["upper"][4]) and stairs[3, 2] > 3
    assert root.find(f"{GML}boundedBy/{GML}Envelope/{GML}upperCorner") is not None


def test_dsg_of_pairs_with_two_ways(tmp_path):
    """Two doors between two rooms, two narrowings between two areas: one edge each, as the library refuses a second."""
    dsg = pytest.importorskip("spark_dsg")
    map = with_areas()
    second = map.edges[:1].copy()
    second["rooms"] = map.edges["rooms"][0][::-1]
    second["width"] = map.edges["width"][0] + 0.5
    second["centre"] = map.edges["centre"][0] + (1.5, 0.0, 0.0)
    map = replace(map, edges=np.concatenate([map.edges, second]), narrows=np.concatenate([map.narrows, map.narrows]))
    graph = dsg.DynamicSceneGraph.load(str(write(map, "dsg", tmp_path / "a.json")))
    assert graph.get_layer(dsg.DsgLayers.PLACES).num_nodes() == 7 + 6, "both doors are places"
    rooms = [dsg.NodeSymbol("R", r).value for r in map.edges["rooms"][0]]
    joins = graph.get_edge(*rooms).info.metadata.get()
    widths = [map.edges["width"][0], map.edges["width"][-1]]
    assert joins["width"] == pytest.approx(widths[1]) and [w["width"] for w in joins["ways"]] == pytest.approx(widths)
    assert [w["centre"] for w in joins["ways"]] == [map.edges["centre"][i].tolist() for i in (0, -1)]
    narrow = graph.get_edge(dsg.NodeSymbol("p", 5).value, dsg.NodeSymbol("p", 6).value).info.metadata.get()
    assert narrow["kind"] == "narrow" and len(narrow["ways"]) == 2


def test_dsg_opens_in_spark_dsg(tmp_path):
    dsg = pytest.importorskip("spark_dsg")
    map = with_areas()
    path = write(map, "dsg", tmp_path / "a.json")
    graph = dsg.DynamicSceneGraph.load(str(path))
    layers = {layer.id: layer.num_nodes() for layer in graph.layers}
    assert layers == {2: 0, 3: 7 + 5, 4: 6, 5: 1}
    room = graph.get_node(dsg.NodeSymbol("R", 4).value)
    assert room.attributes.position == pytest.approx(map.rooms["centroid"][4])
    assert room.attributes.metadata.get()["storey"] == 1 and room.attributes.name == "room 4"
    assert room.attributes.bounding_box.min == pytest.approx(map.rooms["lo"][4], abs=1e-3)
    assert graph.get_node(dsg.NodeSymbol("B", 0).value).children() == {dsg.NodeSymbol("R", r).value for r in range(6)}
    assert all(node.has_parent() for node in graph.get_layer(dsg.DsgLayers.PLACES).nodes)
    door = graph.get_node(dsg.NodeSymbol("p", 7).value)  # after seven areas
    assert door.attributes.name == "door" and door.attributes.distance == pytest.approx(0.5)
    assert set(door.siblings()) == {dsg.NodeSymbol("p", 0).value, dsg.NodeSymbol("p", 2).value}
    assert graph.has_edge(dsg.NodeSymbol("R", 2).value, dsg.NodeSymbol("R", 5).value), "stairs"
    assert graph.has_edge(dsg.NodeSymbol("p", 5).value, dsg.NodeSymbol("p", 6).value), "a narrowing"
    again = tmp_path / "again.json"
    graph.save(str(again))
    ours, theirs = (json.loads(p.read_text()) for p in (path, again))
    for key in ("nodes", "edges", "layer_keys", "layer_names", "SPARK_DSG_header", "metadata"):
        said = [sorted(json.dumps(rounded(v), sort_keys=True) for v in graph[key]) for graph in (ours, theirs)]
        assert said[0] == said[1], f"{key}: written otherwise than the library writes it"


def rounded(value: Any) -> Any:
    """Without the digits that the library's float32 boxes lose."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [rounded(item) for item in value]
    return round(value, 3) + 0.0 if isinstance(value, float) else value


@pytest.mark.parametrize("make", [nothing, without_doors])
def test_dsg_of_little(tmp_path, make):
    dsg = pytest.importorskip("spark_dsg")
    graph = dsg.DynamicSceneGraph.load(str(write(make(), "dsg", tmp_path / "a.json")))
    assert graph.get_layer(dsg.DsgLayers.ROOMS).num_nodes() == len(make().rooms)


@pytest.mark.parametrize("at", [AT, GRID])
def test_ifc_holds_storeys_spaces_and_doors(tmp_path, at):
    ifcopenshell = pytest.importorskip("ifcopenshell")
    import ifcopenshell.util.element as element
    import ifcopenshell.util.placement as placement

    map = two_floors(at)
    model = ifcopenshell.open(str(write(map, "ifc", tmp_path / "a.ifc")))
    assert model.schema == "IFC4" and len(model.by_type("IfcSite")) == len(model.by_type("IfcBuilding")) == 1
    storeys = model.by_type("IfcBuildingStorey")
    assert [s.Elevation for s in storeys] == pytest.approx(map.storeys["floor"])
    spaces = model.by_type("IfcSpace")
    assert [element.get_aggregate(s).Name for s in spaces] == ["storey 0"] * 3 + ["storey 1"] * 3
    for space, room in zip(spaces, map.rooms, strict=True):
        assert element.get_psets(space)["Qto_SpaceBaseQuantities"]["GrossFloorArea"] == pytest.approx(room["area"])
        assert element.get_psets(space)["Topomerge_Room"]["Glimpsed"] == room["glimpsed"]
    doors = model.by_type("IfcDoor")
    door_edges = map.edges[map.edges["kind"] == "door"]
    for door, edge in zip(doors, door_edges, strict=True):
        assert (door.OverallWidth, door.OverallHeight) == pytest.approx((1.0, 2.0))
        matrix = placement.get_local_placement(door.ObjectPlacement)
        assert (matrix @ (0.5, 0, 0, 1))[:3] == pytest.approx(edge["centre"], abs=0.01)  # in the middle of its wall
        assert {b.RelatingSpace.Name for b in door.ProvidesBoundaries} == {f"room {r}" for r in edge["rooms"]}
    assert len(model.by_type("IfcStair")) == 1 and len(model.by_type("IfcWall")) > 0
    geometry = importlib.import_module("ifcopenshell.geom")
    settings = geometry.settings()
    settings.set("use-world-coords", True)
    plate = np.array(geometry.create_shape(settings, model.by_type("IfcStair")[0]).geometry.verts).reshape(-1, 3)
    stairs = map.edges[map.edges["kind"] == "stairs"][0]
    assert plate.min(axis=0) == pytest.approx(stairs["lower"] - (0, stairs["width"] / 2, 0.1), abs=1e-4)
    assert plate.max(axis=0) == pytest.approx(stairs["upper"] + (0, stairs["width"] / 2, 0), abs=1e-4)
    assert len({e.GlobalId for e in model.by_type("IfcRoot")}) == len(model.by_type("IfcRoot"))


def test_ifc_doors_fill_openings_that_void_walls(tmp_path):
    ifcopenshell = pytest.importorskip("ifcopenshell")
    element = importlib.import_module("ifcopenshell.util.element")
    map = topomerge.extract(two_rooms().points())
    model = ifcopenshell.open(str(write(map, "ifc", tmp_path / "a.ifc")))
    walls = build_plan_structure(map).walls
    assert len(model.by_type("IfcWall")) == len(walls) == 7
    (voids,), (fills,) = model.by_type("IfcRelVoidsElement"), model.by_type("IfcRelFillsElement")
    assert voids.RelatedOpeningElement == fills.RelatingOpeningElement and fills.RelatedBuildingElement.is_a("IfcDoor")
    carrier = int(voids.RelatingBuildingElement.Name.split()[1])
    assert sorted(walls["rooms"][carrier]) == [0, 1]
    facts = [element.get_psets(wall) for wall in model.by_type("IfcWall")]
    assert [f["Topomerge_Wall"]["FacesSeen"] for f in facts] == walls["faces"].tolist()
    assert facts[carrier]["Qto_WallBaseQuantities"]["Width"] == pytest.approx(THICK, abs=0.02)
    assert sum("Width" in f["Qto_WallBaseQuantities"] for f in facts) == 1, "the thickness of the others is a guess"
    geometry = importlib.import_module("ifcopenshell.geom")
    whole = np.hypot(*(walls["end"] - walls["start"])[carrier]) * THICK * HEIGHT
    shape = geometry.create_shape(geometry.settings(), voids.RelatingBuildingElement).geometry
    volume = importlib.import_module("ifcopenshell.util.shape").get_volume(shape)
    door = model.by_type("IfcDoor")[0]
    assert volume == pytest.approx(whole - door.OverallWidth * door.OverallHeight * THICK, rel=0.03)


def test_indoorgml_walls_are_cells_that_share_the_faces_of_rooms(tmp_path):
    map = topomerge.extract(two_rooms().points())
    root = xml.parse(write(map, "indoorgml", tmp_path / "a.gml")).getroot()
    check(root)
    cells = {cell.get(GML + "id"): cell for cell in root.iter(CORE + "CellSpace")}
    walls = {name: cell for name, cell in cells.items() if name[0] == "W"}
    assert len(cells) == len(walls) + 2 and all(cell.find(CORE + "duality") is None for cell in walls.values())
    assert all(is_closed(solid) and volume(solid) > 0 for solid in root.iter(GML + "Solid"))
    plans = {name: shapely.MultiPoint(positions(cell)[:, :2]).convex_hull for name, cell in cells.items()}
    carrier = next(k for k, wall in enumerate(build_plan_structure(map).walls) if wall["faces"] == 2)
    parts = [plans[name] for name in walls if name.split("-")[0] == f"W{carrier}"]
    assert len(parts) == 3, "beside the door, and over it"
    for name in ("C0", "C1"):
        assert min(plans[name].distance(part) for part in parts) < 1e-3
        assert max(plans[name].intersection(part).area for part in plans.values() if part is not plans[name]) < 1e-3


RULES = [pytest.param(False, id="types"), pytest.param(True, id="rules", marks=pytest.mark.slow)]  # EXPRESS takes 12 s a model


@pytest.mark.parametrize("rules", RULES)
@pytest.mark.parametrize(
    "make", [two_floors, courtyard, nothing, without_doors, doubted, lambda: topomerge.extract(two_rooms().points())]
)
def test_ifc_is_valid(tmp_path, make, rules):
    ifcopenshell = pytest.importorskip("ifcopenshell")
    validate = importlib.import_module("ifcopenshell.validate")
    model = ifcopenshell.open(str(write(make(), "ifc", tmp_path / "a.ifc")))
    log = validate.json_logger()
    validate.validate(model, log, express_rules=rules)
    assert log.statements == []


@pytest.mark.longer
@pytest.mark.parametrize("at", [AT, GRID])
def test_our_own_reader_finds_the_rooms_of_an_ifc(tmp_path, at):
    pytest.importorskip("ifcopenshell")
    map = two_floors(at)
    cloud = topomerge.read_points(write(map, "ifc", tmp_path / "a.ifc"), spacing=0.1)
    assert [r.name for r in cloud.rooms] == [f"room {r}" for r in range(6)]
    for room, rectangle in zip(cloud.rooms, rectangles(1, 2, at), strict=True):
        floor = shapely.Polygon(room.polygon)
        assert floor.intersection(rectangle).area > 0.98 * floor.union(rectangle).area
    assert [r.storey for r in cloud.rooms] == [0, 0, 0, 1, 1, 1]
    low, high = map.grid.bounds
    points = cloud.points + cloud.shift
    assert (points > low - 0.2).all() and (points < high + 0.2).all()


@pytest.mark.longer
def test_a_model_of_a_map_gives_the_map_again(tmp_path):
    pytest.importorskip("ifcopenshell")
    first = topomerge.extract(corridor().points())
    second = topomerge.extract(topomerge.read_points(write(first, "ifc", tmp_path / "a.ifc"), spacing=0.05))
    assert len(second.rooms) == len(first.rooms) == 9 and len(second.edges) == len(first.edges) == 8
    apart = np.linalg.norm(first.rooms["centroid"][:, None] - second.rooms["centroid"], axis=2).min(axis=1)
    assert (apart < 0.2).all()
    assert np.sort(second.rooms["area"]) == pytest.approx(np.sort(first.rooms["area"]), rel=0.1)


@pytest.mark.longer
def test_both_storeys_come_again_from_a_model(tmp_path):
    pytest.importorskip("ifcopenshell")
    first = topomerge.extract(stair_scene().points())
    second = topomerge.extract(topomerge.read_points(write(first, "ifc", tmp_path / "a.ifc"), spacing=0.05))
    assert [len(m.storeys) for m in (first, second)] == [2, 2]
    assert np.bincount(second.rooms["storey"]).tolist() == np.bincount(first.rooms["storey"]).tolist()


def test_heights_that_nobody_saw(tmp_path):
    ifcopenshell = pytest.importorskip("ifcopenshell")
    map = two_floors()
    rooms, edges = map.rooms.copy(), map.edges.copy()
    rooms["height"] = rooms["volume"] = edges["height"] = 0
    blind = replace(map, rooms=rooms, edges=edges)
    model = ifcopenshell.open(str(write(blind, "ifc", tmp_path / "a.ifc")))
    assert model.by_type("IfcDoor")[0].OverallHeight is None
    assert not [q for q in model.by_type("IfcPhysicalQuantity") if q.Name in ("Height", "GrossVolume")]
    check(xml.parse(write(blind, "indoorgml", tmp_path / "a.gml")).getroot())
    features = json.loads(Path(write(blind, "geojson", tmp_path / "a.geojson")).read_text())["features"]
    assert all(f["properties"]["height"] is None for f in features if f["properties"]["kind"] in ("room", "door"))
