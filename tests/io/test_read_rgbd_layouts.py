"""Posed RGB-D images in the layouts of data sets: one walk in each is one cloud; and what can be wrong with each."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
from PIL import Image

from tests.io.rgbd import (
    CAMERA,
    COLOR,
    NO_POSE,
    ROOM,
    SHAPE,
    WRITERS,
    camera_poses,
    matrix_text,
    poses_all_around,
    write_replica,
    write_scannet,
    write_sens,
)
from tests.io.test_read_folders import refusal_of, refused
from topomerge.extraction.extract import extract
from topomerge.io import read_chunks, read_points
from topomerge.types import PointCloud


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same three images in every layout. Tests copy what they change."""
    folder = tmp_path_factory.mktemp("layouts")
    return {name: write(folder / name / "room", camera_poses()) for name, write in WRITERS.items()}


def a_copy(recordings: dict[str, Path], name: str, folder: Path) -> Path:
    copytree(recordings[name].parent, folder / name)
    return folder / name / recordings[name].name


def test_the_same_cloud_in_every_layout(recordings: dict[str, Path]) -> None:
    """Points, colours, and where each ray starts."""
    clouds: dict[str, PointCloud] = {name: read_points(path) for name, path in recordings.items()}
    expected = clouds["tum"]
    off = np.minimum(np.abs(expected.points), np.abs(expected.points - ROOM)).min(axis=1)
    assert off.max() < 2e-3 and len(expected) > 30_000
    for name, cloud in clouds.items():
        assert cloud.warnings == (), name
        np.testing.assert_allclose(cloud.points, expected.points, atol=1e-5, err_msg=name)
        assert cloud.colors is not None and (cloud.colors == COLOR).all(), name
        assert cloud.poses is not None and cloud.pose_of is not None
        np.testing.assert_array_equal(cloud.pose_of, expected.pose_of)
        np.testing.assert_allclose(cloud.poses, camera_poses(), atol=1e-6, err_msg=name)


def test_chunks_are_the_cloud(recordings: dict[str, Path]) -> None:
    for name, path in recordings.items():
        joined = np.concatenate([c.points for c in read_chunks(path, chunk=7000)])
        np.testing.assert_array_equal(joined, read_points(path).points, err_msg=name)


@cache
def all_around() -> np.ndarray:
    return poses_all_around()


@pytest.mark.longer
def test_the_room_comes_out(tmp_path: Path) -> None:
    """Its floor, its height, and its inside as free space, by the rays of the images."""
    map = extract(read_points(write_replica(tmp_path / "room", all_around())))
    assert len(map.rooms) == 1 and map.free is not None
    assert map.rooms["area"][0] == pytest.approx(12.0, rel=0.1)
    assert map.rooms["height"][0] == pytest.approx(2.5, abs=0.15)
    inside = np.random.default_rng(0).uniform((0.3, 0.3, 0.5), ROOM - (0.3, 0.3, 0.5), (500, 3))
    assert map.free.contains(map.free.locate(inside)).mean() > 0.95


def test_a_recording_may_lie_one_folder_below(recordings: dict[str, Path], tmp_path: Path) -> None:
    a_copy(recordings, "arkit", tmp_path / "one")
    assert len(read_points(tmp_path / "one" / "arkit")) == len(read_points(recordings["arkit"]))
    a_copy(recordings, "scannet", tmp_path / "one" / "arkit")
    (tmp_path / "one" / "arkit" / "scannet" / "room").rename(tmp_path / "one" / "arkit" / "other")
    assert "holds several recordings of RGB-D images (other, room); give one of them" in refusal_of(tmp_path / "one" / "arkit")


@pytest.mark.parametrize("write", [write_scannet, lambda folder, poses: write_sens(folder / "a.sens", poses)])
def test_frames_without_a_pose_are_left_out(tmp_path: Path, write) -> None:
    """Where tracking was lost, ScanNet's poses are -inf."""
    poses = np.stack([NO_POSE, *camera_poses()[1:]])
    cloud = read_points(write(tmp_path / "a", poses))
    assert cloud.warnings == ("1 of 3 depth images have no pose that can be used and are left out",)
    assert cloud.poses is not None and len(cloud.poses) == 2
    lost = refusal_of(write(tmp_path / "b", np.stack([NO_POSE] * 2)))
    assert "none of its 2 depth images has a pose that can be used" in lost


def test_poses_are_theirs(recordings: dict[str, Path]) -> None:
    assert "--poses is of no use to a folder of RGB-D images with their poses" in refusal_of(recordings["replica"], poses="a.txt")


