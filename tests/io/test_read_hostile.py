"""Recordings and maps that lie: endless work, pipes in the place of images, names of files in the place of images."""

from __future__ import annotations

import json
import os
import sqlite3
import struct
import warnings
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.io.rgbd import CAMERA, camera_poses, color_image, depth_image, matrix_text, write_sens
from tests.io.rtabmap_bases import write_rtabmap
from tests.io.test_read_folders import refusal_of, refused
from tests.io.test_read_rtabmap import depth_nodes, scan_nodes
from tests.io.test_read_valetudo import saved, two_rooms
from tests.io.walks import room_walk
from topomerge.io import read_points
from topomerge.io.valetudo import parse_robot_map


def layers(*runs: list[int]) -> dict[str, object]:
    return two_rooms(layers=[{"type": "segment", "compressedPixels": run} for run in runs])


def test_a_robots_map_that_paints_the_same_pixels_again_and_again(tmp_path: Path) -> None:
    said = refusal_of(saved(tmp_path, layers(*[[0, 0, 90_000_000]] * 40)))
    assert "its layers together have more than 100,000,000 pixels" in said


def test_many_layers_cost_what_their_pixels_do(tmp_path: Path) -> None:
    drawn = parse_robot_map(tmp_path, layers([0, 0, 9], [0, 900, 9], *[[5, 5, 1]] * 20_000))
    assert drawn.free.sum() == 19 and drawn.rooms.max() == 20_002


def test_octrees_that_are_wider_than_numbers(tmp_path: Path) -> None:
    """Neither warnings of NumPy nor a message about them; all levels are read."""
    pytest.importorskip("laspy")
    from tests.io.octrees import room_tree, write_copc, write_ept, write_potree

    def change(file: Path, **values: object) -> Path:
        file.write_text(json.dumps({**json.loads(file.read_text()), **values}))
        return file.parent

    tree = room_tree()
    ept = change(write_ept(tmp_path / "ept", tree, "binary") / "ept.json", bounds=[-1e308] * 3 + [1e308] * 3)
    potree = change(write_potree(tmp_path / "potree", tree) / "cloud.js", spacing=1e300)
    copc = write_copc(tmp_path / "a.copc.laz", tree)
    data = bytearray(copc.read_bytes())
    data[375 + 54 + 32 : 375 + 54 + 40] = struct.pack("<d", 1e308)
    copc.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for path in (ept, potree, copc):
            assert len(read_points(path, spacing=1e-100).points) == len(tree.points)
        box = {f"{end}{axis}": value for end, value in (("l", -1.7e308), ("u", 1.7e308)) for axis in "xyz"}
        assert "bounding box" in refusal_of(change(potree / "cloud.js", boundingBox=box))
        assert "only 1.4 to 1.8 are read" in refusal_of(change(potree / "cloud.js", version="1." + "9" * 5000))


def test_nodes_that_are_named_again_and_again(tmp_path: Path) -> None:
    pytest.importorskip("laspy")
    from tests.io.octrees import room_tree, write_copc, write_ept, write_potree

    tree = room_tree()
    potree = write_potree(tmp_path / "potree", tree, version="1.4")
    values = json.loads((potree / "cloud.js").read_text())
    (potree / "cloud.js").write_text(json.dumps({**values, "hierarchy": values["hierarchy"] * 2}))
    assert "a node is listed twice" in refusal_of(potree)
    copc = write_copc(tmp_path / "a.copc.laz", tree)
    data, info = copc.read_bytes(), 375 + 54
    page = struct.unpack_from("<Q", data, info + 40)[0]
    many = data[page : page + 32] * 2000
    broken = bytearray(data + many)
    struct.pack_into("<2Q", broken, info + 40, len(data), len(many))
    struct.pack_into("<Q", broken, 247, 1 << 60)
    copc.write_bytes(broken)
    assert "its pages and nodes have more than" in refusal_of(copc, spacing=0.01)
    ept = write_ept(tmp_path / "ept", tree, "binary")
    os.truncate(ept / "ept-data" / "0-0-0-0.bin", 1 << 30)
    assert "more than the 360 points that its hierarchy promises" in refusal_of(ept)


def test_potree_2_is_named(tmp_path: Path) -> None:
    """Its `octree.bin` is no scan of KITTI, even where its bytes could be."""
    for name in ("metadata.json", "octree.bin", "hierarchy.bin"):
        (tmp_path / name).write_bytes(bytes(1600))
    assert refusal_of(tmp_path) == (
        f"{tmp_path}: is a Potree 2 point cloud, which is not read; give the LAS or LAZ file that it was made of"
    )


