"""GeoJSON, GraphML and clouds: what is in them, read back with others' readers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np
import pytest
import shapely

import topomerge
from tests.io.export_maps import AT, GRID, nothing, rectangles, two_floors, without_doors
from tests.scenes import THICK, two_rooms
from tests.scenes_map import building
from topomerge.errors import InputError
from topomerge.io.exports import FORMATS, parse_formats, prepare_outputs
from topomerge.io.exports.geojson import Origin, parse_origin
from topomerge.io.points import read_points
from topomerge.types import AREA_DTYPE, TopometricMap

STRUCTURE = ("wall", "wall_opening")


def write(map: TopometricMap, name: str, path: Path, **options) -> Path:
    ((place, save),) = prepare_outputs(map, name, path, False, **options)
    assert place == path
    save(path)
    return path


def geojson(map: TopometricMap, folder: Path, **options) -> dict:
    return json.loads(write(map, "geojson", folder / "a.geojson", **options).read_text())


def test_floors_doors_and_stairs(tmp_path):
    plan = geojson(two_floors(), tmp_path)
    assert plan["type"] == "FeatureCollection" and plan["crs"] is None and "metres" in plan["topomerge"]["coordinates"]
    rooms = [f for f in plan["features"] if f["properties"]["kind"] == "room"]
    for feature, rectangle in zip(rooms, rectangles(1, 2), strict=True):
        floor = shapely.geometry.shape(feature["geometry"])
        assert floor.intersection(rectangle).area > 0.98 * floor.union(rectangle).area
        assert floor.exterior.is_ccw and floor.exterior.has_z
        assert feature["properties"]["area"] == pytest.approx(rectangle.area) and feature["properties"]["height"] == 2.9
    assert [f["properties"]["storey"] for f in rooms] == [0, 0, 0, 1, 1, 1]
    ways = [f for f in plan["features"] if f["properties"]["kind"] not in ("room", *STRUCTURE)]
    assert [f["properties"]["kind"] for f in ways] == ["door", "door", "door", "door", "stairs"]
    door = np.array(ways[0]["geometry"]["coordinates"])
    assert np.linalg.norm(door[1] - door[0]) == pytest.approx(1.0)
    assert door.mean(axis=0) == pytest.approx(two_floors().edges["centre"][0], abs=1e-3)
    assert ways[4]["properties"]["storeys"] == [0, 1] and np.ptp(
        np.array(ways[4]["geometry"]["coordinates"])[:, 2]
    ) == pytest.approx(3)


def test_walls_and_their_openings(tmp_path):
    map = topomerge.extract(two_rooms().points())
    features = geojson(map, tmp_path)["features"]
    shapes = {f["id"]: shapely.geometry.shape(f["geometry"]) for f in features}
    walls = [f for f in features if f["properties"]["kind"] == "wall"]
    assert len(walls) == 7 and all(f["properties"]["storey"] == 0 for f in walls)
    (between,) = (f for f in walls if f["properties"]["rooms"] in ([0, 1], [1, 0]))
    assert between["properties"]["thickness"] == pytest.approx(THICK, abs=0.02) and between["properties"]["faces"] == 2
    assert all(None in f["properties"]["rooms"] and f["properties"]["faces"] == 1 for f in walls if f is not between)
    (hole,) = (f for f in features if f["properties"]["kind"] == "wall_opening")
    assert hole["properties"] | {"width": 0, "height": 0} == {
        "kind": "wall_opening", "of": "door", "edge": 0, "wall": between["properties"]["wall"], "storey": 0, "rooms": [0, 1],
        "width": 0, "height": 0,
    }  # fmt: skip
    assert shapes["opening 0"].difference(shapes[between["id"]].buffer(1e-3)).is_empty
    for room in ("room 0", "room 1"):  # they share the wall's faces
        assert shapes[room].distance(shapes[between["id"]]) < 1e-3
        assert shapes[room].intersection(shapes[between["id"]]).area < 1e-2


def test_one_storey(tmp_path):
    plan = geojson(two_floors(), tmp_path, storey=1)
    assert [f["properties"]["storey"] for f in plan["features"] if f["properties"]["kind"] == "room"] == [1, 1, 1]
    assert sorted(f["properties"]["kind"] for f in plan["features"] if f["properties"]["kind"] not in ("room", *STRUCTURE)) == [
        "door",
        "door",
        "stairs",
    ]
    for wrong in (2, 7):
        with pytest.raises(InputError, match="no such storey"):
            geojson(two_floors(), tmp_path, storey=wrong)
    with pytest.raises(InputError, match="none"):
        geojson(nothing(), tmp_path, storey=0)


def radii(latitude: float) -> tuple[float, float]:
    """m of a radian northwards and eastwards, from the textbook's formulas."""
    e2, sine = 0.00669437999014, np.sin(np.radians(latitude))
    normal = 6378137.0 / np.sqrt(1 - e2 * sine**2)
    return normal * (1 - e2) / (1 - e2 * sine**2), normal * np.cos(np.radians(latitude))


