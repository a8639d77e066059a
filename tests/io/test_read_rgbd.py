"""Posed RGB-D images in the layout of the TUM benchmark."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from tests.io.rgbd import ROOM, camera_poses, write_tum_images
from tests.io.test_read_folders import refusal_of
from topomerge.io import read_points


def write_rgbd(folder: Path) -> Path:
    return write_tum_images(folder, camera_poses())


def test_images_show_the_room(tmp_path: Path) -> None:
    """Every point lies on a wall of the room; rays start where the camera was."""
    cloud = read_points(write_rgbd(tmp_path / "room"))
    off = np.minimum(np.abs(cloud.points), np.abs(cloud.points - ROOM)).min(axis=1)
    assert off.max() < 1e-3 and len(cloud) > 30_000
    assert cloud.colors is not None and (cloud.colors == (10, 20, 30)).all()
    assert cloud.poses is not None and cloud.pose_of is not None
    np.testing.assert_allclose(cloud.poses[:, :3, 3], camera_poses()[:, :3, 3], atol=1e-6)
    assert np.bincount(cloud.pose_of).min() > 5000
    assert [w for w in cloud.warnings if "its camera is not known" in w]


def test_the_camera_may_be_stated(tmp_path: Path) -> None:
    folder = write_rgbd(tmp_path / "a")
    (folder / "camera.txt").write_text("525 525 319.5 239.5 2500\n")
    doubled = read_points(folder)
    assert not [w for w in doubled.warnings if "camera" in w]
    at = camera_poses()[0, :3, 3]
    first = read_points(write_rgbd(tmp_path / "freiburg1_room"))
    assert not [w for w in first.warnings if "camera" in w]
    assert np.linalg.norm(doubled.points[:100] - at, axis=1).min() > np.linalg.norm(first.points[:100] - at, axis=1).max()
    for text in ("1 2 3", "x", "0 1 1 1", "nan 1 1 1"):
        (folder / "camera.txt").write_text(text)
        assert "camera.txt: " in refusal_of(folder)


def test_bad_folders_of_images(tmp_path: Path) -> None:
    folder = write_rgbd(tmp_path / "a")
    image = next((folder / "depth").iterdir())
    names = (folder / "depth.txt").read_text().splitlines()

    def said_of(lines: list[str]) -> str:
        (folder / "depth.txt").write_text("\n".join(lines))
        return refusal_of(folder)

    assert "depth.txt: the clock runs backwards at line 2" in said_of([names[2], names[1]])
    assert "depth.txt: line 1 is not a time" in said_of(["depth/a.png"])
    assert "line 1 names a file outside of the folder" in said_of(["1 ../../etc/passwd"])
    assert "depth.txt: names no images" in said_of(["# nothing"])
    assert "no depth image has a pose within 0.2 s" in said_of(["1 depth/a.png"])
    assert "no such file, but its list names it" in said_of([names[1].replace("depth/", "depth/x")])
    assert "is no 16-bit depth image" in said_of([names[1].replace("depth/", "rgb/").replace(".250000.png", ".260000.png")])
    (folder / "depth.txt").write_text("\n".join(names))
    image.write_bytes(image.read_bytes()[:2000])
    assert refusal_of(folder).startswith(f"{image}: damaged")
    Image.fromarray(np.ones((24, 32), np.uint16)).save(image)
    assert "has 32 x 24 pixels, its camera 640 x 480; state its camera in camera.txt" in refusal_of(folder)
    (folder / "groundtruth.txt").unlink()
    assert "has depth images, but no groundtruth.txt" in refusal_of(folder)
