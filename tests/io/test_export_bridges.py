"""Maps for robots of ROS 2: markers in a bag, masks of where not to go, frames; each read by other hands."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from PIL import Image

import topomerge as tm
from tests.scenes_map import building
from topomerge.errors import InputError
from topomerge.io.exports.placements import FramePose, read_frame_poses
from topomerge.types import Sim3, TopometricMap


def markers(path: Path) -> dict[str, list]:
    """The markers of each topic, as rosbags reads them."""
    highlevel = pytest.importorskip("rosbags.highlevel")
    with highlevel.AnyReader([path]) as bag:
        qos = [c.ext.offered_qos_profiles[0] for c in bag.connections]
        assert all(q.durability.name == "TRANSIENT_LOCAL" and q.reliability.name == "RELIABLE" for q in qos)
        return {c.topic: list(bag.deserialize(raw, c.msgtype).markers) for c, _, raw in bag.messages()}


def test_markers_are_the_rooms_and_doors(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    map = building(2, 2)
    (path,) = tm.save_export(map, "rviz", tmp_path / "map.mcap")
    topics = markers(path)
    assert sorted(topics) == [f"/topomerge/{name}" for name in ("doors", "graph", "names", "rooms")]
    rooms = topics["/topomerge/rooms"]
    assert [m.ns for m in rooms] == [f"storey_{s}" for s in map.rooms["storey"]]
    assert {m.header.frame_id for listed in topics.values() for m in listed} == {"map"}
    for r, marker in enumerate(rooms):
        points = np.array([(p.x, p.y, p.z) for p in marker.points])
        assert np.array_equal(points, map.navigable.compute_centroids()[map.navigable_room == r])
        assert marker.type == marker.CUBE_LIST and marker.scale.x == map.navigable.edge and marker.color.a > 0
    for marker, edge in zip(topics["/topomerge/doors"], map.edges, strict=True):
        a, b = (np.array((p.x, p.y)) for p in marker.points)
        assert np.allclose((a + b) / 2, edge["centre"][:2]) and np.linalg.norm(a - b) == pytest.approx(edge["width"])
    for listed in topics.values():
        assert len({(m.ns, m.id) for m in listed}) == len(listed), "RViz tells markers by namespace and number"


def test_shut_doors_are_red(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    map = building(2, 1)
    edges = map.edges.copy()
    edges["open"][0] = False
    shut, *others = markers(tm.save_export(replace(map, edges=edges), "rviz", tmp_path / "a.mcap")[0])["/topomerge/doors"]
    assert shut.color.r > 0.7 > 0.3 > max(shut.color.g, *(m.color.r for m in others))


def test_the_same_map_gives_the_same_bag(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    first, again = (tm.save_export(building(2, 1), "rviz", tmp_path / name)[0].read_bytes() for name in ("a.mcap", "b.mcap"))
    assert first == again


def outdoors(map: TopometricMap, *rooms: int) -> TopometricMap:
    table = map.rooms.copy()
    table["outside"][list(rooms)] = 0.8
    return replace(map, rooms=table)


def test_robots_are_kept_out_of_what_is_outside(tmp_path: Path) -> None:
    map = outdoors(building(2, 1), 1)
    files = {p.name: p for p in tm.save_export(map, "ros", tmp_path / "ros")}
    assert sorted(files) == sorted(
        ["storey_0.pgm", "storey_0.yaml", "storey_0_keepout.pgm", "storey_0_keepout.yaml", "storey_0_route.geojson"]
    )
    about, grid = (yaml.safe_load(files[name].read_text()) for name in ("storey_0_keepout.yaml", "storey_0.yaml"))
    assert {**about, "image": ""} == {**grid, "image": ""} and about["image"] == "storey_0_keepout.pgm"
    image = np.array(Image.open(files["storey_0_keepout.pgm"]))
    assert set(np.unique(image)) == {0, 254}
    low, size = np.array(about["origin"][:2]), about["resolution"]
    i, j = np.floor((map.navigable.compute_centroids()[:, :2] - low) / size).astype(int).T
    value = image[len(image) - 1 - j, i]
    assert (value[map.navigable_room == 1] == 0).all() and (value[map.navigable_room != 1] == 254).all()


def test_no_mask_where_all_is_indoors(tmp_path: Path) -> None:
    assert not [p for p in tm.save_export(building(2, 1), "ros", tmp_path / "ros") if "keepout" in p.name]


def listing(**values: object) -> dict:
    """A merge of two maps, as far as it is needed."""
    pose = Sim3(0.6, (4.0, -2.0, 0.5))
    entry = {"into": 0, "matrix": pose.matrix.tolist(), "scale": 1.0, "yaw_deg": float(np.degrees(0.6))}
    maps = [{"source": "scans/robot 1.ply"}, {"source": "scans/b.bag.zip"}]
    return {"maps": maps, "transforms": {"1": entry}} | values


def merged(folder: Path, about: object) -> Path:
    folder.mkdir()
    (folder / "merge.json").write_text(json.dumps(about))
    return folder


def published(path: Path) -> list[dict[str, str]]:
    """The arguments of each publisher."""
    nodes = ElementTree.parse(path).getroot().findall("node")
    assert all((n.get("pkg"), n.get("exec")) == ("tf2_ros", "static_transform_publisher") for n in nodes)
    words = [n.get("args", "").split() for n in nodes]
    return [dict(zip([w.removeprefix("--") for w in ws[::2]], ws[1::2], strict=True)) for ws in words]


def test_frames_are_where_the_merge_laid_them(tmp_path: Path) -> None:
    transforms = read_frame_poses(merged(tmp_path / "merged", listing()))
    (path,) = tm.save_export(building(2, 1), "tf2", tmp_path / "a.launch.xml", transforms=transforms)
    (said,) = published(path)
    assert (said["frame-id"], said["child-frame-id"]) == ("robot_1", "b")
    x, y, z, w = (float(said[f"q{axis}"]) for axis in "xyzw")
    turn = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w)], [2 * (x * y + z * w), 1 - 2 * (x * x + z * z)]])
    point = np.array([3.0, 7.0])
    there = turn @ point + (float(said["x"]), float(said["y"]))
    assert np.allclose(there, Sim3(0.6, (4.0, -2.0, 0.5)).apply(np.array([[*point, 0.0]]))[0, :2])
    assert float(said["z"]) == 0.5 and np.isclose(x * x + y * y + z * z + w * w, 1.0)


def test_names_of_frames(tmp_path: Path) -> None:
    folder = merged(tmp_path / "merged", listing())
    assert [(t.parent, t.child) for t in read_frame_poses(folder, ["robot_1/map", "robot_2/map"])] == [
        ("robot_1/map", "robot_2/map")
    ]
    same = merged(tmp_path / "same", listing(maps=[{"source": "one/a.ply"}, {"source": "two/a.ply"}]))
    assert [(t.parent, t.child) for t in read_frame_poses(same)] == [("map_0", "map_1")]
    for names, words in (
        (["a"], "1 names, but there are 2 maps"),
        (["a", "b c"], "no name of a frame"),
        (["a", "a"], "one name"),
    ):
        with pytest.raises(InputError, match=words):
            read_frame_poses(folder, names)


@pytest.mark.parametrize("about", [{}, [], {"maps": 3}, listing(transforms={"1": {"into": 7}}), listing(transforms={"x": {}})])
def test_a_damaged_listing_is_refused(tmp_path: Path, about: object) -> None:
    folder = merged(tmp_path / "merged", about)
    with pytest.raises(InputError, match=r"merge\.json: damaged"):
        read_frame_poses(folder)


def test_what_has_no_transform_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is no folder of a merge or an atlas"):
        read_frame_poses(tmp_path)
    with pytest.raises(InputError, match="needs to know where maps lie"):
        tm.save_export(building(2, 1), "tf2", tmp_path / "a.xml")
    larger = [FramePose("a", "b", Sim3(0.0, (0.0, 0.0, 0.0), 1.25))]
    with pytest.raises(InputError, match=r"can't scale; read it again with --scale 1\.25"):
        tm.save_export(building(2, 1), "tf2", tmp_path / "a.xml", transforms=larger)
    assert not (tmp_path / "a.xml").exists()
