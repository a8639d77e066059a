"""ROS grids read back with our own reader, and routes that a robot could drive."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
import yaml
from PIL import Image

import topomerge
from tests.io.export_maps import AT, GRID, nothing, stair_scene, two_floors, without_doors
from tests.scenes import Scene, corridor
from tests.scenes_map import building
from topomerge.errors import InputError
from topomerge.io.exports import prepare_outputs
from topomerge.io.points import read_points
from topomerge.types import TopometricMap, build_landmarks


def write(map: TopometricMap, folder: Path, **options) -> dict[str, Path]:
    files = prepare_outputs(map, "ros", folder, False, **options)
    folder.mkdir(exist_ok=True)
    for path, save in files:
        save(path)
    return {path.name: path for path, _ in files}


class Grid:
    """A map_server grid as its documentation reads it: free and occupied by place, m."""

    def __init__(self, path: Path) -> None:
        about = yaml.safe_load(path.read_text())
        self.image = np.array(Image.open(path.parent / about["image"]))
        self.low, self.size = np.array(about["origin"][:2]), about["resolution"]
        assert about["negate"] == 0 and set(np.unique(self.image)) <= {0, 205, 254}

    def at(self, points: np.ndarray) -> np.ndarray:
        """(n,) values at points (n, 2)."""
        i, j = np.floor((points - self.low) / self.size).astype(int).T
        return self.image[self.image.shape[0] - 1 - j, i]


@pytest.mark.parametrize("at", [AT, GRID])
def test_walls_stand_where_they_were(tmp_path, at):
    map = building(2, 1, at)
    files = write(map, tmp_path / "ros")
    assert sorted(files) == ["storey_0.pgm", "storey_0.yaml", "storey_0_route.geojson"]
    cloud = read_points(files["storey_0.yaml"])
    points = (cloud.points + cloud.shift).astype(np.float64)
    height = map.grid.compute_centroids()[:, 2] - map.storeys["floor"][0]
    walls = map.grid.compute_centroids()[(height > 0.5) & (height < 1.5)][:, :2]
    read = np.unique(np.round(points[points[:, 2] > 0.5][:, :2], 2), axis=0)
    expected = np.unique(np.round(walls, 2), axis=0)
    assert {tuple(p) for p in read.tolist()} == {tuple(p) for p in expected.tolist()}
    grid = Grid(files["storey_0.yaml"])
    assert (grid.at(map.navigable.compute_centroids()[:, :2]) == 254).all(), "all of the floor is free"
    assert (grid.image == 205).any(), "what nobody saw is unknown"


@pytest.mark.longer
def test_turned_buildings_and_the_way_back(tmp_path):
    c, s = np.cos(0.4), np.sin(0.4)
    points = corridor().points() @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + (30.0, -20.0, 5.0)
    first = topomerge.extract(points.astype(np.float32))
    files = write(first, tmp_path / "ros")
    again = topomerge.extract(read_points(files["storey_0.yaml"], extrude=2.5))
    assert len(again.rooms) == len(first.rooms) == 9
    apart = np.linalg.norm(first.rooms["centroid"][:, None, :2] - again.rooms["centroid"][:, :2], axis=2).min(axis=1)
    assert (apart < 0.25).all()


def route(path: Path) -> tuple[dict[int, dict], list[dict]]:
    """Nodes by number and edges of a file, checked as nav2_route's loader needs them."""
    features = json.loads(path.read_text())["features"]
    nodes = {f["properties"]["id"]: f for f in features if f["geometry"]["type"] == "Point"}
    edges = [f for f in features if f["geometry"]["type"] == "MultiLineString"]
    ids = [f["properties"]["id"] for f in features]
    assert nodes and edges and len(nodes) + len(edges) == len(features) == len(set(ids)) and min(ids) >= 0
    assert all(f["properties"]["frame"] == "map" for f in nodes.values())
    for edge in edges:
        ends = [nodes[edge["properties"][end]]["geometry"]["coordinates"] for end in ("startid", "endid")]
        assert edge["geometry"]["coordinates"] == [ends] and ends[0] != ends[1]
        assert edge["properties"]["cost"] == pytest.approx(np.hypot(*np.subtract(*ends)), abs=1e-3)
    pairs = {(e["properties"]["startid"], e["properties"]["endid"]) for e in edges}
    assert pairs == {(b, a) for a, b in pairs} and len(pairs) == len(edges), "both directions, each once"
    return nodes, edges


