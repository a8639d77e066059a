"""Scene graphs of Hydra: their mesh becomes points; two of them are merged; damage is told."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import topomerge as tm
from tests.fusion.plans_of import MOVE, grid_of, off, part
from tests.io.scene_graphs import box_mesh, scene_graph, write_scene_graph
from tests.scenes import Scene
from topomerge.errors import InputError
from topomerge.io import read_points


def test_the_mesh_becomes_points(tmp_path: Path) -> None:
    cloud = read_points(write_scene_graph(tmp_path / "dsg_with_mesh.json"))
    points = cloud.points + cloud.shift
    assert np.allclose(points.min(axis=0), 0, atol=1e-6) and np.allclose(points.max(axis=0), (4, 3, 2.5), atol=1e-6)
    on_a_side = np.isclose(points, 0, atol=1e-5) | np.isclose(points, (4, 3, 2.5), atol=1e-5)
    assert on_a_side.any(axis=1).all() and len(points) > 59 / 0.05**2  # 59 m2 at the usual spacing
    assert cloud.colors is None


def test_what_the_library_saves_is_read_with_its_colours(tmp_path: Path) -> None:
    dsg = pytest.importorskip("spark_dsg")
    vertices, faces = box_mesh()
    mesh, graph = dsg.Mesh(True, False, False, False), dsg.DynamicSceneGraph()
    mesh.set_vertices(np.vstack([vertices.T, np.full((3, 8), 0.5)]))
    mesh.set_faces(faces.T)
    place = dsg.PlaceNodeAttributes()
    place.position = np.array([2.0, 1.5, 1.0])
    graph.add_node(dsg.DsgLayers.PLACES, dsg.NodeSymbol("p", 0).value, place)
    graph.mesh = mesh
    graph.save(str(tmp_path / "dsg_with_mesh.json"), True)
    graph.save(str(tmp_path / "dsg.json"), False)
    cloud = read_points(tmp_path / "dsg_with_mesh.json")
    assert len(cloud) > 20_000 and np.abs(cloud.colors.astype(int) - 127).max() <= 1
    with pytest.raises(InputError, match="without a mesh.*dsg_with_mesh.json"):
        read_points(tmp_path / "dsg.json")


@pytest.mark.longer
def test_two_scene_graphs_in_one_out(tmp_path: Path) -> None:
    """Small faces around the points of two walks through one flat, in two frames."""
    dsg = pytest.importorskip("spark_dsg")
    points = Scene().shell(0, 0, 13, 9).wall((5, 0), (5, 9), doors=(2.0,)).wall((5, 5), (13, 5), doors=(4.0,)).points()
    for name, seen, frame in (("a", points, None), ("b", part(points, high=(11, 99)), MOVE)):
        centres = grid_of(seen, frame).compute_centroids()
        corners = np.array([(0.05, 0, 0), (-0.03, 0.04, 0), (-0.03, -0.04, 0.02)])
        vertices = (centres[:, None] + corners).reshape(-1, 3)
        faces = np.arange(len(vertices)).reshape(-1, 3)
        write_scene_graph(tmp_path / f"{name}.json", scene_graph(vertices, faces))
    a, b = (tm.extract(read_points(tmp_path / f"{name}.json")) for name in "ab")
    merged = tm.merge([a, b])
    assert merged.merged and off(merged.transforms[1], MOVE.inverse())[0] < 0.1
    tm.save_export(merged.map, "dsg", tmp_path / "both.json")
    graph = dsg.DynamicSceneGraph.load(str(tmp_path / "both.json"))
    assert graph.get_layer(dsg.DsgLayers.ROOMS).num_nodes() == len(merged.map.rooms) == len(a.rooms) == 3


def without(key: str) -> dict[str, Any]:
    graph = scene_graph(*box_mesh())
    del graph["mesh"][key]
    return graph


VERTICES, FACES = box_mesh()
NOWHERE = np.where(np.arange(24).reshape(8, 3) == 4, np.nan, VERTICES)


@pytest.mark.parametrize(
    ("graph", "words"),
    [
        ({"a": 1}, "neither a map of Valetudo nor a scene graph"),
        ([], "neither a map of Valetudo nor a scene graph"),
        (scene_graph(), "without a mesh"),
        (without("points"), "without a mesh"),
        (scene_graph(VERTICES, FACES + 8), "a face names a vertex that does not exist"),
        (scene_graph(VERTICES, FACES - 20), "a face names a vertex that does not exist"),
        (scene_graph(VERTICES, FACES + 0.5), "a face of its mesh names a vertex that does not exist"),
        (scene_graph(VERTICES[:, :2], FACES), "points of its mesh are no rows of three numbers"),
        (scene_graph(VERTICES, FACES, points=[[1, 2, "x"]]), "points of its mesh are no rows of three numbers"),
        (
            scene_graph(VERTICES) | {"mesh": {"points": VERTICES.tolist(), "faces": [[0, 1, 2], [1]]}},
            "faces of its mesh are no rows of three numbers",
        ),
        (scene_graph(VERTICES, FACES, colors=[{"r": 1, "g": 2}], has_colors=True), "colors of its mesh are none"),
        (scene_graph(VERTICES, FACES, colors=[{"r": 1, "g": 2, "b": 3}], has_colors=True), "8 points and 1 colors"),
        (scene_graph(1e9 * VERTICES, FACES), "triangle of"),
    ],
)
def test_damage_is_told(tmp_path: Path, graph: Any, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        read_points(write_scene_graph(tmp_path / "scene.json", graph))
    assert str(tmp_path / "scene.json") in str(caught.value) and "\n" not in str(caught.value)


def test_vertices_of_nowhere_are_left_out(tmp_path: Path) -> None:
    cloud = read_points(write_scene_graph(tmp_path / "scene.json", scene_graph(NOWHERE, FACES)))
    assert np.isfinite(cloud.points).all() and len(cloud) > 1000


def test_a_file_that_was_cut(tmp_path: Path) -> None:
    path = write_scene_graph(tmp_path / "scene.json")
    path.write_text(path.read_text()[:-40])
    with pytest.raises(InputError, match="scene.json: damaged"):
        read_points(path)


def places_graph() -> dict[str, Any]:
    """Places of two rooms of 4 by 4 m, 5 m apart, joined by a way through a door; another two rooms 3 m above."""
    graph = scene_graph()
    number = 0
    for z in (0.0, 3.0):
        names = []
        for x, clear in ((2.0, 2.0), (4.5, 0.4), (7.0, 2.0)):
            about = {"position": [x, 2.0, z], "distance": clear}
            graph["nodes"].append({"id": number, "layer": 3, "partition": 0, "attributes": about})
            names.append(number)
            number += 1
        graph["edges"] += [{"source": a, "target": b} for a, b in pairwise(names)]
    about = {"position": [2.0, 2.0, 0.5], "name": "chair", "semantic_label": 1}
    graph["nodes"].append({"id": 99, "layer": 2, "partition": 0, "attributes": about})
    return graph


def test_places_are_used_where_there_is_no_mesh(tmp_path: Path) -> None:
    cloud = read_points(write_scene_graph(tmp_path / "dsg.json", places_graph()))
    assert "has no mesh" in cloud.warnings[0] and cloud.landmarks is not None and cloud.landmarks.values == ("chair",)
    lower = cloud.points[cloud.points[:, 2] < 2.6]
    wall, floor = lower[lower[:, 2] > 0.01], lower[lower[:, 2] < 0.01]
    assert cloud.points[:, 2].max() == pytest.approx(5.5)
    np.testing.assert_allclose(wall[:, :2].min(axis=0), (-0.05, -0.05), atol=0.11)
    np.testing.assert_allclose(wall[:, :2].max(axis=0), (9.05, 4.05), atol=0.11)
    off = np.abs(np.linalg.norm(wall[:, :2] - (2, 2), axis=1) - 2)[wall[:, 0] < 3.5]
    assert off.max() < 0.2, "walls stand as far from a place as it says"
    door = (np.abs(floor[:, 0] - 4.5) < 0.06) & (np.abs(floor[:, 1] - 2.0) < 0.35)
    assert door.sum() >= 6 and not ((np.abs(wall[:, 0] - 4.5) < 0.06) & (np.abs(wall[:, 1] - 2.0) < 0.3)).any()


def test_places_that_are_none_are_passed_over(tmp_path: Path) -> None:
    graph = places_graph()
    graph["nodes"] += [{"layer": 3}, {"id": [1], "layer": 3, "attributes": {"position": [0, 0, 0]}}, 7]
    graph["nodes"] += [{"id": 50, "layer": 3, "attributes": {"position": [0, 0, float("inf")]}}]
    graph["edges"] += [{"source": 0, "target": 1234}, {"source": [0], "target": 1}, 5]
    assert len(read_points(write_scene_graph(tmp_path / "dsg.json", graph))) > 1000
    graph["nodes"] += [{"id": 51, "layer": 3, "attributes": {"position": [9e5, 9e5, 0], "distance": 1.0}}]
    with pytest.raises(InputError, match="its places span"):
        read_points(write_scene_graph(tmp_path / "dsg.json", graph))
