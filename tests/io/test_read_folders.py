"""Folders of scans with a trajectory: points, sensor's places, and what can be wrong with them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.io.walks import Walk, room_walk, write_kitti, write_scan, write_scans, write_tum
from topomerge.errors import InputError
from topomerge.io import read_chunks, read_points
from topomerge.io.scan_folder import parse_name_time
from topomerge.io.trajectory import Trajectory, read_trajectory
from topomerge.types import PointCloud


@pytest.fixture
def walk() -> Walk:
    return room_walk()


def assert_same(cloud: PointCloud, walk: Walk) -> None:
    """The cloud is the walk, with the place of the sensor for each point."""
    np.testing.assert_allclose(cloud.points, np.concatenate(walk.world), atol=1e-5)
    assert cloud.poses is not None and cloud.pose_of is not None
    np.testing.assert_allclose(cloud.poses[cloud.pose_of][:, :3, 3], walk.poses[walk.cloud().pose_of][:, :3, 3], atol=1e-6)


@pytest.mark.parametrize("kind", ["bin", "ply", "pcd"])
@pytest.mark.parametrize(
    ("name", "named"), [("poses.txt", "number"), ("0_poses_tum.txt", "time"), ("traj_lidar.txt", "nanoseconds")]
)
def test_a_folder_is_the_walk(tmp_path: Path, walk: Walk, kind: str, name: str, named: str) -> None:
    write_scans(tmp_path / "a", walk, kind, named)
    write = (
        write_kitti(tmp_path / "a" / name, walk.poses)
        if name == "poses.txt"
        else write_tum(tmp_path / "a" / name, walk.poses, walk.times)
    )
    assert_same(read_points(tmp_path / "a"), walk)
    write.rename(tmp_path / "elsewhere.txt")
    assert_same(read_points(tmp_path / "a", poses=str(tmp_path / "elsewhere.txt")), walk)


def test_chunks_are_the_cloud(tmp_path: Path, walk: Walk) -> None:
    write_scans(tmp_path / "a", walk)
    write_kitti(tmp_path / "a" / "poses.txt", walk.poses)
    cloud, chunks = read_points(tmp_path / "a"), list(read_chunks(tmp_path / "a", chunk=700))
    np.testing.assert_array_equal(np.concatenate([c.points for c in chunks]), cloud.points)
    places = [c.poses[c.pose_of][:, :3, 3] for c in chunks if c.poses is not None]
    assert cloud.poses is not None
    np.testing.assert_array_equal(np.concatenate(places), cloud.poses[cloud.pose_of][:, :3, 3])


def test_the_scans_may_lie_below_and_the_trajectory_above(tmp_path: Path, walk: Walk) -> None:
    write_scans(tmp_path / "00" / "velodyne", walk)
    write_kitti(tmp_path / "00" / "poses.txt", walk.poses)
    assert_same(read_points(tmp_path / "00"), walk)
    assert_same(read_points(tmp_path / "00" / "velodyne"), walk)


def test_poses_of_a_camera_become_those_of_the_laser(tmp_path: Path, walk: Walk) -> None:
    laser = np.eye(4)
    laser[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]  # camera: x right, y down, z ahead
    laser[:3, 3] = (0.1, -0.2, -0.3)
    relative = np.linalg.inv(walk.poses[0]) @ walk.poses
    write_scans(tmp_path, walk)
    write_kitti(tmp_path / "poses.txt", laser @ relative @ np.linalg.inv(laser))
    numbers = " ".join(f"{v:.17g}" for v in laser[:3].ravel())
    (tmp_path / "calib.txt").write_text(f"P0: {' '.join('0' * 12)}\nTr: {numbers}\n")
    assert_same(read_points(tmp_path), Walk(walk.scans, relative, walk.times))


def test_viewpoints_of_pcd_files_need_no_trajectory(tmp_path: Path, walk: Walk) -> None:
    for number, (points, pose) in enumerate(zip(walk.world, walk.poses, strict=True)):
        write_scan(tmp_path / f"{number}.pcd", points, pose)
    assert_same(read_points(tmp_path), walk)


def test_numbers_pick_poses_where_scans_are_missing(tmp_path: Path, walk: Walk) -> None:
    paths = write_scans(tmp_path, walk)
    write_kitti(tmp_path / "poses.txt", walk.poses)
    paths[0].unlink()
    assert_same(read_points(tmp_path), Walk(walk.scans[1:], walk.poses[1:], walk.times[1:]))


def test_scans_are_counted_and_times_are_seconds(tmp_path: Path, walk: Walk) -> None:
    """KISS-ICP's TUM files of numbered scans: the numbers are no times, even where some would fit."""
    write_scans(tmp_path, walk)
    write_tum(tmp_path / "0_poses_tum.txt", walk.poses, np.array([0.0, 0.1, 0.2]))
    assert_same(read_points(tmp_path), walk)