def free_ways(path: Path, grid: Grid) -> bool:
    """Do all edges run over free pixels?"""
    _, edges = route(path)
    t = np.linspace(0, 1, 200)[:, None]
    for edge in edges:
        a, b = np.array(edge["geometry"]["coordinates"][0])
        if not (grid.at(a + t * (b - a)) == 254).all():
            return False
    return True


def kinds(nodes: dict[int, dict]) -> dict[str, int]:
    kinds_of_nodes = [node["properties"]["metadata"]["kind"] for node in nodes.values()]
    return {kind: kinds_of_nodes.count(kind) for kind in set(kinds_of_nodes) - {"way"}}


def joined(nodes: dict[int, dict], edges: list[dict]) -> bool:
    beside: dict[int, set[int]] = {n: set() for n in nodes}
    for edge in edges:
        beside[edge["properties"]["startid"]].add(edge["properties"]["endid"])
    seen, ahead = set(), [next(iter(nodes))]
    while ahead:
        at = ahead.pop()
        if at not in seen:
            seen.add(at)
            ahead += beside[at]
    return seen == set(nodes)


@pytest.mark.longer
def test_routes_lead_from_room_to_room_without_walls_between(tmp_path):
    for name, map in (("hand", building(3)), ("seen", topomerge.extract(corridor().points()))):
        files = write(map, tmp_path / name)
        grid = Grid(files["storey_0.yaml"])
        nodes, edges = route(files["storey_0_route.geojson"])
        doors = int((map.edges["kind"] == "door").sum())
        assert kinds(nodes) == {"room": len(map.rooms), "door": doors} | (
            {"opening": len(map.edges) - doors} if doors < len(map.edges) else {}
        )
        assert joined(nodes, edges) and free_ways(files["storey_0_route.geojson"], grid)
        assert len(nodes) < 60, "straight ways have no nodes in between"


def test_around_corners(tmp_path):
    """An L-shaped room: the straight line from its middle to the door would cross the wall."""
    scene = Scene().shell(0, 0, 10, 10)
    scene.wall((3, 0), (3, 7)).wall((3, 7), (10, 7)).wall((7, 0), (7, 7), doors=(2.0,)).wall((0, 2), (3, 2), doors=(1.5,))
    files = write(topomerge.extract(scene.points()), tmp_path / "ros")
    assert free_ways(files["storey_0_route.geojson"], Grid(files["storey_0.yaml"]))


@pytest.mark.longer
def test_stairs_are_no_floor_for_robots(tmp_path):
    map = topomerge.extract(stair_scene().points())
    assert len(map.storeys) == 2 and "stairs" in map.edges["kind"].tolist()
    files = write(map, tmp_path / "ros")
    steps = np.array([[x, 7.4] for x in np.arange(2.6, 4.0, 0.1)])
    assert (Grid(files["storey_0.yaml"]).at(steps) == 0).all()
    ends, seen = [], set()
    for s in (0, 1):
        nodes, edges = route(files[f"storey_{s}_route.geojson"])
        assert not seen & set(nodes) and joined(nodes, edges)
        assert free_ways(files[f"storey_{s}_route.geojson"], Grid(files[f"storey_{s}.yaml"]))
        seen |= set(nodes) | {e["properties"]["id"] for e in edges}
        ends += [n for n in nodes.values() if n["properties"]["metadata"]["kind"] == "stairs"]
    assert [e["properties"]["metadata"]["to_storey"] for e in ends] == [1, 0]
    foot, head = (np.array(e["geometry"]["coordinates"]) for e in ends)
    assert foot[0] < 2.3 and 6.8 < foot[1] < 8 and head[0] > 6.5 and 6.8 < head[1] < 8


def test_a_threshold_and_a_ramp_are_floor(tmp_path):
    from tests.scenes import ramp

    files = write(topomerge.extract(ramp().points()), tmp_path / "ros")
    assert (Grid(files["storey_0.yaml"]).at(np.array([[x, 1.0] for x in np.arange(0.5, 15.5, 0.1)])) == 254).mean() > 0.97


def test_maps_with_little_in_them(tmp_path):
    with pytest.raises(InputError, match="no storeys"):
        write(nothing(), tmp_path / "none")
    assert sorted(write(without_doors(), tmp_path / "closed")) == ["storey_0.pgm", "storey_0.yaml"]
    assert sorted(write(two_floors(), tmp_path / "upper", storey=1)) == [
        "storey_1.pgm",
        "storey_1.yaml",
        "storey_1_route.geojson",
    ]
    with pytest.raises(InputError, match="no such storey"):
        write(two_floors(), tmp_path / "top", storey=2)


def test_the_same_map_gives_the_same_bytes(tmp_path):
    a, b = (write(two_floors(), tmp_path / name) for name in ("a", "b"))
    assert {n: p.read_bytes() for n, p in a.items()} == {n: p.read_bytes() for n, p in b.items()}


