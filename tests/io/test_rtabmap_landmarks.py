"""What RTAB-Map databases hold beside points: tags, labels, radio and pressure, and signs on their pictures."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.cases import list_longer
from tests.io.rgbd import CAMERA, camera_poses, looking
from tests.io.rtabmap_bases import OPTICAL, XYZ, Node, camera_bytes, packed, png, scan_info_bytes, write_rtabmap
from tests.io.signs import SIGNS, TAG_SIGNS, poses_before_signs, take_picture, walk_poses
from tests.io.test_read_folders import refused
from tests.io.test_read_rtabmap import SHIFT, depth_nodes, scan_nodes
from tests.io.test_read_signs import assert_hang
from tests.io.walks import room_walk
from topomerge.io import pictures, read_points
from topomerge.types import Landmarks


def landmarks_of(path: Path) -> Landmarks:
    found = read_points(path).landmarks
    return Landmarks() if found is None else found


def picture_nodes(poses: np.ndarray) -> list[Node]:
    """The corridor of signs as a camera of depth on a robot sees it."""
    nodes = []
    for pose in poses:
        image, depth = take_picture(pose)
        stream = BytesIO()
        Image.fromarray(image).save(stream, "JPEG", quality=95)
        millimetres = np.rint(depth * 1000).astype(np.uint16)
        calibration = camera_bytes("0.23.0", [OPTICAL], CAMERA)
        nodes.append(Node(pose @ np.linalg.inv(OPTICAL), png(millimetres), stream.getvalue(), calibration))
    return nodes


def test_tags_stand_where_the_graph_puts_them(tmp_path: Path) -> None:
    """Of several sightings one tag; its family is that of the dictionary."""
    tag = looking(1.6, (2.0, 2.9, 1.5))  # its z is level
    nodes = depth_nodes(camera_poses())
    nodes = [replace(n, tags=[(7, np.linalg.inv(n.pose) @ tag)]) for n in nodes]
    found = landmarks_of(write_rtabmap(tmp_path / "a.db", nodes, parameters="Kp/MaxFeatures:500;Marker/Dictionary:20;Mem/x:1"))
    assert found.get_values().tolist() == ["tag36h11:7"] and found.is_kind("tag").all()
    assert found.table["position"][0] == pytest.approx(tag[:3, 3], abs=1e-5)
    towards = np.array([np.cos(found.table["number"][0]), np.sin(found.table["number"][0])])
    assert abs(towards @ tag[:2, 2]) > 0.99 and towards @ (nodes[0].pose[:2, 3] - tag[:2, 3]) > 0
    moved = SHIFT @ tag
    path = write_rtabmap(tmp_path / "a.db", nodes, "0.20.0", [SHIFT @ n.pose for n in nodes], (7, moved))
    found = landmarks_of(path)
    assert found.get_values().tolist() == ["tag:7"]
    assert found.table["position"][0] == pytest.approx(moved[:3, 3], abs=1e-5)


def test_labels_are_names(tmp_path: Path) -> None:
    nodes = depth_nodes(camera_poses())
    named = [replace(nodes[0], label="Kitchen\x1b[2J"), replace(nodes[1], label="map0"), replace(nodes[2], label="")]
    found = landmarks_of(write_rtabmap(tmp_path / "a.db", named))
    assert found.get_values().tolist() == ["Kitchen [2J"] and found.is_kind("name").all()
    assert found.table["position"][0] == pytest.approx(nodes[0].pose[:3, 3], abs=1e-5)


def test_radio_and_pressure_of_nodes(tmp_path: Path) -> None:
    """As sensors of nodes, and WiFi as user data; what is no reading is left out."""
    nodes = depth_nodes(camera_poses())
    nodes[0] = replace(nodes[0], sensors=[(1, -61.0, 5.0), (3, 1013.2, 5.1), (2, 21.0, 5.0), (3, np.nan, 5.0), (1, 40.0, 5.0)])
    nodes[1] = replace(nodes[1], user_data=packed(np.array([[-70.0, 6.0]])))
    nodes[2] = replace(nodes[2], user_data=packed(np.array([[3.0, 6.0]])))
    found = landmarks_of(write_rtabmap(tmp_path / "a.db", nodes))
    radio, pressure = (found.select(found.is_kind(kind)) for kind in ("radio", "pressure"))
    assert radio.table["number"].tolist() == [-61.0, -70.0] and radio.table["time"].tolist() == [5.0, 6.0]
    assert set(radio.get_values()) == {""}  # of which sender RTAB-Map does not say
    assert radio.table["position"] == pytest.approx(np.array([n.pose[:3, 3] for n in nodes[:2]]), abs=1e-5)
    assert pressure.table["number"].tolist() == [1013.2] and radio.table["group"].tolist() == [1, 2]


@pytest.mark.longer
@pytest.mark.parametrize("laser", [False, *list_longer(True)])
def test_signs_on_pictures_of_nodes(tmp_path: Path, laser: bool) -> None:
    """Also where the points are those of a laser."""
    pytest.importorskip("rapidocr_onnxruntime", exc_type=ImportError)
    pytest.importorskip("pupil_apriltags", exc_type=ImportError)
    nodes = picture_nodes(poses_before_signs())
    if laser:
        points, info = room_walk().scans[0].astype("<f4")[None], scan_info_bytes("0.23.0", XYZ, np.eye(4))
        nodes = [replace(n, scan=packed(points), scan_info=info) for n in nodes]
    cloud = read_points(write_rtabmap(tmp_path / "a.db", nodes))
    assert_hang(cloud.landmarks, SIGNS + TAG_SIGNS)
    assert (len(cloud) > 50_000) != laser


def test_nodes_that_are_not_due_are_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a laser's recording without an option the pictures cost what is read of them."""
    monkeypatch.setattr(pictures, "load_text_reader", lambda: lambda image: [])
    nodes = picture_nodes(np.stack([walk_poses(2)[0]] * 4))
    points, info = room_walk().scans[0].astype("<f4")[None], scan_info_bytes("0.23.0", XYZ, np.eye(4))
    nodes = [replace(n, scan=packed(points), scan_info=info) for n in nodes]
    nodes[2:] = [replace(n, depth=b"no image at all") for n in nodes[2:]]
    assert len(read_points(write_rtabmap(tmp_path / "a.db", nodes))) > 100


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE Node SET env_sensors = 'x' || hex(zeroblob(40))",
        "UPDATE Data SET user_data = hex(zeroblob(20))",
        "UPDATE Link SET transform = 'pose'",
    ],
)
def test_damaged_landmarks_are_refused(tmp_path: Path, change: str) -> None:
    nodes = [replace(n, tags=[(1, np.eye(4))]) for n in depth_nodes(camera_poses())]
    path = write_rtabmap(tmp_path / "a.db", nodes)
    with closing(sqlite3.connect(path)) as base:
        base.execute(change)
        base.commit()
    assert "text or a number where bytes belong" in refused(path)