def test_bad_replica(recordings: dict[str, Path], tmp_path: Path) -> None:
    folder = a_copy(recordings, "replica", tmp_path)
    lines = (folder / "traj.txt").read_text().splitlines()
    for text, says in (
        ("\n".join(lines[:2]), "traj.txt: has 2 poses, none for depth000002.png"),
        (
            "\n".join([lines[0], lines[1].replace(lines[1].split()[3], "nan"), lines[2]]),
            "traj.txt: line 2 holds a number that is not",
        ),
        ("1 2 3", "traj.txt: line 1 has 3 numbers"),
        ("\n".join([lines[0], " ".join(["0"] * 16), lines[2]]), "depth000001.png: its pose is not a rotation and a place"),
    ):
        (folder / "traj.txt").write_text(text)
        assert says in refusal_of(folder)
    (folder / "traj.txt").write_text("\n".join(lines))
    camera = json.loads((folder.parent / "cam_params.json").read_text())["camera"]
    for change, says in (
        ({"fx": 0}, "cam_params.json: does not say w h fx fy cx cy and scale of a camera"),
        ({"fx": "a"}, "cam_params.json: does not say"),
        ({"w": 1200, "h": 680}, "depth000000.png: has 640 x 480 pixels, its camera 1200 x 680; mend cam_params.json"),
        ({"cx": 600}, "and a camera of focal lengths 525 525, centre 600 239.5 can't be its own; mend cam_params.json"),
        ({"fx": 5, "fy": 5}, "can't be its own"),
    ):
        (folder.parent / "cam_params.json").write_text(json.dumps({"camera": {**camera, **change}}))
        assert says in refusal_of(folder)
    for text in ("{", "[]", "{}", "[" * 100_000):
        (folder.parent / "cam_params.json").write_text(text)
        refusal_of(folder)
    (folder.parent / "cam_params.json").unlink()
    assert "has no cam_params.json with its camera" in refusal_of(folder)