def write_rmf(map: TopometricMap, folder: Path, **options: int) -> tuple[dict, dict]:
    """The building and the navigation graph, parsed by PyYAML."""
    files = prepare_outputs(map, "rmf", folder, False, **options)
    folder.mkdir(exist_ok=True)
    for path, save in files:
        save(path)
    building, graph = (yaml.safe_load(path.read_text()) for path, _ in files)
    assert [path.name for path, _ in files] == ["building_rmf.building.yaml", "building_rmf_nav.yaml"]
    return building, graph


def test_lanes_of_rmf_are_the_ways_of_nav2(tmp_path):
    """One graph in two files: the same places, joined alike; the lanes of the second lead one way each."""
    map = building(3, 1)
    write(map, tmp_path / "ros")
    site, graph = write_rmf(map, tmp_path / "rmf")
    routes = json.loads((tmp_path / "ros" / "storey_0_route.geojson").read_text())["features"]
    place = {f["properties"]["id"]: tuple(f["geometry"]["coordinates"]) for f in routes if f["geometry"]["type"] == "Point"}
    ways = {
        frozenset((place[f["properties"]["startid"]], place[f["properties"]["endid"]]))
        for f in routes
        if "startid" in f["properties"]
    }
    level = site["levels"]["L1"]
    assert site["coordinate_system"] == "cartesian_meters"
    lanes = {frozenset(tuple(level["vertices"][k][:2]) for k in lane[:2]) for lane in level["lanes"]}
    assert lanes == ways and all(lane[2]["bidirectional"] == [4, True] for lane in level["lanes"])
    nav = graph["levels"]["L1"]
    both = [(tuple(nav["vertices"][a][:2]), tuple(nav["vertices"][b][:2])) for a, b, _ in nav["lanes"]]
    assert {frozenset(pair) for pair in both} == ways and {pair[::-1] for pair in both} == set(both)
    doors = [edge for edge in map.edges if edge["kind"] == "door"]
    assert len(level["doors"]) == len(graph["doors"]) == len(doors) > 0
    for (a, b, about), edge in zip(level["doors"], doors, strict=True):
        ends = np.array([level["vertices"][k][:2] for k in (a, b)])
        np.testing.assert_allclose(ends.mean(axis=0), edge["centre"][:2], atol=1e-3)
        assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(edge["width"], abs=1e-3)
        normal = (np.cos(edge["direction"]), np.sin(edge["direction"]))
        assert abs((ends[1] - ends[0]) @ normal) < 1e-3
        assert graph["doors"][about["name"][1]]["endpoints"] == ends.tolist()
    outlines = [np.array([level["vertices"][k][:2] for k in floor["vertices"]]) for floor in level["floors"]]
    areas = [shapely.Polygon(outline).area for outline in outlines]
    assert sum(areas) == pytest.approx(float(map.rooms["area"].sum()), rel=0.15)


def test_lifts_of_rmf_are_rooms_that_are_called_so(tmp_path):
    map = named_lifts()
    site, graph = write_rmf(map, tmp_path / "rmf")
    assert list(site["lifts"]) == list(graph["lifts"]) == ["lift_0"]
    lift = site["lifts"]["lift_0"]
    assert (lift["lowest_floor"], lift["highest_floor"]) == ("L1", "L2") and set(lift["level_doors"]) <= {"L1", "L2"}
    cabins = [v for level in site["levels"].values() for v in level["vertices"] if len(v) == 5]
    assert [v[4]["lift_cabin"] for v in cabins] == [[1, "lift_0"]] * 2
    only, _ = write_rmf(map, tmp_path / "one", storey=1)
    assert list(only["levels"]) == ["L2"]
    with pytest.raises(InputError, match="no such storey"):
        prepare_outputs(map, "rmf", tmp_path, False, storey=9)
    with pytest.raises(InputError, match="no storeys"):
        prepare_outputs(nothing(), "rmf", tmp_path, False)


def named_lifts() -> TopometricMap:
    """Two storeys in which two rooms above each other are called lift."""
    map = two_floors()
    low, high = (np.flatnonzero(map.rooms["storey"] == storey) for storey in (0, 1))
    middle = map.rooms["centroid"][:, :2]
    rooms = next([a, b] for a in low for b in high if np.linalg.norm(middle[a] - middle[b]) < 1.0)
    marks = build_landmarks("name", ["Lift A", "lift"], "hand", map.rooms["centroid"][rooms], room=np.array(rooms))
    return replace(map, landmarks=marks)