@pytest.mark.longer
@pytest.mark.parametrize(("latitude", "heading"), [(0.0, 0.0), (52.52, 0.0), (-33.9, 90.0), (64.1, 237.0)])
def test_longitude_and_latitude(tmp_path, latitude, heading):
    plain = geojson(building(1), tmp_path)["features"]
    plan = geojson(building(1), tmp_path, origin=Origin(latitude, 13.37, heading))
    assert "crs" not in plan and plan["topomerge"]["origin"] == {
        "latitude": latitude,
        "longitude": 13.37,
        "heading": heading,
    }
    north, east = radii(latitude)
    turn = np.radians(heading)
    for a, b in zip(plain, plan["features"], strict=True):
        metres, degrees = (shapely.get_coordinates(shapely.geometry.shape(f["geometry"])) for f in (a, b))
        wanted_east = metres[:, 0] * np.cos(turn) + metres[:, 1] * np.sin(turn)
        wanted_north = -metres[:, 0] * np.sin(turn) + metres[:, 1] * np.cos(turn)
        assert np.radians(degrees[:, 0] - 13.37) * east == pytest.approx(wanted_east, abs=0.005)
        assert np.radians(degrees[:, 1] - latitude) * north == pytest.approx(wanted_north, abs=0.005)


def test_far_from_the_origin(tmp_path):
    # 10 km east along the plane that touches the earth at 60° is 14 m south of the parallel: tan(60°) * 10 km² / 2R.
    away = geojson(building(1, 1, (1e4, 0.0, 0.0)), tmp_path, origin=Origin(60.0, 10.0))
    middle = shapely.geometry.shape(away["features"][0]["geometry"]).centroid
    assert np.radians(middle.y - 60.0) * radii(60.0)[0] == pytest.approx(-13.54 + 2.6, abs=0.05)
    with pytest.raises(InputError, match=r"5827 km|5812 km.*national grid"):
        geojson(building(1, 1, GRID), tmp_path, origin=Origin(52.0, 13.0))


def test_origins():
    assert parse_origin("52.5,13.4") == Origin(52.5, 13.4) and parse_origin("-1, 2, 30") == Origin(-1, 2, 30)
    for wrong in ("", "52", "a,b", "1,2,3,4", "nan,0", "95,0", "0,181", "inf,0"):
        with pytest.raises(InputError, match="--origin"):
            parse_origin(wrong)


def test_a_national_grid_keeps_its_digits(tmp_path):
    plan = geojson(building(1, 1, GRID), tmp_path)
    for feature, rectangle in zip(plan["features"], rectangles(1, 1, GRID), strict=False):
        assert shapely.geometry.shape(feature["geometry"]).bounds == pytest.approx(rectangle.bounds, abs=0.11)
    assert geojson(building(1, 1, GRID), tmp_path)["features"][0]["geometry"]["coordinates"][0][0][0] > 432000


@pytest.mark.longer
@pytest.mark.parametrize("name", ["geojson", "graphml", "indoorgml", "dsg", "ply", "las", "ifc"])
def test_empty_maps_and_maps_without_doors(tmp_path, name):
    for kind, map in (("none", nothing()), ("closed", without_doors())):
        path = write(map, name, tmp_path / f"{kind}{FORMATS[name].suffixes[0]}")
        assert path.stat().st_size > 0
        again = path.read_bytes()
        write(map, name, path)
        assert path.read_bytes() == again, "the same map gives the same bytes"


GRAPHML = "{http://graphml.graphdrawing.org/xmlns}"


def with_areas() -> TopometricMap:
    topomap = two_floors()
    areas = np.zeros(7, AREA_DTYPE)
    areas["room"], areas["area"] = [0, 1, 2, 3, 4, 5, 5], 3.0
    narrow = topomap.edges[:1].copy()
    narrow["rooms"], narrow["kind"] = (5, 6), "opening"
    return replace(topomap, areas=areas, narrows=narrow)


