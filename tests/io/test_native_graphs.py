"""Scene graphs joined: layers kept, one thing once, edges and meshes follow, and the library opens it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.io.scene_graphs import box_mesh, scene_graph
from tests.io.test_native import TILTED, YAW
from topomerge.errors import InputError
from topomerge.io.native import NATIVE, Motion, Source, Tally, find_format, save_joined
from topomerge.types import transform_points

BOX = {"type": "AABB", "dimensions": [1.0, 1.0, 1.0], "world_R_center": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}}
KINDS = {2: "ObjectNodeAttributes", 3: "PlaceNodeAttributes", 4: "RoomNodeAttributes", 5: "SemanticNodeAttributes"}


def node(letter: str, number: int, layer: int, at: Any, label: int = 2**32 - 1, **more: Any) -> dict[str, Any]:
    place = [float(v) for v in at]
    about = {"type": KINDS[layer], "position": place, "name": f"{letter}{number}", "semantic_label": label, "metadata": {}}
    about |= {
        "bounding_box": {**BOX, "world_P_center": place},
        "is_active": False,
        "last_update_time_ns": 0,
        "is_predicted": False,
    }
    about |= {"color": {"r": 1, "g": 2, "b": 3, "a": 255}, "semantic_feature": {"rows": 0, "cols": 0, "data": None}}
    if layer == 2:
        about |= {"registered": False, "mesh_connections": [], "world_R_object": BOX["world_R_center"]}
    if layer == 3:
        about |= {"distance": 1.0, "num_basis_points": 1, "real_place": True, "need_cleanup": False, "active_frontier": False}
        about |= {"anti_frontier": False, "num_frontier_voxels": 0, "frontier_scale": [0.0] * 3, "pcl_mesh_connections": []}
        about |= {"orientation": BOX["world_R_center"], "voxblox_mesh_connections": [], "deformation_connections": []}
        about |= {"mesh_vertex_labels": []}
    if layer == 4:
        about |= {"semantic_class_probabilities": {}}
    return {"id": (ord(letter) << 56) | number, "layer": layer, "partition": 0, "attributes": about | more}


def edge(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    info = {"type": "EdgeAttributes", "metadata": {}, "weighted": False, "weight": 1.0}
    return {"source": a["id"], "target": b["id"], "info": info}


def flat_graph(rooms: tuple[int, ...], chair_at: float = 0.5, labels: tuple[str, ...] = ("chair", "table")) -> dict[str, Any]:
    """Rooms in a row, 5 m apart, three places in each, a chair in the first and a table in each; mesh of a box."""
    graph = scene_graph(*box_mesh())
    graph["mesh"] |= {"header": graph["SPARK_DSG_header"], "has_labels": False, "has_timestamps": False}
    graph["mesh"] |= {"has_first_seen_stamps": False, "has_colors": True, "colors": [{"r": 9, "g": 8, "b": 7, "a": 255}] * 8}
    building = node("B", 0, 5, (0, 0, 0))
    graph["nodes"], before = [building], None
    graph["layer_keys"] = [{"layer": k, "partition": 0} for k in KINDS]
    names = ("OBJECTS", "PLACES", "ROOMS", "BUILDINGS")
    graph["layer_names"] = dict(zip(names, graph["layer_keys"], strict=True))
    graph["metadata"] = {"labelspaces": {"_l2p0": [[k, word] for k, word in enumerate(labels)]}}
    for n, room in enumerate(rooms):
        own = node("R", n, 4, (5 * room, 0, 1), name=f"room {room}")
        places = [node("p", 3 * n + k, 3, (5 * room + k - 1, 0, 1)) for k in range(3)]
        table = node("O", 2 * n, 2, (5 * room, 1, 0.5), labels.index("table"), mesh_connections=[0, 7])
        graph["nodes"] += [own, *places, table]
        graph["edges"] += [edge(building, own), *(edge(own, p) for p in places), edge(places[1], table)]
        graph["edges"] += [edge(places[0], places[1]), edge(places[1], places[2])]
        if n == 0:
            chair = node("O", 99, 2, (5 * room + chair_at, -1, 0.5), labels.index("chair"))
            graph["nodes"].append(chair)
            graph["edges"].append(edge(places[1], chair))
        graph["edges"] += [edge(before, places[0])] if before else []
        before = places[2]
    return graph


def moved_back(graph: dict[str, Any], motion: Motion) -> dict[str, Any]:
    """What another robot would have seen in its own frame."""
    back = np.linalg.inv(motion.matrix)
    for one in graph["nodes"]:
        about = one["attributes"]
        for holder, key in ((about, "position"), (about["bounding_box"], "world_P_center")):
            holder[key] = transform_points(back, np.array([holder[key]]))[0].tolist()
    graph["mesh"]["points"] = transform_points(back, np.array(graph["mesh"]["points"])).tolist()
    return graph


def join(folder: Path, a: Any, b: Any, motion: Motion = YAW) -> tuple[Tally, dict[str, Any]]:
    for name, graph in (("a", a), ("b", b)):
        (folder / f"{name}.json").write_text(json.dumps(graph))
    sources = [Source(folder / "a.json"), Source(folder / "b.json", motion)]
    tally = save_joined(NATIVE["dsg"], sources, folder / "joined.json")
    return tally, json.loads((folder / "joined.json").read_text())


@pytest.mark.parametrize("motion", [YAW, TILTED], ids=["level", "tilted"])
def test_one_thing_once(tmp_path: Path, motion: Motion) -> None:
    """Rooms 0 1 2 and rooms 1 2 3: four rooms, one building; the chair of the second graph is another one than its tables."""
    tally, out = join(tmp_path, flat_graph((0, 1, 2)), moved_back(flat_graph((1, 2, 3)), motion), motion)
    assert tally.counts["rooms"] == (6, 4) and tally.counts["places"] == (18, 12)
    assert tally.counts["objects"] == (8, 6) and tally.counts["buildings"] == (2, 1)
    places = {tuple(np.round(n["attributes"]["position"], 6)) for n in out["nodes"] if n["layer"] == 4}
    assert places == {(0.0, 0.0, 1.0), (5.0, 0.0, 1.0), (10.0, 0.0, 1.0), (15.0, 0.0, 1.0)}
    ids = [n["id"] for n in out["nodes"]]
    assert len(ids) == len(set(ids))
    parents: dict[int, list[int]] = {}
    layer = {n["id"]: n["layer"] for n in out["nodes"]}
    for e in out["edges"]:
        a, b = sorted((e["source"], e["target"]), key=lambda k: -layer[k])
        if layer[a] != layer[b]:
            parents.setdefault(b, []).append(a)
    assert all(len(p) == 1 for p in parents.values()) and len(parents) == len(ids) - 1  # all but the building
    assert sum(n["attributes"]["name"] == "room 3" for n in out["nodes"]) == 1


def test_attributes_are_kept_and_meshes_follow(tmp_path: Path) -> None:
    a, b = flat_graph((0, 1)), moved_back(flat_graph((1, 2)), YAW)
    _, out = join(tmp_path, a, b)
    assert len(out["mesh"]["points"]) == 16 and max(max(f) for f in out["mesh"]["faces"]) == 15
    np.testing.assert_allclose(out["mesh"]["points"][8:], YAW.move_points(np.array(b["mesh"]["points"])), atol=1e-9)
    tables = {
        round(n["attributes"]["position"][0]): n["attributes"] for n in out["nodes"] if n["attributes"]["name"] in ("O0", "O2")
    }
    assert tables[5]["mesh_connections"] == [0, 7, 8, 15] and tables[10]["mesh_connections"] == [8, 15]
    assert tables[5]["metadata"]["merged"].keys() == {"b.json"} and not tables[10]["metadata"]
    box = tables[10]["bounding_box"]
    assert box["type"] == "RAABB" and box["dimensions"] == [1.0, 1.0, 1.0]
    assert box["world_R_center"]["z"] == pytest.approx(np.sin(0.35)) and tables[0]["bounding_box"] == {
        **BOX,
        "world_P_center": [0.0, 1.0, 0.5],
    }


def test_classes_are_shared_by_their_names(tmp_path: Path) -> None:
    b = moved_back(flat_graph((1,), labels=("lamp", "table", "chair")), YAW)
    tally, out = join(tmp_path, flat_graph((1,)), b)
    assert tally.counts["objects"] == (4, 2)
    assert out["metadata"]["labelspaces"]["_l2p0"] == [[0, "chair"], [1, "table"], [3, "lamp"]]


def test_things_apart_stay_apart(tmp_path: Path) -> None:
    tally, _ = join(tmp_path, flat_graph((0,)), moved_back(flat_graph((0,), chair_at=1.5), YAW))
    assert tally.counts["objects"] == (4, 3)


def test_the_library_opens_it(tmp_path: Path) -> None:
    dsg = pytest.importorskip("spark_dsg")
    tally, _ = join(tmp_path, flat_graph((0, 1, 2)), moved_back(flat_graph((1, 2, 3)), YAW))
    graph = dsg.DynamicSceneGraph.load(str(tmp_path / "joined.json"))
    names = {"objects": "OBJECTS", "places": "PLACES", "rooms": "ROOMS", "buildings": "BUILDINGS"}
    for name, layer in names.items():
        assert graph.get_layer(getattr(dsg.DsgLayers, layer)).num_nodes() == tally.counts[name][1]
    assert graph.num_edges() == tally.counts["links"][1] and graph.mesh.num_vertices() == 16
    graph.save(str(tmp_path / "again.json"), True)
    sources = [Source(tmp_path / "again.json"), Source(tmp_path / "b.json", YAW)]
    again = save_joined(NATIVE["dsg"], sources, tmp_path / "more.json")
    assert again.counts["rooms"] == (7, 4)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda g: g["nodes"].append(g["nodes"][0]), "twice"),
        (lambda g: g["edges"].append({"source": 1, "target": 2}), "does not exist"),
        (lambda g: g["nodes"][0]["attributes"].update(position=[0, 0, float("nan")]), "has no place"),
        (lambda g: g["nodes"].append(7), "damaged"),
        (lambda g: g.update(mesh=5), "mesh is none"),
        (lambda g: g["nodes"][2]["attributes"].update(bounding_box={"type": "AABB"}), "a.json or .*b.json: damaged"),
        (lambda g: g["mesh"].update(points=[["x", 0, 0]]), "a.json or .*b.json: damaged"),
        (lambda g: g["SPARK_DSG_header"]["version"].update(major=7), "another version"),
    ],
)
def test_damage_is_told(tmp_path: Path, change: Any, told: str) -> None:
    graph = flat_graph((0,))
    change(graph)
    with pytest.raises(InputError, match=told):
        join(tmp_path, flat_graph((0,)), graph)
    assert not (tmp_path / "joined.json").exists()


def test_other_json_is_no_scene_graph(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"type": "FeatureCollection"}')
    (tmp_path / "b.json").write_text("[")
    assert find_format(tmp_path / "a.json") is None and find_format(tmp_path / "b.json") is None