def test_scans_far_from_any_pose_are_left_out(tmp_path: Path, walk: Walk) -> None:
    late = Walk(walk.scans, walk.poses, walk.times + [0, 0, 5])
    write_scans(tmp_path, late, named="time")
    write_tum(tmp_path / "a.tum", walk.poses, walk.times)
    cloud = read_points(tmp_path)
    assert_same(cloud, walk.part(2))
    assert cloud.warnings == ("1 of 3 scans are more than 0.2 s from any pose of a.tum and are left out",)


def test_returns_that_met_nothing_are_left_out(tmp_path: Path, walk: Walk) -> None:
    write_scans(
        tmp_path, Walk([np.vstack([s, np.zeros((5, 3)), np.full((5, 3), np.nan)]) for s in walk.scans], walk.poses, walk.times)
    )
    write_kitti(tmp_path / "poses.txt", walk.poses)
    cloud = read_points(tmp_path)
    assert_same(cloud, walk)
    assert cloud.warnings == ()


@pytest.mark.parametrize(
    ("stem", "time"),
    [
        ("000017", 17),
        ("scan_17", 17),
        ("1570513628_110666000", 1570513628.110666),
        ("1570513628.110666", 1570513628.110666),
        ("cloud_1570513628.5", 1570513628.5),
        ("1570513628110666000", 1570513628.110666),
        ("1570513628110666", 1570513628.110666),
        ("1570513628110", 1570513628.11),
        ("12.5", 12.5),
        ("1234567.12345", 1234567.12345),
        ("cloud", None),
    ],
)
def test_times_in_names(stem: str, time: float | None) -> None:
    assert parse_name_time(stem) == (None if time is None else pytest.approx(time, abs=1e-6))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-50, 50), min_size=9, max_size=9), st.floats(0, 1), st.floats(-1, 2))
def test_poses_between_two(values: list[float], share: float, beyond: float) -> None:
    """A sensor that turns and moves evenly is met at every time; before and after, the ends hold on."""
    start, turn, way = (np.array(values[i : i + 3]) for i in (0, 3, 6))
    turn = turn * min(1.0, 3.0 / (np.linalg.norm(turn) + 1e-9))  # less than half a turn

    def pose(s: float) -> np.ndarray:
        out = np.eye(4)
        out[:3, :3] = (Rotation.from_rotvec(start / 20) * Rotation.from_rotvec(turn * s)).as_matrix()
        out[:3, 3] = start + way * s
        return out

    track = Trajectory(np.stack([pose(0.0), pose(1.0)]), np.array([10.0, 12.0]))
    np.testing.assert_allclose(track.interpolate(np.array([10 + 2 * share]))[0], pose(share), atol=1e-6)
    np.testing.assert_allclose(track.interpolate(np.array([10 + 2 * beyond]))[0], pose(float(np.clip(beyond, 0, 1))), atol=1e-6)
    assert track.measure_gap(np.array([10 + 2 * share]))[0] == pytest.approx(2 * min(share, 1 - share))
    one = Trajectory(track.poses[:1], track.times[:1])  # type: ignore[index]
    np.testing.assert_allclose(one.interpolate(np.array([11.0]))[0], pose(0.0), atol=1e-9)
    assert one.measure_gap(np.array([11.0]))[0] == pytest.approx(1.0)


TUM_LINE = "%.3f 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "holds no poses"),
        ("1 2 3\n", "line 1 has 3 numbers; a line of KITTI has 12, one of TUM has 8"),
        (TUM_LINE % 1 + "1 2 3\n", "line 2 has 3 numbers"),
        ("x 0 0 0 0 0 0 1\n", "line 1 is not a row of numbers"),
        (TUM_LINE % 1 + "2 nan 0 0 0 0 0 1\n", "line 2 holds a number that is not finite"),
        ("# t\n" + TUM_LINE % 2 + TUM_LINE % 1, "the clock runs backwards at line 3 (1.000 after 2.000)"),
        ("1 0 0 0 0 0 0 0\n", "line 1 has no unit quaternion"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n" + "0 " * 12 + "\n", "line 2 is not a rotation and a place"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "line 1 is not a rotation and a place"),
    ],
)
def test_bad_trajectories(tmp_path: Path, walk: Walk, text: str, says: str) -> None:
    write_scans(tmp_path / "a", walk)
    (tmp_path / "bad.txt").write_text(text)
    with pytest.raises(InputError, match=re.escape(says)) as refusal:
        read_points(tmp_path / "a", poses=str(tmp_path / "bad.txt"))
    assert str(refusal.value).startswith(f"{tmp_path / 'bad.txt'}: ") and "\n" not in str(refusal.value)


