"""Point clouds: every format gives back what was written."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.samples import box_colors, box_points, write_e57, write_las, write_ply
from topomerge.errors import InputError
from topomerge.io import read_chunks, read_points
from topomerge.types import PointCloud

COLORED = ["ascii.ply", "little.ply", "big.ply", "ascii.pcd", "binary.pcd", "packed.pcd", "table.csv", "array.npz", "cloud.las"]


@pytest.mark.parametrize("name", [*COLORED, "cloud.laz", "table.xyz", "array.npy"])
def test_points_come_back(samples: dict[str, Path], name: str) -> None:
    cloud = read_points(samples[name])
    np.testing.assert_allclose(cloud.points, box_points(), atol=1e-4)
    assert cloud.points.dtype == np.float32
    assert not cloud.shift.any()
    assert cloud.source == str(samples[name])
    assert cloud.warnings == ()


@pytest.mark.parametrize("name", [*COLORED, "cloud.laz"])
def test_colors_come_back(samples: dict[str, Path], name: str) -> None:
    cloud = read_points(samples[name])
    assert cloud.colors is not None
    assert cloud.colors.dtype == np.uint8
    np.testing.assert_array_equal(cloud.colors, box_colors())


@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_ply_of_every_binary_kind(tmp_path: Path, kind: str, order: str) -> None:
    write_ply(tmp_path / "a.ply", box_points(), None, text=False, order=order, kind=kind)
    cloud = read_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(cloud.points, box_points())
    assert cloud.colors is None


def test_ply_with_rows_before_the_vertices(tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement camera 1\nproperty float f\nelement vertex 2\nproperty float x\n"
    (tmp_path / "a.ply").write_text(head + "property float y\nproperty float z\nend_header\n9\n1 2 3\n4 5 6\n")
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply").points, [[1, 2, 3], [4, 5, 6]])


def test_national_coordinates_keep_millimetres(tmp_path: Path) -> None:
    points = box_points() + np.array((4_480_123.4, 5_330_987.6, 520.1))
    write_ply(tmp_path / "a.ply", points, None, text=False, order="<", kind="f8")
    write_las(tmp_path / "a.las", points, box_colors())
    for name in ("a.ply", "a.las"):
        cloud = read_points(tmp_path / name)
        assert np.array_equal(cloud.shift % 100, np.zeros(3))
        assert np.abs(cloud.points).max() < 1000
        np.testing.assert_allclose(cloud.points + cloud.shift, points, atol=2e-4)


def test_e57_keeps_the_poses_of_its_scans(tmp_path: Path) -> None:
    points, colors = box_points(), box_colors()
    half = np.pi / 4  # a quarter turn about z
    scans = [
        (points, np.array([np.cos(half), 0, 0, np.sin(half)]), np.array([10.0, 0, 1])),
        (points, np.array([1.0, 0, 0, 0]), np.zeros(3)),
    ]
    write_e57(tmp_path / "a.e57", scans, colors)
    cloud = read_points(tmp_path / "a.e57")
    turned = np.stack([10 - points[:, 1], points[:, 0], points[:, 2] + 1], axis=1)
    np.testing.assert_allclose(cloud.points, np.concatenate([turned, points]), atol=1e-5)
    np.testing.assert_array_equal(cloud.colors, np.concatenate([colors, colors]))
    assert cloud.poses is not None and cloud.pose_of is not None
    np.testing.assert_allclose(cloud.poses[:, :3, 3], [[10, 0, 1], [0, 0, 0]])
    np.testing.assert_array_equal(cloud.pose_of, np.repeat([0, 1], len(points)))


def test_pcd_keeps_its_viewpoint_and_skips_padding(tmp_path: Path) -> None:
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x _ y z _\nSIZE 4 1 4 4 1\nTYPE F U F F U\nCOUNT 1 3 1 1 2\nWIDTH 2\nHEIGHT 1\n"
    row = np.dtype([("x", "<f4"), ("p", "u1", 3), ("y", "<f4"), ("z", "<f4"), ("q", "u1", 2)])
    rows = np.zeros(2, row)
    rows["x"], rows["y"], rows["z"] = (1, 2), (3, 4), (5, 6)
    data = (head + "VIEWPOINT 1 2 3 0 0 0 1\nPOINTS 2\nDATA binary\n").encode() + rows.tobytes()
    (tmp_path / "a.pcd").write_bytes(data)
    cloud = read_points(tmp_path / "a.pcd")
    np.testing.assert_array_equal(cloud.points, [[1, 3, 5], [2, 4, 6]])
    assert cloud.poses is not None and cloud.pose_of is not None
    np.testing.assert_allclose(cloud.poses[0], [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12)
    assert (cloud.pose_of == 0).all()


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.xyz", "1 2 3\n4 5 6\n"),
        ("a.xyz", "\n  1\t2  3 wall\n\n4 5 6 floor\n"),
        ("a.txt", "# a scan\n# of a room\n1, 2, 3, 0.5\n4, 5, 6, 0.5\n"),
        ("a.csv", "id;z;y;x\n7;3;2;1\n8;6;5;4\n"),
        ("a.csv", '"X","Y","Z"\n1,2,3\n4,5,6\n'),
        ("a.csv", "1,0;2,0;3,0\n4,0;5,0;6,0\n"),
        ("a.txt", "1,0 2,0 3,0\n4,0 5,0 6,0\n"),
        ("a.txt", "// by hand\n1|2|3\n4|5|6 // last\n"),
        ("a.pts", "2\n1 2 3 -900 10 20 30\n4 5 6 -800 40 50 60\n"),
        ("a.asc", "\ufeffx y z\n1e0 2 3\n4 5 6"),
    ],
)
def test_tables_of_many_kinds(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    cloud = read_points(tmp_path / name)
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    if name == "a.pts":
        np.testing.assert_array_equal(cloud.colors, [[10, 20, 30], [40, 50, 60]])


def test_a_bad_line_of_a_table_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_text("# points\n1 2 3\n4 5 6\n7 eight 9\n")
    with pytest.raises(InputError, match="line 4 is not a row of numbers"):
        read_points(tmp_path / "a.xyz")


def test_npz_keeps_all_that_a_cloud_has(tmp_path: Path) -> None:
    points, colors = box_points(5), box_colors(5)
    poses = np.stack([np.eye(4)] * 2)
    extra = {"labels": np.arange(5) - 1, "poses": poses, "pose_of": [0, 0, 1, 1, -1], "shift": [1e6, 0, 0]}
    np.savez(tmp_path / "a.npz", points=points, colors=colors, **extra)
    cloud = read_points(tmp_path / "a.npz")
    np.testing.assert_allclose(cloud.points + cloud.shift, points + np.array((1e6, 0, 0)), atol=1e-3)
    np.testing.assert_array_equal(cloud.labels, extra["labels"])
    np.testing.assert_array_equal(cloud.pose_of, extra["pose_of"])
    np.testing.assert_array_equal(cloud.poses, poses)


@cache
def whole(path: Path) -> PointCloud:
    return read_points(path)


@pytest.mark.parametrize("name", ["ascii.ply", "little.ply", "binary.pcd", "table.xyz", "array.npy", "cloud.laz", "cloud.e57"])
@pytest.mark.parametrize("chunk", [7, 100, 600, 10_000])
def test_chunks_join_to_the_whole(samples: dict[str, Path], name: str, chunk: int) -> None:
    cloud = whole(samples[name])
    chunks = list(read_chunks(samples[name], chunk=chunk))
    assert all(len(c) == chunk for c in chunks[:-1])
    np.testing.assert_array_equal(np.concatenate([c.points for c in chunks]), cloud.points)
    assert all(np.array_equal(c.shift, cloud.shift) for c in chunks)
    if cloud.colors is not None:
        np.testing.assert_array_equal(np.concatenate([c.colors for c in chunks if c.colors is not None]), cloud.colors)
    if cloud.pose_of is not None:
        np.testing.assert_array_equal(np.concatenate([c.pose_of for c in chunks if c.pose_of is not None]), cloud.pose_of)
        assert all(np.array_equal(c.poses, cloud.poses) for c in chunks)


@pytest.mark.parametrize(
    "name", [*COLORED, "cloud.laz", "cloud.e57", "table.xyz", "array.npy", "tree.bt", "mesh.obj", "plan.yaml"]
)
def test_blocks_join_to_the_whole(samples: dict[str, Path], name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    cloud = read_points(samples[name])
    from topomerge.io import arrays, e57, grid, las, mesh, octomap, pcd, ply, text

    for module in (arrays, e57, grid, las, mesh, octomap, pcd, ply):
        monkeypatch.setattr(module, "BLOCK_POINTS", 77)
    monkeypatch.setattr(text, "LINES_A_TIME", 77)
    monkeypatch.setattr(e57, "read", e57.read_in_process)  # its process would not know of the smaller blocks
    parts = read_points(samples[name])
    if name == "mesh.obj":  # smaller blocks cut its large triangles, and each part has a lattice of its own
        assert len(parts) == pytest.approx(len(cloud), rel=0.05)
        return
    np.testing.assert_array_equal(parts.points, cloud.points)
    for values in ("colors", "pose_of"):
        np.testing.assert_array_equal(getattr(parts, values), getattr(cloud, values))


def test_e57_range_and_angles() -> None:
    from topomerge.io.e57 import _convert_to_cartesian

    spherical = np.array([[2, 0, 0], [2, np.pi / 2, 0], [2, 0, np.pi / 2]])
    np.testing.assert_allclose(_convert_to_cartesian(spherical), [[2, 0, 0], [0, 2, 0], [0, 0, 2]], atol=1e-12)