def test_bad_scannet_export(recordings: dict[str, Path], tmp_path: Path) -> None:
    folder = a_copy(recordings, "scannet", tmp_path)
    stated = folder / "intrinsic" / "intrinsic_depth.txt"
    stated.write_text(matrix_text(np.diag([2.0, 2, 1, 1]) @ CAMERA))  # that of the colours
    assert "can't be its own; mend intrinsic_depth.txt" in refusal_of(folder)
    for text in ("1 2 3", "x", matrix_text(-CAMERA)):
        stated.write_text(text)
        assert refusal_of(folder).startswith(f"{stated}: ")
    stated.unlink()
    assert "intrinsic_depth.txt: no such file, and it belongs to the images" in refusal_of(folder)
    stated.write_text(matrix_text(CAMERA))
    (folder / "pose" / "1.txt").write_text(matrix_text(np.diag([1.0, 1, -1, 1])))
    assert "1.png: its pose is not a rotation and a place" in refusal_of(folder)
    (folder / "pose" / "1.txt").write_text("1 0 0 0\n")
    assert "1.txt: is not four rows of four numbers" in refusal_of(folder)
    (folder / "pose" / "1.txt").unlink()
    assert read_points(folder).warnings == ("1 of 3 depth images have no pose that can be used and are left out",)
    image = folder / "depth" / "2.png"
    image.write_bytes(image.read_bytes()[: image.stat().st_size // 2])
    assert refusal_of(folder).startswith(f"{image}: damaged")
    Image.fromarray(np.ones(SHAPE, np.uint8)).save(image)
    assert refusal_of(folder).startswith(f"{image}: is no 16-bit depth image")


def test_bad_3rscan(recordings: dict[str, Path], tmp_path: Path) -> None:
    folder = a_copy(recordings, "3rscan", tmp_path)
    assert len(read_points(folder / "sequence")) == len(read_points(folder))
    pose = folder / "sequence" / "frame-000000.pose.txt"
    pose.write_text("-1.#IND " * 16)
    assert read_points(folder).warnings == ("1 of 3 depth images have no pose that can be used and are left out",)
    info = folder / "sequence" / "_info.txt"
    text = info.read_text()
    for old, new in (
        ("m_depthShift = 1000", ""),
        ("m_depthShift = 1000", "m_depthShift = 0"),
        ("m_depthWidth = 640", "m_depthWidth ="),
    ):
        info.write_text(text.replace(old, new))
        assert refusal_of(folder).startswith(f"{info}: does not state the camera of depth")
    info.write_text(text.replace("m_depthWidth = 640", "m_depthWidth = 224"))
    assert "has 640 x 480 pixels, its camera 224 x 480; mend _info.txt" in refusal_of(folder)
    info.write_text(text)
    image = folder / "sequence" / "frame-000001.depth.pgm"
    image.write_bytes(image.read_bytes()[:-100])
    assert refusal_of(folder).startswith(f"{image}: damaged")


def test_bad_arkitscenes(recordings: dict[str, Path], tmp_path: Path) -> None:
    folder = a_copy(recordings, "arkit", tmp_path)
    whole = len(read_points(folder))
    sure = next((folder / "confidence").iterdir())
    Image.fromarray(np.zeros(SHAPE, np.uint8)).save(sure)
    assert len(read_points(folder)) < 0.8 * whole, "what the device was not sure of is left out"
    track = folder / "lowres_wide.traj"
    lines = track.read_text().splitlines()
    for text, says in (
        ("\n".join([lines[1], lines[0]]), "lowres_wide.traj: the clock runs backwards at line 2"),
        (lines[0].replace(lines[0].split()[2], "nan"), "lowres_wide.traj: line 1 holds a number that is not finite"),
        ("1 2 3", "lowres_wide.traj: line 1 has 3 numbers; a line of lowres_wide.traj has 7"),
        ("", "lowres_wide.traj: holds no poses"),
        ("1 0 0 0 0 0 0", "none of its 3 depth images has a pose that can be used"),
    ):
        track.write_text(text)
        assert says in refusal_of(folder)
    track.write_text("\n".join(lines))
    calibration = sorted((folder / "lowres_wide_intrinsics").iterdir())[0]
    calibration.write_text("256 192 211 211 127 95")
    assert "has 640 x 480 pixels, its camera 256 x 192; mend" in refusal_of(folder)
    calibration.write_text("256 192")
    assert refusal_of(folder).startswith(f"{calibration}: is not width height fx fy cx cy")
    calibration.unlink()
    assert "has no calibration in lowres_wide_intrinsics at its time" in refusal_of(folder)
    track.unlink()
    assert "lowres_wide.traj" in refusal_of(folder)
    (next((folder / "lowres_depth").iterdir())).rename(folder / "lowres_depth" / "a.png")
    track.write_text("\n".join(lines))
    assert "a.png: has no time (s) at the end of its name" in refusal_of(folder)


def test_sens_with_raw_depth(recordings: dict[str, Path], tmp_path: Path) -> None:
    path = write_sens(tmp_path / "a.sens", camera_poses(), depth_kind=0)
    np.testing.assert_array_equal(read_points(path).points, read_points(recordings["sens"]).points)


def test_bad_sens(recordings: dict[str, Path], tmp_path: Path) -> None:
    data = recordings["sens"].read_bytes()
    path = tmp_path / "a.sens"

    def said_of(changed: bytes) -> str:
        path.write_bytes(changed)
        said = refusal_of(path)
        assert said.startswith(f"{path}: ")
        return said

    for length in (2, 10, 100, 300):
        assert "ends within its header" in said_of(data[:length])
    assert "ends within frame 0 of 3" in said_of(data[:5000])
    assert "ends within frame 2 of 3" in said_of(data[: len(data) - 500])
    assert "is of version 5 of .sens, only 4 is read" in said_of(b"\5" + data[1:])
    assert "damaged, or not a ScanNet recording" in said_of(data[:4] + b"\xff" * 8 + data[12:])
    kinds = 16 + 256  # where the header says how colours and depth are compressed
    assert "its depth is compressed in the way 2 (occi)" in said_of(data[: kinds + 4] + b"\2" + data[kinds + 5 :])
    assert "frames of 0 x 480 pixels" in said_of(data[: kinds + 16] + bytes(4) + data[kinds + 20 :])
    assert "the depth of frame 0 has 614,400 of" in said_of(data[: kinds + 20] + b"\xf0\x01" + data[kinds + 22 :])
    assert "its calibration: focal lengths" in said_of(data[:16] + bytes(256) + data[kinds:])
    frame = data.index(b"\x78\x9c", kinds)  # the first depth as zlib has it
    assert "the depth of frame 0: Error -3" in said_of(data[:frame] + b"\xff" * 8 + data[frame + 8 :])
    write_sens(path, camera_poses(), camera=np.diag([2.0, 2, 1, 1]) @ CAMERA)
    assert "frame 0: has 640 x 480 pixels, and a camera of" in refusal_of(path)


@pytest.mark.longer
def test_damaged_sens(recordings: dict[str, Path], tmp_path: Path) -> None:
    """Points or one line, whatever is flipped."""
    data = recordings["sens"].read_bytes()
    path = tmp_path / "damaged.sens"
    rng = np.random.default_rng(1)
    for _ in range(40):
        broken = bytearray(data)
        for at in rng.integers(0, 500, 3):
            broken[at] = int(rng.integers(256))
        path.write_bytes(bytes(broken))
        said = refused(path)
        assert said is None or (said.startswith(f"{path}: ") and "\n" not in said)