def test_graphml(tmp_path):
    topomap = with_areas()
    root = xml.parse(write(topomap, "graphml", tmp_path / "a.graphml")).getroot()
    keys = {k.get("id"): (k.get("for"), k.get("attr.name"), k.get("attr.type")) for k in root.iter(f"{GRAPHML}key")}
    nodes = {n.get("id"): {keys[d.get("key")][1]: d.text for d in n} for n in root.iter(f"{GRAPHML}node")}
    assert len(nodes) == 2 + 6 + 7 and nodes["r4"]["kind"] == "room" and float(nodes["r4"]["area"]) == topomap.rooms["area"][4]
    assert "ceiling" in nodes["s0"] and "ceiling" not in nodes["s1"], "what was not seen is left out"
    edges = [(e.get("source"), e.get("target"), {keys[d.get("key")][1]: d.text for d in e}) for e in root.iter(f"{GRAPHML}edge")]
    assert all(a in nodes and b in nodes for a, b, _ in edges)
    kinds = [values["kind"] for _, _, values in edges]
    assert {k: kinds.count(k) for k in set(kinds)} == {"door": 4, "stairs": 1, "narrow": 1, "contains": 6 + 7}
    stairs = next(e for e in edges if e[2]["kind"] == "stairs")
    assert stairs[:2] == ("r2", "r5") and float(stairs[2]["upper_z"]) - float(stairs[2]["lower_z"]) == pytest.approx(3.0)
    assert ("a5", "a6") in [e[:2] for e in edges if e[2]["kind"] == "narrow"]


def test_graphml_in_networkx(tmp_path):
    networkx = pytest.importorskip("networkx")
    doubled = two_floors()
    doubled = replace(doubled, edges=np.concatenate([doubled.edges, doubled.edges[:1]]))
    graph = networkx.read_graphml(write(doubled, "graphml", tmp_path / "a.graphml"))
    assert graph.is_multigraph() and graph.number_of_edges("r0", "r2") == 2
    assert graph.nodes["r0"]["area"] == doubled.rooms["area"][0] and graph.nodes["r0"]["glimpsed"] is True
    rooms = graph.subgraph(n for n, kind in graph.nodes(data="kind") if kind == "room")
    assert networkx.is_connected(rooms) and len(rooms) == 6
    assert networkx.shortest_path(rooms, "r0", "r3") == ["r0", "r2", "r5", "r3"]


@pytest.mark.longer
@pytest.mark.parametrize("suffix", ["ply", "las", "laz"])
@pytest.mark.parametrize("at", [AT, GRID])
def test_clouds_read_back(tmp_path, suffix, at):
    if suffix != "ply":
        pytest.importorskip("laspy")
    map = building(1, 1, at)
    path = write(map, suffix.replace("laz", "las"), tmp_path / f"a.{suffix}")
    cloud = read_points(path)
    assert cloud.points + cloud.shift == pytest.approx(map.grid.compute_centroids(), abs=0.0011)
    assert cloud.colors is not None and len(np.unique(cloud.colors[map.room == 1], axis=0)) == 1


def test_rooms_in_las(tmp_path):
    laspy = pytest.importorskip("laspy")
    map = two_floors()
    las = laspy.read(write(map, "las", tmp_path / "a.las"))
    assert np.array_equal(las.room, map.room) and np.array_equal(las.storey, map.find_cell_storeys())
    assert str(las.header.version) == "1.4"


def test_unknown_formats():
    assert parse_formats(" GeoJSON,ros ") == ["geojson", "ros"]
    for wrong, said in (("shp", "graphml, geojson"), ("", "names no format"), ("ply,ply", "twice"), (",", "names no format")):
        with pytest.raises(InputError, match=said):
            parse_formats(wrong)


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(InputError, match=r"laspy: pip install 'topomerge\[las\]'"):
        prepare_outputs(building(1), "las", tmp_path / "a.las", False)


def test_from_python(tmp_path):
    (path,) = topomerge.save_export(two_floors(), "geojson", tmp_path / "a.geojson", storey=0, origin="52.5,13.4,30")
    assert json.loads(path.read_text())["topomerge"]["origin"]["heading"] == 30.0
    assert len(topomerge.save_export(two_floors(), "ros", tmp_path / "for" / "robots")) == 6
    for wrong in ({"name": "shp"}, {"name": "ply", "storey": 1}, {"name": "geojson", "origin": "here"}):
        with pytest.raises(InputError):
            topomerge.save_export(two_floors(), path=tmp_path / "x", **wrong)