def test_bad_calibrations(tmp_path: Path) -> None:
    write_kitti(tmp_path / "poses.txt", np.eye(4)[None])
    for text in ("Tr: 1 2 3", "Tr: " + "0 " * 12, "Tr: " + "nan " * 12):
        (tmp_path / "calib.txt").write_text(text)
        with pytest.raises(InputError, match=r"calib.txt: line 1 .*remove the file"):
            read_trajectory(tmp_path / "poses.txt")


def refusal_of(path: Path, **options: str | float) -> str:
    with pytest.raises(InputError) as refusal:
        read_points(path, **options)
    assert "\n" not in str(refusal.value)
    return str(refusal.value)


def refused(path: Path, **options: str | float) -> str | None:
    """Why it can't be read; None: it can."""
    try:
        read_points(path, **options)
    except InputError as error:
        return str(error)
    return None


def test_bad_folders(tmp_path: Path, walk: Walk) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "is a folder without scans (ply, pcd, bin)" in refusal_of(empty)
    scans = write_scans(tmp_path / "a", walk)
    assert "no.txt: no such file" in refusal_of(tmp_path / "a", poses="no.txt")
    assert "is a folder; --poses names" in refusal_of(tmp_path / "a", poses=str(empty))
    assert "--poses is empty" in refusal_of(tmp_path / "a", poses=" ")
    says = refusal_of(tmp_path / "a")
    assert says.startswith(f"{tmp_path / 'a'}: has no trajectory") and "--poses" in says
    assert "name the files, if each is a map" in says
    write_kitti(tmp_path / "a" / "poses.txt", walk.poses[:2])
    assert "poses.txt: has 2 poses, fewer than the 3 scans" in refusal_of(tmp_path / "a")
    write_tum(tmp_path / "a" / "poses.txt", walk.poses[:2], walk.times[:2])
    assert "has 2 poses, fewer than the 3 scans" in refusal_of(tmp_path / "a")
    (tmp_path / "a" / "traj_lidar.txt").write_text("")
    write_scan(tmp_path / "a" / "map.ply", walk.scans[0])
    assert "holds scans of several kinds (3 bin, 1 ply)" in refusal_of(tmp_path / "a")
    (tmp_path / "a" / "map.ply").unlink()
    scans[1].write_bytes(scans[1].read_bytes()[:-5])
    write_kitti(tmp_path / "a" / "traj_lidar.txt", walk.poses)
    assert refusal_of(tmp_path / "a").startswith(f"{scans[1]}: ") and "no multiple of 16" in refusal_of(tmp_path / "a")


def test_bad_sets_of_folders(tmp_path: Path, walk: Walk) -> None:
    for name in ("left", "right"):
        write_scans(tmp_path / name, walk, named="time")
    assert "holds several folders of scans (left, right)" in refusal_of(tmp_path)
    for name in ("a_poses_kitti.txt", "b_poses_kitti.txt"):
        write_kitti(tmp_path / "left" / name, walk.poses)
    assert "has several trajectories (a_poses_kitti.txt, b_poses_kitti.txt)" in refusal_of(tmp_path / "left")
    write_tum(tmp_path / "right" / "traj_lidar.txt", walk.poses, walk.times + 1000)
    assert "are not those in the names of the scans" in refusal_of(tmp_path / "right")


def test_damaged_scans_are_named(tmp_path: Path, walk: Walk) -> None:
    for kind in ("ply", "pcd"):
        paths = write_scans(tmp_path / kind, walk, kind)
        write_kitti(tmp_path / kind / "poses.txt", walk.poses)
        data = paths[2].read_bytes()
        for damage in (b"", data[: len(data) // 2], data[:20]):
            paths[2].write_bytes(damage)
            assert refusal_of(tmp_path / kind).startswith(f"{paths[2]}: ")


def test_poses_are_for_scans_only(samples: dict[str, Path]) -> None:
    says = refusal_of(samples["little.ply"], poses="a.txt")
    assert "--poses is of no use to a PLY file, only to" in says and "a folder of scans" in says
