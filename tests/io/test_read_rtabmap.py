"""RTAB-Map databases of several versions: scans and depth images where the graph puts them, and what can be wrong."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from tests.io.rgbd import CAMERA, COLOR, SHAPE, camera_poses, color_image, depth_image, write_tum_images
from tests.io.rtabmap_bases import (
    LASER,
    OPTICAL,
    XY,
    XYZ,
    XYZI,
    XYZRGB,
    Node,
    camera_bytes,
    packed,
    png,
    scan_info_bytes,
    stereo_bytes,
    write_rtabmap,
)
from tests.io.test_read_folders import assert_same, refusal_of, refused
from tests.io.walks import Walk, room_walk
from topomerge.io import read_chunks, read_points

VERSIONS = ("0.11.10", "0.16.1", "0.17.0", "0.18.0", "0.20.0", "0.23.0")
SHIFT = np.array([[1.0, 0, 0, 5], [0, 1, 0, -3], [0, 0, 1, 1], [0, 0, 0, 1]])  # of the odometry to what was optimised


@pytest.fixture
def walk() -> Walk:
    return room_walk()


def scan_nodes(walk: Walk, version: str = "0.23.0", form: int = XYZ, poses: Sequence[np.ndarray] | None = None) -> list[Node]:
    """The walk with a laser on a robot."""
    nodes = []
    for points, pose in zip(walk.scans, walk.poses if poses is None else poses, strict=True):
        numbers = {XY: points[:, :2], XYZ: points, XYZI: np.column_stack([points, np.ones(len(points))])}.get(form)
        if numbers is None:
            color = np.full(len(points), (COLOR[0] << 16) | (COLOR[1] << 8) | COLOR[2], "<u4").view("<f4")
            numbers = np.column_stack([points, color])
        info = scan_info_bytes(version, form, LASER)
        nodes.append(Node(pose @ np.linalg.inv(LASER), scan=packed(numbers.astype("<f4")[None]), scan_info=info))
    return nodes


def depth_nodes(poses: np.ndarray, version: str = "0.23.0", scale: int = 1) -> list[Node]:
    """The room as a camera of depth on a robot sees it; colours may be larger than depth."""
    stream = BytesIO()
    color_image(scale).save(stream, "JPEG", quality=100)
    camera = np.diag([scale, scale, 1, 1.0]) @ CAMERA
    calibration = camera_bytes(version, [OPTICAL], camera, (SHAPE[0] * scale, SHAPE[1] * scale))
    depths = [png(depth_image(pose, 1000.0)) for pose in poses]
    places = poses @ np.linalg.inv(OPTICAL)
    return [Node(p, d, stream.getvalue(), calibration) for p, d in zip(places, depths, strict=True)]


@pytest.mark.parametrize("version", VERSIONS)
def test_laser_scans_are_the_walk(tmp_path: Path, walk: Walk, version: str) -> None:
    """By the poses of the odometry, and by optimised ones where the version has them."""
    path = write_rtabmap(tmp_path / "a.db", scan_nodes(walk, version), version)
    cloud = read_points(path)
    assert_same(cloud, walk)
    assert cloud.warnings == ("it has no optimised poses: those of the odometry are taken, which drift",)
    if version < "0.17":
        return
    drifted = scan_nodes(walk, version, poses=SHIFT @ walk.poses)
    cloud = read_points(write_rtabmap(path, drifted, version, list(walk.poses @ np.linalg.inv(LASER))))
    assert_same(cloud, walk)
    assert cloud.warnings == ()
    chunks = np.concatenate([c.points for c in read_chunks(path, chunk=700)])
    np.testing.assert_array_equal(chunks, cloud.points)


def test_formats_of_scans(tmp_path: Path, walk: Walk) -> None:
    path = tmp_path / "a.db"
    for form in (XYZ, XYZI, XYZRGB):
        cloud = read_points(write_rtabmap(path, scan_nodes(walk, form=form)))
        assert_same(cloud, walk)
        assert (cloud.colors is not None and (cloud.colors == COLOR).all()) == (form == XYZRGB)
    flat = Walk([s * (1, 1, 0) for s in walk.scans], walk.poses, walk.times)
    cloud = read_points(write_rtabmap(path, scan_nodes(flat, form=XY)))
    assert_same(cloud, flat)
    assert "its scans are slices: it has no depth images, nor scans in space" in cloud.warnings
    bad = replace(scan_nodes(walk)[0], scan_info=scan_info_bytes("0.23.0", 99, LASER))
    assert "the scan of node 1 is in a format that is not known (99, 3 numbers a point)" in refusal_of(write_rtabmap(path, [bad]))


@pytest.mark.longer
@pytest.mark.parametrize("version", VERSIONS)
def test_depth_images_show_the_room(tmp_path: Path, version: str) -> None:
    """The same cloud as the same images in the layout of TUM; colours may be larger than depth."""
    expected = read_points(write_tum_images(tmp_path / "tum", camera_poses(), 1000.0))
    for scale in (1, 2):
        cloud = read_points(write_rtabmap(tmp_path / f"{scale}.db", depth_nodes(camera_poses(), version, scale), version))
        np.testing.assert_allclose(cloud.points, expected.points, atol=1e-5)
        assert cloud.colors is not None and (cloud.colors == COLOR).all()
        assert cloud.poses is not None
        np.testing.assert_allclose(cloud.poses, camera_poses(), atol=1e-6)


def test_depth_in_floats(tmp_path: Path) -> None:
    nodes = depth_nodes(camera_poses())
    metres = [depth_image(pose, 1000.0).astype("<f4") / 1000 for pose in camera_poses()]
    metres[0][:240] = np.nan
    floats = [replace(node, depth=png(depth)) for node, depth in zip(nodes, metres, strict=True)]
    expected, cloud = read_points(write_rtabmap(tmp_path / "a.db", nodes)), read_points(write_rtabmap(tmp_path / "b.db", floats))
    lost = len(expected) - len(cloud)
    assert 0 < lost < len(expected) / 3
    np.testing.assert_allclose(cloud.points[-1000:], expected.points[-1000:], atol=1e-5)


@pytest.mark.parametrize("version", ["0.16.1", "0.23.0"])
def test_several_cameras_lie_side_by_side(tmp_path: Path, version: str) -> None:
    first, second = camera_poses()[:2]
    behind = np.linalg.inv(first @ np.linalg.inv(OPTICAL)) @ second
    depth = png(np.hstack([depth_image(first, 1000.0), depth_image(second, 1000.0)]))
    calibration = camera_bytes(version, [OPTICAL, behind])
    node = Node(first @ np.linalg.inv(OPTICAL), depth, calibration=calibration)
    cloud = read_points(write_rtabmap(tmp_path / "a.db", [node], version))
    expected = read_points(write_rtabmap(tmp_path / "b.db", depth_nodes(camera_poses()[:2])))
    np.testing.assert_allclose(cloud.points, expected.points, atol=1e-5)
    cut = replace(node, depth=png(depth_image(first, 1000.0)[:, :-1]))
    assert "the depth of node 1 is 639 pixels wide, which 2 cameras can't share" in refusal_of(
        write_rtabmap(tmp_path / "a.db", [cut], version)
    )


def test_nodes_without_a_pose_are_left_out(tmp_path: Path, walk: Walk) -> None:
    path = tmp_path / "a.db"
    poses = list(walk.poses @ np.linalg.inv(LASER))
    cloud = read_points(write_rtabmap(path, scan_nodes(walk), optimised=[*poses[:2], None]))
    assert_same(cloud, walk.part(2))
    assert cloud.warnings == ("1 of 3 scans have no pose and are left out",)
    nan = [*poses[:2], np.full((4, 4), np.nan)]
    assert read_points(write_rtabmap(path, scan_nodes(walk), optimised=nan)).warnings == cloud.warnings
    nothing = [replace(node, pose=np.zeros((4, 4))) for node in scan_nodes(walk)]
    assert "none of its 3 scans has a pose; optimise the graph" in refusal_of(write_rtabmap(path, nothing))
    nodes = depth_nodes(camera_poses())
    cloud = read_points(write_rtabmap(path, nodes, optimised=[n.pose for n in nodes[:2]]))
    assert cloud.warnings == ("1 of 3 depth images have no pose that can be used and are left out",)
    mirrored = [p @ np.diag([1, 1, -1.0, 1]) for p in poses]
    assert "node 1 has a pose that is not a rotation and a place" in refusal_of(
        write_rtabmap(path, scan_nodes(walk), optimised=mirrored)
    )


def test_several_sessions_need_optimised_poses(tmp_path: Path, walk: Walk) -> None:
    path = tmp_path / "a.db"
    nodes = [replace(node, map=number) for number, node in enumerate(scan_nodes(walk))]
    assert "holds 3 sessions and no optimised poses that join them" in refusal_of(write_rtabmap(path, nodes))
    assert_same(read_points(write_rtabmap(path, nodes, optimised=[n.pose for n in nodes])), walk)


def test_scans_in_space_go_before_images_and_images_before_slices(tmp_path: Path, walk: Walk) -> None:
    path = tmp_path / "a.db"
    images = depth_nodes(walk.poses @ np.linalg.inv(LASER) @ OPTICAL)
    for form, laser in ((XYZ, True), (XY, False)):
        both = [replace(i, scan=s.scan, scan_info=s.scan_info) for i, s in zip(images, scan_nodes(walk, form=form), strict=True)]
        cloud = read_points(write_rtabmap(path, both))
        assert (len(cloud) == sum(len(s) for s in walk.scans)) == laser


def test_what_is_not_read_is_refused(tmp_path: Path, walk: Walk) -> None:
    path = tmp_path / "a.db"
    nodes = depth_nodes(camera_poses())

    def said_of(node: Node, version: str = "0.23.0") -> str:
        return refusal_of(write_rtabmap(path, [node, *nodes[1:]], version))

    assert "the depth of node 1 is packed by RVL, which is not read" in said_of(replace(nodes[0], depth=b"DEPTHRVL" + bytes(50)))
    for version in ("0.16.1", "0.23.0"):
        assert "node 1 has stereo images" in said_of(replace(nodes[0], calibration=stereo_bytes(version)), version)
    assert "the depth of node 1 is no depth image" in said_of(replace(nodes[0], depth=nodes[0].image))
    depth, calibration = nodes[0].depth, nodes[0].calibration
    assert depth is not None and calibration is not None
    assert "the depth of node 1: damaged" in said_of(replace(nodes[0], depth=depth[: len(depth) // 2]))
    assert "node 1 has a depth image and no camera" in said_of(replace(nodes[0], calibration=None))
    assert "node 1 has a calibration" in said_of(replace(nodes[0], calibration=b"1234567"))
    assert "node 1 has a calibration" in said_of(replace(nodes[0], calibration=b"1234567"), "0.16.1")
    assert "node 1 has a calibration that can't be read" in said_of(replace(nodes[0], calibration=calibration[:-9]))
    for camera in (0 * CAMERA, np.nan * CAMERA):
        assert "node 1 has a camera that can't be used" in said_of(
            replace(nodes[0], calibration=camera_bytes("0.23.0", [OPTICAL], camera))
        )
    wrong = camera_bytes("0.23.0", [OPTICAL], np.diag([2.0, 2, 1, 1]) @ CAMERA)
    assert "the depth of node 1: has 640 x 480 pixels, and a camera of" in said_of(replace(nodes[0], calibration=wrong))
    assert "holds neither laser scans nor depth images" in refusal_of(write_rtabmap(path, [Node(np.eye(4))]))
    for version in ("0.10.7", "0.24.0", "1.0.0", "?"):
        path = write_rtabmap(path, scan_nodes(walk))
        change(path, "UPDATE Admin SET version = ?", version)
        assert f"is of version {version} of RTAB-Map, only 0.11.10 to 0.23 are read" in refusal_of(path)


def change(path: Path, command: str, *values: object) -> None:
    with closing(sqlite3.connect(path)) as base:
        base.execute(command, values)
        base.commit()


def test_bad_blobs(tmp_path: Path, walk: Walk) -> None:
    path = tmp_path / "a.db"
    scan = scan_nodes(walk)[0].scan
    assert scan is not None
    tail = len(scan) - 12
    for blob, says in (
        (b"12345", "the scan of node 1 has 5 bytes, too few"),
        (scan[: tail // 2] + scan[tail:], "the scan of node 1 has"),
        (b"\xff" * 10 + scan[10:], "the scan of node 1 can't be unpacked"),
        (scan[:tail] + struct.pack("<3i", 1 << 20, 1 << 20, 21), "the scan of node 1 would have"),
        (scan[:tail] + struct.pack("<3i", -1, 5, 21), "the scan of node 1 is no matrix that can be read"),
        (scan[:tail] + struct.pack("<3i", 1, 5, 7), "the scan of node 1 is no matrix that can be read"),
    ):
        write_rtabmap(path, scan_nodes(walk))
        change(path, "UPDATE Data SET scan = ? WHERE id = 1", blob)
        assert says in refusal_of(path)
    change(path, "UPDATE Data SET scan = 'a long text' WHERE id = 1")
    assert refusal_of(path).startswith(f"{path}: ")
    write_rtabmap(path, scan_nodes(walk), optimised=list(walk.poses))
    change(path, "UPDATE Admin SET opt_poses = ?", packed(np.ones((1, 13), "<f4")))
    assert "13 numbers of optimised poses for 4 nodes" in refusal_of(path)
    change(path, "UPDATE Admin SET opt_ids = ?", b"abc")
    assert f"{path}: opt_ids has 3 bytes" in refusal_of(path)


def test_other_and_unfinished_databases(tmp_path: Path, walk: Walk) -> None:
    path = tmp_path / "a.db"
    path.write_bytes(b"hello\n" * 50)
    assert "is not an RTAB-Map database (it does not start with SQLite format 3);" in refusal_of(path)
    path.unlink()
    change(path, "CREATE TABLE Node (id INTEGER)")
    assert "is no RTAB-Map database (it has no tables Node, Data, Admin)" in refusal_of(path)
    write_rtabmap(path, scan_nodes(walk))
    before = path.read_bytes()
    read_points(path)
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["a.db"]
    (tmp_path / "a.db-journal").write_bytes(b"1")
    assert "is being written, or was cut off (a.db-journal lies beside it)" in refusal_of(path)


def test_a_view_in_place_of_a_table_is_not_run(tmp_path: Path, walk: Walk) -> None:
    """It could count for ever."""
    path = write_rtabmap(tmp_path / "a.db", scan_nodes(walk))
    change(path, "DROP TABLE Data")
    endless = "WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n)"
    change(path, f"CREATE VIEW Data AS {endless} SELECT id, NULL AS depth, NULL AS scan, NULL AS scan_info FROM n")
    assert "is no RTAB-Map database" in refusal_of(path)


def test_damaged_databases(tmp_path: Path, walk: Walk) -> None:
    """Points or one line, whatever is cut or flipped."""
    data = write_rtabmap(tmp_path / "whole.db", scan_nodes(walk), optimised=list(walk.poses)).read_bytes()
    path = tmp_path / "damaged.db"
    rng = np.random.default_rng(1)
    for length in (1, 50, 200, len(data) // 3, len(data) // 2, len(data) - 5000):
        path.write_bytes(data[:length])
        assert refusal_of(path).startswith(f"{path}: ")
    for attempt in range(60):
        broken = bytearray(data)
        for at in rng.integers(0, len(data) if attempt % 2 else 5000, 1 + attempt % 5):
            broken[at] = int(rng.integers(256))
        path.write_bytes(bytes(broken))
        said = refused(path)
        assert said is None or (said.startswith(f"{path}: ") and "\n" not in said)