def scannet(folder: Path) -> Path:
    """The export of a recording of one frame."""
    for name in ("depth", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    pose = camera_poses()[0]
    Image.fromarray(depth_image(pose, 1000.0)).save(folder / "depth" / "0.png")
    (folder / "pose" / "0.txt").write_text(matrix_text(pose))
    (folder / "intrinsic" / "intrinsic_depth.txt").write_text(matrix_text(CAMERA))
    return folder


@pytest.mark.parametrize("put", [os.mkfifo, os.mkdir, lambda path: path.symlink_to("/dev/zero")])
def test_a_pipe_in_the_place_of_an_image_is_not_waited_for(tmp_path: Path, put: Callable[[Path], None]) -> None:
    image = scannet(tmp_path) / "depth" / "0.png"
    image.unlink()
    put(image)
    assert refusal_of(tmp_path) == f"{image}: is no regular file (a folder, a pipe or a device); copy the image there"


def test_what_macos_leaves_beside_files_is_no_image_and_no_bag(tmp_path: Path) -> None:
    folder = scannet(tmp_path / "scan")
    (folder / "depth" / "._0.png").write_bytes(b"\0\5\x16\7")
    assert not read_points(folder).warnings
    (tmp_path / "bags").mkdir()
    (tmp_path / "bags" / "._walk.bag").write_bytes(b"\0\5\x16\7")
    assert "is a folder without scans" in refusal_of(tmp_path / "bags")


def test_a_pipe_in_the_place_of_a_bags_listing(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    os.mkfifo(tmp_path / "metadata.yaml")
    assert "holds no bag" in refusal_of(tmp_path)


def test_cameras_without_measure(tmp_path: Path) -> None:
    """A lens of colours or a metre beyond numbers is no reason for warnings of NumPy."""
    path = write_sens(tmp_path / "a.sens", camera_poses()[:1])
    data = path.read_bytes()
    lens = 12 + struct.unpack_from("<Q", data, 4)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for at, value in ((lens, 3e38), (lens + 8, -3e38), (lens + 256 + 24, 1e-44)):
            broken = bytearray(data)
            struct.pack_into("<f", broken, at, value)
            path.write_bytes(broken)
            said = refused(path)
            assert said is None or "holds no points" in said


def test_times_and_cameras_of_data_sets_that_are_no_numbers(tmp_path: Path) -> None:
    folder = tmp_path / "arkit"
    for name in ("lowres_depth", "lowres_wide_intrinsics"):
        (folder / name).mkdir(parents=True)
    (folder / "lowres_wide.traj").write_text("1 0 0 0 0 0 0\n2 0 0 0 0 0 0\n")
    (folder / "lowres_wide_intrinsics" / "a_1.0.pincam").write_text("256 192 200 200 128 96")
    Image.fromarray(np.full((192, 256), 2000, np.uint16)).save(folder / "lowres_depth" / "a_nan.png")
    assert "a_nan.png: has no time (s) at the end of its name" in refusal_of(folder)
    folder = tmp_path / "replica"
    (folder / "results").mkdir(parents=True)
    (folder / "traj.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n")
    (folder / "cam_params.json").write_text("[" * 200_000)
    assert "cam_params.json: does not say" in refusal_of(folder)


def changed(path: Path, *commands: str) -> Path:
    with closing(sqlite3.connect(path)) as base:
        for command in commands:
            base.execute(command)
        base.commit()
    return path


def test_text_in_the_place_of_an_image_is_no_name_of_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    color_image().save(tmp_path / "secret.png")
    path = write_rtabmap(tmp_path / "a.db", depth_nodes(camera_poses()[:1]))
    changed(path, "UPDATE Data SET image = 'secret.png'")
    assert refusal_of(path) == f"{path}: node 1 has text or a number where bytes belong (str); it is damaged"


@pytest.mark.parametrize("cell", ["Node SET pose", "Data SET scan", "Data SET scan_info"])
@pytest.mark.parametrize("value", ["12345678", "'a text of more than four letters'"])
def test_numbers_and_texts_in_the_place_of_bytes(tmp_path: Path, cell: str, value: str) -> None:
    path = changed(write_rtabmap(tmp_path / "a.db", scan_nodes(room_walk())), f"UPDATE {cell} = {value}")
    assert "where bytes belong" in refusal_of(path)


def test_columns_that_a_database_computes(tmp_path: Path) -> None:
    path = write_rtabmap(tmp_path / "a.db", scan_nodes(room_walk()))
    columns = "id INTEGER PRIMARY KEY, image BLOB, depth BLOB, calibration BLOB, scan_info BLOB"
    made = f"CREATE TABLE Data({columns}, scan BLOB GENERATED ALWAYS AS (zeroblob(130000000)) VIRTUAL)"
    changed(path, "DROP TABLE Data", made, "INSERT INTO Data(id) SELECT id FROM Node")
    assert "computes its columns" in refusal_of(path)