def test_odd_landmarks_are_left_out(tmp_path: Path) -> None:
    """Links to nodes that are not there, of null poses, to tags that are none; labels that are no text; a table that computes."""
    nodes = [replace(n, tags=[(1, np.zeros((4, 4))), (-3, np.eye(4))]) for n in depth_nodes(camera_poses())]
    path = write_rtabmap(tmp_path / "a.db", nodes, parameters="Marker/Dictionary:999999")
    with closing(sqlite3.connect(path)) as base:
        base.execute("INSERT INTO Link VALUES (99, -4, 8, x'', ?)", (np.eye(4)[:3].astype("<f4").tobytes(),))
        base.execute("UPDATE Node SET label = x'00ff', env_sensors = x'00'")
        base.execute("UPDATE Info SET parameters = 5")
        base.commit()
    assert len(landmarks_of(path)) == 0
    with closing(sqlite3.connect(path)) as base:
        base.execute("DROP TABLE Link")
        base.execute("CREATE TABLE Link (from_id INTEGER, to_id INTEGER, type INTEGER, transform BLOB AS (zeroblob(1 << 20)))")
        base.execute("INSERT INTO Link(from_id, to_id, type) VALUES (1, -1, 8)")
        base.commit()
    assert len(landmarks_of(path)) == 0


def test_walks_of_a_laser_have_none(tmp_path: Path) -> None:
    assert read_points(write_rtabmap(tmp_path / "a.db", scan_nodes(room_walk()))).landmarks is None
