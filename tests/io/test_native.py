"""Files of other programs written moved: trajectories, pose graphs, clouds and stations. Nothing lost, poses to a millionth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.samples import box_points, write_las, write_pcd, write_ply
from tests.types.test_deformation import deformation
from topomerge.errors import InputError
from topomerge.io import read_points
from topomerge.io.native import (
    NATIVE,
    Doubt,
    Motion,
    Source,
    Tally,
    find_format,
    find_nearest_links,
    plan_outputs,
    save_joined,
)
from topomerge.io.native.pose_graph import read_pose_graph
from topomerge.io.trajectory import read_trajectory
from topomerge.types import Array, Placement, Sim3, transform_points

YAW = Motion(Sim3(0.7, (12.5, -3.25, 0.5)).matrix)
TILT = np.eye(4)
TILT[:3, :3] = Rotation.from_euler("xyz", (0.1, -0.2, 1.3)).as_matrix()
TILT[:3, 3] = 4, 5, -6
TILTED = Motion(TILT)
BENT_PLACE = Placement(
    Sim3(0.7, (12.5, -3.25, 0.5)), deformation(np.random.default_rng(5).normal(0, (0.1, 0.1, 0.005, 0), (6, 4)))
)
BENT = Motion(BENT_PLACE.pose.matrix, BENT_PLACE.transform_points)


def random_poses(count: int = 20, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng).as_matrix()
    poses[:, :3, 3] = rng.uniform(-20, 20, (count, 3))
    return poses


def move(source: Path, target: Path, motion: Motion) -> Tally:
    form = find_format(source)
    assert form is not None
    return save_joined(form, [Source(source, motion)], target)


def write_lines(path: Path, rows: Array, spec: str = "%.9f", comma: str = " ", head: str = "") -> Path:
    path.write_text(head + "".join(comma.join(spec % v for v in row) + "\n" for row in rows))
    return path


def quaternions(poses: Array) -> Array:
    return Rotation.from_matrix(poses[:, :3, :3]).as_quat()


@pytest.mark.parametrize("motion", [YAW, TILTED, BENT], ids=["level", "tilted", "bent"])
def test_a_motion_moves_poses_as_it_moves_points(motion: Motion) -> None:
    poses = random_poses()
    moved = motion.move_poses(poses)
    near = 0.01 * np.eye(3)
    for pose, there in zip(poses, moved, strict=True):
        ahead = motion.move_points(transform_points(pose, near))
        np.testing.assert_allclose(transform_points(there, near), ahead, rtol=0, atol=1e-9 if motion.warp is None else 5e-4)
        np.testing.assert_allclose(there[:3, :3] @ there[:3, :3].T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("motion", [YAW, TILTED], ids=["level", "tilted"])
def test_kitti(tmp_path: Path, motion: Motion) -> None:
    poses = random_poses()
    source = write_lines(tmp_path / "poses.txt", poses[:, :3].reshape(-1, 12), "%.12e")
    assert move(source, tmp_path / "out.txt", motion).counts == {"poses": (20, 20)}
    np.testing.assert_allclose(read_trajectory(tmp_path / "out.txt").poses, motion.matrix @ poses, rtol=0, atol=1e-6)
    assert all("e" in word and len(word.partition(".")[2]) == 16 for word in (tmp_path / "out.txt").read_text().split())


def test_kitti_of_a_camera_is_moved_as_its_laser(tmp_path: Path) -> None:
    """What is read with the moved file and its calibration lies where it was read before, moved."""
    laser = np.vstack([[[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, -0.3]], [0, 0, 0, 1]])
    poses = random_poses(5)
    (tmp_path / "calib.txt").write_text("Tr: " + " ".join(str(v) for v in laser[:3].ravel()) + "\n")
    source = write_lines(tmp_path / "poses.txt", poses[:, :3].reshape(-1, 12))
    before = read_trajectory(source).poses
    (tmp_path / "moved").mkdir()
    (tmp_path / "moved" / "calib.txt").write_bytes((tmp_path / "calib.txt").read_bytes())
    move(source, tmp_path / "moved" / "poses.txt", YAW)
    np.testing.assert_allclose(read_trajectory(tmp_path / "moved" / "poses.txt").poses, YAW.matrix @ before, rtol=0, atol=1e-6)


def test_tum(tmp_path: Path) -> None:
    poses = random_poses()
    rows = np.column_stack([1570513628.25 + np.arange(20) / 10, poses[:, :3, 3], quaternions(poses)])
    source = write_lines(tmp_path / "walk.tum", rows, "%.4f", head="# time x y z qx qy qz qw\n")
    exact = read_trajectory(source).poses
    move(source, tmp_path / "out.tum", YAW)
    text = (tmp_path / "out.tum").read_text()
    assert text.startswith("# time x y z qx qy qz qw\n1570513628.2500 ")
    moved = read_trajectory(tmp_path / "out.tum")
    np.testing.assert_allclose(moved.poses, YAW.matrix @ exact, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(moved.times, rows[:, 0].round(4))


def test_euroc(tmp_path: Path) -> None:
    """Quaternions begin with w, velocities are turned, biases stay."""
    poses, rng = random_poses(), np.random.default_rng(3)
    speed, biases = rng.normal(size=(20, 3)), rng.normal(size=(20, 6))
    rows = np.column_stack([poses[:, :3, 3], quaternions(poses)[:, [3, 0, 1, 2]], speed, biases])
    lines = [f"{1403636580838555648 + k}," + ",".join(f"{v:.8f}" for v in row) for k, row in enumerate(rows)]
    source = tmp_path / "data.csv"
    source.write_text("#timestamp, p_RS_R_x [m]\n" + "\n".join(lines) + "\n")
    move(source, tmp_path / "out.csv", TILTED)
    written = (tmp_path / "out.csv").read_text().splitlines()
    assert written[0] == "#timestamp, p_RS_R_x [m]"
    for k, line in enumerate(written[1:]):
        words = line.split(",")
        numbers = np.array([float(w) for w in words[1:]])
        assert words[0] == str(1403636580838555648 + k) and words[-6:] == lines[k].split(",")[-6:]
        there = TILT @ poses[k]
        np.testing.assert_allclose(numbers[:3], there[:3, 3], rtol=0, atol=1e-6)
        np.testing.assert_allclose(Rotation.from_quat(numbers[[4, 5, 6, 3]]).as_matrix(), there[:3, :3], rtol=0, atol=1e-6)
        np.testing.assert_allclose(numbers[7:10], TILT[:3, :3] @ speed[k], rtol=0, atol=1e-6)


def test_tables_of_points_are_no_trajectories(tmp_path: Path) -> None:
    table = write_lines(tmp_path / "points.txt", box_points(50))
    assert find_format(table) is None and find_format(tmp_path / "none.txt") is None
    eight = write_lines(tmp_path / "eight.csv", np.random.default_rng(0).uniform(0, 5, (9, 8)))
    assert find_format(eight) is None
    with pytest.raises(InputError, match=r"points.txt: only db g2o .* are written again"):
        plan_outputs([Source(table)], tmp_path)


GRAPH = """\
PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1.5 0 0.25 0 0 0.6 0.8
VERTEX_TRACKXYZ 7 2 1 0.5
FIX 0
EDGE_SE3:QUAT 0 1 1.5 0 0.25 0 0 0.6 0.8 INFORMATION
EDGE_SE3_TRACKXYZ 1 7 0 0.1 0.2 0.3 1 0 0 1 0 1 # seen
""".replace("INFORMATION", " ".join("100.0" if k in (0, 6, 11, 15, 18, 20) else "0" for k in range(21)))
PLANE = """\
VERTEX_SE2 10 0 0 0.0
VERTEX_SE2 11 1 0 1.57
VERTEX_XY 12 4 5
EDGE_SE2 10 11 1 0 1.57 500 0 0 500 0 5000
EDGE_SE2_XY 11 12 1 2 10 0 10
"""


def test_two_graphs_become_one(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / f"{name}.g2o").write_text(GRAPH)
    tally = save_joined(
        NATIVE["g2o"],
        [Source(tmp_path / "a.g2o"), Source(tmp_path / "b.g2o", TILTED)],
        tmp_path / "joined.g2o",
        Doubt(0.1, 0.05),
    )
    first, joined = read_pose_graph(tmp_path / "a.g2o"), read_pose_graph(tmp_path / "joined.g2o")
    assert tally.counts["nodes"] == (6, 6) and joined.fixed == [0] and "fixed vertices are free" in tally.warnings[0]
    for k, vertex in first.vertices.items():
        np.testing.assert_allclose(joined.vertices[k].pose, vertex.pose, rtol=0, atol=1e-12)
        there = joined.vertices[k + 8].pose
        np.testing.assert_allclose(there[:3, 3], (TILT @ vertex.pose)[:3, 3], rtol=0, atol=1e-9)
        if vertex.posed:
            np.testing.assert_allclose(there, TILT @ vertex.pose, rtol=0, atol=1e-9)
    own = [(tag, ends, used, text) for tag, ends, used, text in joined.edges if ends[0] >= 8 and ends[1] >= 8]
    assert [text for *_, text in own] == [text for *_, text in first.edges] and own[1][2] == (1,)
    between = [edge for edge in joined.edges if min(edge[1]) < 8 <= max(edge[1])]
    assert len(between) == tally.counts["links between sessions"][1] >= 1
    numbers = np.array([float(w) for w in between[0][3].split()])
    a, b = (joined.vertices[k].pose for k in between[0][1])
    np.testing.assert_allclose(numbers[:3], (np.linalg.inv(a) @ b)[:3, 3], rtol=0, atol=1e-9)
    assert numbers[7] == pytest.approx(0.1**-2) and numbers[-1] == pytest.approx(4 * 0.05**-2)


def test_graphs_in_a_plane(tmp_path: Path) -> None:
    (tmp_path / "a.g2o").write_text(PLANE)
    form = NATIVE["g2o"]
    save_joined(form, [Source(tmp_path / "a.g2o"), Source(tmp_path / "a.g2o", YAW)], tmp_path / "joined.g2o")
    joined = read_pose_graph(tmp_path / "joined.g2o")
    there = YAW.matrix @ read_pose_graph(tmp_path / "a.g2o").vertices[11].pose
    np.testing.assert_allclose(joined.vertices[11 + 13].pose[:2], there[:2] - [[0] * 4, [0] * 4], rtol=0, atol=1e-9)
    assert {len(text.split()) for tag, _, _, text in joined.edges if tag == "EDGE_SE2"} == {9}
    with pytest.raises(InputError, match="its map is tilted"):
        save_joined(form, [Source(tmp_path / "a.g2o", TILTED)], tmp_path / "no.g2o")
    (tmp_path / "s.g2o").write_text(GRAPH)
    with pytest.raises(InputError, match="is of SE2 and .* is of SE3"):
        save_joined(form, [Source(tmp_path / "a.g2o"), Source(tmp_path / "s.g2o")], tmp_path / "no.g2o")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("VERTEX_SE2 0 1 2", "line 1: VERTEX_SE2 has 2 numbers, not 3"),
        ("VERTEX_SE2 0 0 0 nan", "not finite"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 0", "unit quaternion"),
        ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 0 0 0 0", "line 2: vertex 0 stands there twice"),
        ("VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 9 1 0 0 1 0 0 1 0 1", "does not exist"),
        ("VERTEX_CAM 0 1 2 3", "VERTEX_CAM is not known"),
        ("VERTEX_SE2 -4 0 0 0", "no number of a vertex"),
        ("# nothing\n", "no vertices"),
        ("VERTEX_SE2 0 0 0 0\nVERTEX_SE3:QUAT 1 0 0 0 0 0 0 1", "of SE2 and of SE3"),
    ],
)
def test_damaged_graphs(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "a.g2o").write_text(text)
    with pytest.raises(InputError, match=told):
        read_pose_graph(tmp_path / "a.g2o")


def test_nearest_links_reach_every_session() -> None:
    near, far = np.array([[0.0, 0, 0], [5, 0, 0], [5.1, 0, 0]]), np.array([[100.0, 0, 0]])
    links = list(find_nearest_links([near, near + (0, 0.2, 0), far, np.zeros((0, 3))]))
    assert (0, 0, 1, 0) in links and {b for _, _, b, _ in links} == {1, 2}
    assert len([k for k in links if k[2] == 1]) == 2  # the third node stands beside the second
    assert sum(k[2] == 2 for k in links) == 1


@pytest.mark.parametrize("motion", [YAW, TILTED, BENT], ids=["level", "tilted", "bent"])
@pytest.mark.parametrize("name", ["a.ply", "a.pcd", "a.las", "a.laz"])
def test_clouds(tmp_path: Path, name: str, motion: Motion) -> None:
    points, colors = box_points(), np.arange(1800).reshape(600, 3).astype(np.uint8)
    writers: dict[str, Callable[[Path], object]] = {
        "a.ply": lambda p: write_ply(p, points, colors, text=False, order=">", kind="f8"),
        "a.pcd": lambda p: write_pcd(p, points, colors, ascii=False, compressed=False),
        "a.las": lambda p: write_las(p, points, colors),
        "a.laz": lambda p: write_las(p, points, colors),
    }
    writers[name](tmp_path / name)
    before = read_points(tmp_path / name)
    move(tmp_path / name, tmp_path / f"out{Path(name).suffix}", motion)
    after = read_points(tmp_path / f"out{Path(name).suffix}")
    np.testing.assert_allclose(after.points, motion.move_points(before.points), rtol=0, atol=1e-4)
    assert np.array_equal(after.colors, before.colors)


def test_normals_turn_and_faces_stay(tmp_path: Path) -> None:
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
    head += b"".join(b"property float %s\n" % n for n in (b"x", b"y", b"z", b"nx", b"ny", b"nz"))
    head += b"property uchar label\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    rows = np.array([(0, 0, 0, 1, 0, 0, 7), (1, 0, 0, 0, 2, 0, 8), (0, 1, 0, 0, 0, 1, 9)], "<f4,<f4,<f4,<f4,<f4,<f4,u1")
    face = b"\x03" + np.arange(3, dtype="<i4").tobytes()
    (tmp_path / "a.ply").write_bytes(head + rows.tobytes() + face)
    move(tmp_path / "a.ply", tmp_path / "out.ply", TILTED)
    data = (tmp_path / "out.ply").read_bytes()
    assert data.startswith(head) and data.endswith(face)
    moved = np.frombuffer(data[len(head) : -len(face)], rows.dtype)
    normals = np.array([[r["f3"], r["f4"], r["f5"]] for r in moved])
    np.testing.assert_allclose(normals, np.diag([1, 2, 1]) @ TILT[:3, :3].T, atol=1e-5)
    assert moved["f6"].tolist() == [7, 8, 9]


def test_clouds_that_can_not_hold_the_places(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", box_points(), None, text=False, order="<", kind="f4")
    far = Motion(Sim3(0.0, (480_000.0, 5_400_000.0, 0.0)).matrix)
    with pytest.raises(InputError, match="save them as double"):
        move(tmp_path / "a.ply", tmp_path / "out.ply", far)
    write_ply(tmp_path / "t.ply", box_points(), None, text=True, order="=", kind="f4")
    with pytest.raises(InputError, match="only binary PLY"):
        move(tmp_path / "t.ply", tmp_path / "out.ply", YAW)
    (tmp_path / "c.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-100])
    with pytest.raises(InputError, match="cut short"):
        move(tmp_path / "c.ply", tmp_path / "out.ply", YAW)
    assert not (tmp_path / "out.ply").exists()


def test_the_viewpoint_of_a_pcd_moves(tmp_path: Path) -> None:
    write_pcd(tmp_path / "a.pcd", box_points(), np.zeros((600, 3), np.uint8), ascii=False, compressed=False)
    data = (tmp_path / "a.pcd").read_bytes().replace(b"VIEWPOINT 0 0 0 1 0 0 0", b"VIEWPOINT 1 2 3 0.8 0 0 0.6")
    (tmp_path / "a.pcd").write_bytes(data)
    before = read_points(tmp_path / "a.pcd").poses
    move(tmp_path / "a.pcd", tmp_path / "out.pcd", TILTED)
    np.testing.assert_allclose(read_points(tmp_path / "out.pcd").poses, TILT @ before, rtol=0, atol=1e-6)


@pytest.mark.parametrize("scans", [1, 3, 40])
def test_stations_keep_their_points_to_the_bit(tmp_path: Path, scans: int) -> None:
    pye57 = pytest.importorskip("pye57")
    rng = np.random.default_rng(scans)
    poses = random_poses(scans, seed=scans)
    turns = quaternions(poses)[:, [3, 0, 1, 2]]
    listed = [(rng.uniform(-5, 5, (200 + k, 3)), turns[k], poses[k, :3, 3]) for k in range(scans)]
    write_many_scans(tmp_path / "a.e57", listed)
    kept = (tmp_path / "a.e57").read_bytes()
    tally = move(tmp_path / "a.e57", tmp_path / "out.e57", TILTED)
    assert tally.counts["scans"] == (scans, scans) and (tmp_path / "a.e57").read_bytes() == kept
    a, b = pye57.E57(str(tmp_path / "a.e57")), pye57.E57(str(tmp_path / "out.e57"))
    assert b.scan_count == scans
    for k in range(scans):
        one, two = (f.read_scan_raw(k) for f in (a, b))
        assert all(np.array_equal(one[name], two[name]) for name in one) and set(one) == set(two)
        header = b.get_header(k)
        there = TILT @ poses[k]
        np.testing.assert_allclose(header.translation, there[:3, 3], rtol=0, atol=1e-9)
        np.testing.assert_allclose(header.rotation_matrix, there[:3, :3], rtol=0, atol=1e-9)
        assert header["name"].value() == a.get_header(k)["name"].value()
    a.close(), b.close()
    before, after = read_points(tmp_path / "a.e57"), read_points(tmp_path / "out.e57")
    np.testing.assert_allclose(after.points, TILTED.move_points(before.points), rtol=0, atol=1e-4)


def write_many_scans(path: Path, scans: list[tuple[Array, Array, Array]]) -> None:
    """Scans as (points in the scanner's frame, quaternion w x y z, translation), without colours."""
    import pye57

    file = pye57.E57(str(path), mode="w")
    for points, turn, place in scans:
        file.write_scan_raw({f"cartesian{a}": points[:, i].copy() for i, a in enumerate("XYZ")}, rotation=turn, translation=place)
    file.close()


def test_damaged_stations(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    write_many_scans(tmp_path / "a.e57", [(box_points(50).astype(float), np.array([1.0, 0, 0, 0]), np.zeros(3))])
    data = bytearray((tmp_path / "a.e57").read_bytes())
    data[-200] ^= 1
    (tmp_path / "b.e57").write_bytes(data)
    with pytest.raises(InputError, match="fails its checksum"):
        move(tmp_path / "b.e57", tmp_path / "out.e57", YAW)
    assert not (tmp_path / "out.e57").exists()


def test_outputs_have_names_of_their_own(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "walk.g2o").write_text(PLANE)
        write_ply(tmp_path / folder / "scan.ply", box_points(), None, text=False, order="<", kind="f4")
    names = ("one/walk.g2o", "one/scan.ply", "two/walk.g2o", "two/scan.ply")
    plan = plan_outputs([Source(tmp_path / name) for name in names], tmp_path / "out")
    assert [(path.name, len(sources)) for path, _, sources in plan] == [
        ("joined.g2o", 2),
        ("scan_moved.ply", 1),
        ("scan_moved_2.ply", 1),
    ]
    assert [p.name for p, _, _ in plan_outputs([Source(tmp_path / "one/walk.g2o")], tmp_path)] == ["walk_moved.g2o"]


@pytest.mark.longer
def test_the_table_of_round_trips(tmp_path: Path) -> None:
    """Nothing is lost, poses are right to a millionth (in floats and in LAS to what these hold), and the page is written."""
    for name in ("pye57", "laspy", "spark_dsg", "plyfile", "google.protobuf", "pxr"):
        pytest.importorskip(name)
    from tests.io.native_round_trips import TRIPS, main

    page = tmp_path / "native.md"
    page.write_text("# Native\n<!-- native-round-trips:begin -->\n<!-- native-round-trips:end -->\n")
    main([str(page)])
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.read_text().splitlines() if line.startswith("|")][
        2:
    ]
    assert [line[0] for line in lines] == list(TRIPS)
    for name, counts, error, _ in lines:
        limit = 6e-5 if name in ("LAS", "LAZ") else 8e-3 if "whole cm" in name else 5e-6 if "floats" in name else 1e-6
        assert float(error) <= limit, (name, error)
        for part in counts.split(", "):
            before, after = part.rpartition(" → ")[::2]
            assert before.split()[-1] == after or "Spark-DSG" in name or "Valetudo" in name, part
