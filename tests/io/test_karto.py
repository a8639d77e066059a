"""Pose graphs of slam_toolbox, written by Boost itself (`karto_archive.cpp`): read, moved, and refused."""

from __future__ import annotations

import struct
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from topomerge.errors import InputError
from topomerge.io.boost_archive import write_archive
from topomerge.io.karto import SCAN, WHOLE, build_planar_pose, get_pose, parse_karto_graph, read_karto_graph
from topomerge.io.native import NATIVE, Doubt, Motion, Source, find_format, plan_outputs, save_joined
from topomerge.io.points import read_points
from topomerge.types import transform_points

HERE = Path(__file__).parent
LASER = (0.1, 0.0)  # m, on the robot
MOTION = np.array([[0.8, -0.6, 0, 5.0], [0.6, 0.8, 0, -3.0], [0, 0, 1, 0.5], [0, 0, 0, 1]])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with zipfile.ZipFile(HERE / "karto_archives.zip") as archive:
        archive.extractall(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", ["room", "old"])  # since 2019, and before, with a scan that was taken out
def test_scans_lie_where_the_graph_puts_them(folder: Path, name: str) -> None:
    cloud = read_points(folder / f"{name}.posegraph")
    points = cloud.points + cloud.shift
    assert not cloud.warnings and points.shape == (6 * 35, 3)  # one reading of each scan is infinite
    wall = np.minimum(np.abs(points[:, :2] - (-2, -2)), np.abs(points[:, :2] - (6, 3))).min(axis=1)
    assert wall.max() < 1e-6 and np.ptp(points[:, 2]) == 0
    assert cloud.poses is not None and cloud.pose_of is not None
    k = np.arange(6)
    heading = 0.05 * k
    np.testing.assert_allclose(cloud.poses[:, 0, 3], 0.5 * k + LASER[0] * np.cos(heading), atol=1e-12)
    np.testing.assert_allclose(np.arctan2(cloud.poses[:, 1, 0], cloud.poses[:, 0, 0]), heading, atol=1e-12)
    assert np.bincount(cloud.pose_of).tolist() == [35] * 6


def test_links_and_their_covariance_are_read(folder: Path) -> None:
    graph = read_karto_graph(folder / "room.posegraph")
    assert list(graph.scans) == list(range(6)) and graph.scans[3]["time"] == 103
    assert sorted(map(tuple, graph.links.tolist())) == [(0, 1), (0, 4), (1, 2), (2, 3), (3, 4), (4, 5)]
    link = graph.archives[0].found["LinkInfo"][0]
    np.testing.assert_array_equal(link["covariance"]["rows"], np.diag([0.01, 0.02, 0.03]))


def test_scans_without_a_link_are_left_out(folder: Path) -> None:
    cloud = read_points(folder / "apart.posegraph")
    assert "2 of its 6 scans are joined with the others by no link; left out" in cloud.warnings[0]
    assert cloud.poses is not None and len(cloud.poses) == 4


@pytest.mark.parametrize("name", ["room", "old"])
def test_a_moved_graph_differs_in_its_poses_only(folder: Path, name: str) -> None:
    source, target = folder / f"{name}.posegraph", folder / f"{name}_moved.posegraph"
    (planned,) = plan_outputs([Source(source)], folder)
    assert planned[0] == target
    tally = save_joined(NATIVE["karto"], [Source(source, Motion(MOTION))], target)
    assert tally.counts == {"scans": (6, 6), "links": (6, 6)}
    before, after = read_points(source), read_points(target)
    moved = transform_points(MOTION, before.points + before.shift)
    np.testing.assert_allclose((after.points + after.shift)[:, :2], moved[:, :2], atol=2e-6)
    old, new = read_karto_graph(source), read_karto_graph(target)
    for was, now in zip(old.archives, new.archives, strict=True):
        assert len(was.data) == len(now.data)
        for a, b in zip(was.found[SCAN], now.found[SCAN], strict=True):
            assert (a["id"], a["odometry"]["place"]["x"]) == (b["id"], b["odometry"]["place"]["x"])
            np.testing.assert_array_equal(a["ranges"], b["ranges"])
            pose = np.array(get_pose(a["pose"]))
            np.testing.assert_allclose(get_pose(b["pose"])[:2], MOTION[:2, :2] @ pose[:2] + MOTION[:2, 3], rtol=0, atol=1e-12)
            assert get_pose(b["pose"])[2] == pytest.approx(pose[2] + np.arctan2(0.6, 0.8), abs=1e-12)
            for kind in ("points", "all_points"):
                there = a[kind] @ MOTION[:2, :2].T + MOTION[:2, 3]
                seen = np.isfinite(a[kind]).all(axis=1)
                np.testing.assert_allclose(b[kind][seen], there[seen], rtol=0, atol=1e-9)
            box = [[b["box"][end][axis] for axis in "xy"] for end in ("low", "high")]
            assert (b["points"] >= box[0]).all() and (b["points"] <= box[1]).all()
        for a, b in zip(was.found["LinkInfo"], now.found["LinkInfo"], strict=True):
            assert get_pose(a["difference"]) == get_pose(b["difference"])
            np.testing.assert_array_equal(a["covariance"]["rows"], b["covariance"]["rows"])
            assert get_pose(b["b"])[2] == pytest.approx(get_pose(a["b"])[2] + np.arctan2(0.6, 0.8), abs=1e-12)


def test_what_does_not_move_stays_to_the_byte(folder: Path) -> None:
    save_joined(NATIVE["karto"], [Source(folder / "room.posegraph")], folder / "same.posegraph")
    for suffix in (".posegraph", ".data"):
        assert (folder / f"same{suffix}").read_bytes() == (folder / f"room{suffix}").read_bytes()


@pytest.mark.parametrize("name", ["room", "apart", "old"])
def test_what_is_written_again_is_what_boost_wrote_to_the_byte(folder: Path, name: str) -> None:
    path = folder / f"{name}.posegraph"
    files = [file.read_bytes() for file in (path, path.with_suffix(".data"))]
    graph = parse_karto_graph(path, files, WHOLE)
    assert [write_archive(root, [archive]) for root, archive in zip(graph.roots, graph.archives, strict=True)] == files


@pytest.mark.parametrize("name", ["room", "old"])
def test_graphs_of_one_laser_become_one(folder: Path, name: str) -> None:
    """`./new joined` and `./old joined` of `karto_archive.cpp` open these with Boost 1.74, too."""
    path = folder / f"{name}.posegraph"
    sources = [Source(path), Source(path, Motion(MOTION)), Source(path)]
    ((target, form, members),) = plan_outputs(sources, folder)
    assert target.name == "joined.posegraph" and members == sources
    tally = save_joined(form, sources, target, Doubt(0.1, 0.02))
    assert tally.counts["scans"] == (18, 18) and tally.counts["links between sessions"] == (6, 6)
    joined, alone = (parse_karto_graph(p, [p.read_bytes(), p.with_suffix(".data").read_bytes()], WHOLE) for p in (target, path))
    scans = list(joined.scans.values())
    assert len({scan["state"] for scan in scans}) == 18 and joined.find_largest_part() == list(joined.scans)
    poses, before = (np.array([build_planar_pose(*pose) for pose in graph.place_scans()]) for graph in (joined, alone))
    for k, motion in enumerate([np.eye(4), MOTION, np.eye(4)]):
        np.testing.assert_allclose(poses[6 * k : 6 * k + 6, :2], (motion @ before)[:, :2], atol=1e-12)
        for a, b in zip(scans[6 * k : 6 * k + 6], alone.scans.values(), strict=True):
            np.testing.assert_array_equal(a["ranges"], b["ranges"])
            assert (a["time"], get_pose(a["odometry"])) == (b["time"], get_pose(b["odometry"]))
    mapper, data = joined.roots
    (manager,) = [own for _, own in mapper["manager"]["managers"]]
    held = [scan for scan in (e[1] if isinstance(e, tuple) else e for e in manager["scans"]) if scan]
    assert [s["id"] for s in held] == list(joined.scans) and manager["next"] == 1 + max(s["state"] for s in scans)
    assert mapper["manager"]["next"] == 1 + max(joined.scans) and [k for k, _ in data["data"]] == list(joined.scans)
    number = {id(scan): k for k, scan in enumerate(scans)}
    for link in mapper["graph"]["edges"]:
        a, b = number[id(link["a"]["scan"])], number[id(link["b"]["scan"])]
        assert link in link["a"]["edges"] and link in link["b"]["edges"]
        if a // 6 != b // 6:
            relative = build_planar_pose(*get_pose(link["link"]["difference"]))
            np.testing.assert_allclose((poses[a] @ relative)[:2], poses[b][:2], atol=1e-9)
            np.testing.assert_allclose(link["link"]["covariance"]["rows"], np.diag([0.01, 0.01, 0.0004]))


def test_graphs_of_two_lasers_are_moved_each_for_itself(folder: Path) -> None:
    for suffix, was, now in ((".posegraph", b"", b""), (".data", struct.pack("<d", 12.0), struct.pack("<d", 11.0))):
        data = (folder / f"room{suffix}").read_bytes()
        (folder / f"other{suffix}").write_bytes(data.replace(was, now) if was else data)
    (folder / "cut.posegraph").write_bytes((folder / "room.posegraph").read_bytes() + b"later")  # of a version with more in it
    (folder / "cut.data").write_bytes((folder / "room.data").read_bytes())
    names = ["room", "other", "cut", "old", "room"]
    plan = plan_outputs([Source(folder / f"{name}.posegraph") for name in names], folder)
    assert [(path.name, len(of)) for path, _, of in plan] == [
        ("joined.posegraph", 2), ("other_moved.posegraph", 1), ("cut_moved.posegraph", 1), ("old_moved.posegraph", 1),
    ]  # fmt: skip


def test_a_tilted_map_is_refused(folder: Path) -> None:
    tilted = np.eye(4)
    tilted[1:3, 1:3] = (0.8, -0.6), (0.6, 0.8)
    with pytest.raises(InputError, match="its map is tilted"):
        save_joined(NATIVE["karto"], [Source(folder / "room.posegraph", Motion(tilted))], folder / "x.posegraph")
    assert not (folder / "x.posegraph").exists() and not (folder / "x.data").exists()


def test_what_belongs_together_is_asked_for(folder: Path) -> None:
    with pytest.raises(InputError, match=r"belongs to room\.posegraph; give that file"):
        read_points(folder / "room.data")
    assert find_format(folder / "room.data") is None
    with pytest.raises(InputError, match=r"room: unknown suffix \(none\); give room\.posegraph$"):
        read_points(folder / "room")
    with pytest.raises(InputError, match=r"room\.data: give room\.posegraph, beside which it lies$"):
        plan_outputs([Source(folder / "room.data")], folder)
    (folder / "room.data").rename(folder / "other.data")
    with pytest.raises(InputError, match=r"room\.data is not beside it"):
        read_points(folder / "room.posegraph")


def test_other_archives_are_refused_by_name(folder: Path) -> None:
    path = folder / "room.posegraph"
    good = path.read_bytes()
    cases = {
        b"22 serialization::archive 19 0 0 ": "no binary archive of Boost for 64 bits",
        good[:30] + b"\x05\x00" + good[32:]: "an archive of version 5 of Boost",
        good[:33] + b"\x04" + good[34:]: "an archive of another kind of machine",
        good[:41] + b"\x07" + good[42:]: "version 7 of Mapper",
        good.replace(b"karto::Parameter<kt_bool>", b"karto::Parameter<kt_long>"): "an object of class 'Parameter<long>'",
    }
    for data, reason in cases.items():
        path.write_bytes(data)
        with pytest.raises(InputError, match="map_saver_cli") as refused:
            read_points(path)
        assert reason in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.longer
def test_damaged_files_end_in_one_line(folder: Path) -> None:
    for suffix in (".posegraph", ".data"):
        path = folder / f"room{suffix}"
        good = path.read_bytes()
        rng = np.random.default_rng(3)
        graph = read_karto_graph(folder / "room.posegraph").archives[suffix == ".data"]
        for cut in rng.integers(0, graph.at - 1, 30).tolist():
            path.write_bytes(good[:cut])
            with pytest.raises(InputError):
                read_points(folder / "room.posegraph")
        for at in rng.integers(40, len(good) - 8, 75).tolist():  # a huge number somewhere
            path.write_bytes(good[:at] + b"\xff\xff\xff\x7f" + good[at + 4 :])
            with suppress(InputError):  # nothing else, and no memory
                read_points(folder / "room.posegraph")
        path.write_bytes(good)
