"""Round trips through other programs' formats, as a table: `python -m tests.io.native_round_trips [PAGE]`.

Two small true files of each format are written by the tests' own writers, joined or moved by `topomerge.io.native`, and opened
again by the format's library, or by a reader that shares nothing with the writer. With a page its marked table is written.
"""

from __future__ import annotations

import sqlite3
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tests.io import cartographer_states as carto
from tests.io.test_native import GRAPH, PLANE, TILTED, YAW, quaternions, random_poses, write_lines, write_many_scans
from tests.io.test_native_graphs import flat_graph, moved_back
from tests.io.test_native_rtabmap import poses_of, write_session
from tests.samples import box_colors, box_points, write_las, write_pcd, write_ply
from topomerge.evaluation.documents import build_stamp, write_blocks, write_table
from topomerge.io.karto import build_planar_pose, read_karto_graph
from topomerge.io.native import NATIVE, Motion, Source, Tally, save_joined
from topomerge.io.native.pose_graph import read_pose_graph
from topomerge.types import Array

HEADS = ("format", "in → out", "largest error, m", "opened again by")
Trip = Callable[[Path], tuple[Tally, float, str]]


def join(key: str, folder: Path, *sources: Source) -> tuple[Tally, Path]:
    target = folder / f"out{sources[0].path.suffix}"
    return save_joined(NATIVE[key], sources, target), target


def measure(found: Array, before: Array, motion: Motion) -> float:
    """The largest difference of poses or points from those moved, of all numbers."""
    expected = motion.matrix @ before if before.shape[1:] == (4, 4) else motion.move_points(before)
    return float(np.abs(found - expected).max())


def trip_rtabmap(version: str) -> Trip:
    def trip(folder: Path) -> tuple[Tally, float, str]:
        a, b = (write_session(folder / f"{name}.db", version) for name in "ab")
        tally, out = join("rtabmap", folder, Source(a), Source(b, YAW))
        with closing(sqlite3.connect(out)) as base:
            assert base.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        before, after = poses_of(b), poses_of(out)
        nodes = [k for k in before if k > 0]
        found = np.array([after[k + max(nodes)] for k in nodes])
        return tally, measure(found, np.array([before[k] for k in nodes]), YAW), "SQLite (its integrity check), our reader"

    return trip


def trip_cartographer(spatial: bool) -> Trip:
    def trip(folder: Path) -> tuple[Tally, float, str]:
        motion = TILTED if spatial else YAW
        a = carto.write_messages(folder / "a.pbstream", carto.state(2, spatial=spatial))
        b = carto.write_messages(folder / "b.pbstream", carto.state(1, spatial=spatial, tag="tag 8"))
        tally, out = join("pbstream", folder, Source(a), Source(b, motion))
        before, after = carto.read_messages(b)[1].pose_graph.trajectory[0], carto.read_messages(out)[1].pose_graph.trajectory[2]
        pairs = [(x, y) for kind in ("node", "submap") for x, y in zip(getattr(before, kind), getattr(after, kind), strict=True)]
        old, new = (np.array([carto.matrix(pair[k].pose) for pair in pairs]) for k in (0, 1))
        return tally, measure(new, old, motion), "Google's protobuf"

    return trip


def trip_karto(sessions: int) -> Trip:
    def trip(folder: Path) -> tuple[Tally, float, str]:
        with zipfile.ZipFile(Path(__file__).parent / "karto_archives.zip") as archive:
            archive.extractall(folder)
        room = folder / "room.posegraph"
        tally, out = join("karto", folder, *[Source(room, YAW), Source(room)][:sessions])
        before, after = (
            np.array([build_planar_pose(*pose) for pose in read_karto_graph(path).place_scans()]) for path in (room, out)
        )
        error = np.abs(after - np.concatenate([YAW.matrix @ before, before][:sessions]))[:, :2].max()
        return tally, float(error), "our reader; by hand, Boost 1.74"

    return trip


def read_by_gtsam(path: Path, numbers: list[int], flat: bool) -> Array | None:
    """(n, 4, 4) poses of the vertices of these numbers, as GTSAM reads them; None where it is not installed."""
    try:
        import gtsam
    except ImportError:
        return None
    values = gtsam.readG2o(str(path), not flat)[1]
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    for row, number in enumerate(numbers):
        if flat:
            matrix = values.atPose2(number).matrix()
            poses[row, :2, :2], poses[row, :2, 3] = matrix[:2, :2], matrix[:2, 2]
        else:
            poses[row] = values.atPose3(number).matrix()
    return poses


def trip_g2o(text: str, motion: Motion) -> Trip:
    def trip(folder: Path) -> tuple[Tally, float, str]:
        (folder / "a.g2o").write_text(text)
        tally, out = join("g2o", folder, Source(folder / "a.g2o"), Source(folder / "a.g2o", motion))
        before, after = read_pose_graph(folder / "a.g2o").vertices, read_pose_graph(out).vertices
        posed = [k for k in before if before[k].posed]
        flat = before[posed[0]].tag == "VERTEX_SE2"
        moved = [k + max(before) + 1 for k in posed]
        found = np.array([after[k].pose for k in moved])
        opened = read_by_gtsam(out, moved, flat)
        if opened is not None:
            np.testing.assert_allclose(opened, found, rtol=0, atol=1e-12)
        expected = motion.matrix @ np.array([before[k].pose for k in posed])
        error = np.abs((found - expected)[:, [0, 1] if flat else [0, 1, 2]]).max()
        return tally, float(error), "our reader" if opened is None else "GTSAM, our reader"

    return trip


def trip_dsg(folder: Path) -> tuple[Tally, float, str]:
    import json

    import spark_dsg

    before = flat_graph((1, 2, 3))
    (folder / "a.json").write_text(json.dumps(flat_graph((0, 1, 2))))
    (folder / "b.json").write_text(json.dumps(moved_back(flat_graph((1, 2, 3)), YAW)))
    tally, out = join("dsg", folder, Source(folder / "a.json"), Source(folder / "b.json", YAW))
    graph = spark_dsg.DynamicSceneGraph.load(str(out))
    found = np.array([node.attributes.position for node in graph.nodes])
    expected = np.array([node["attributes"]["position"] for node in before["nodes"]])
    error = max(float(np.abs(found - place).max(axis=1).min()) for place in expected)
    return tally, error, "spark_dsg"


def trip_usdz(count: int) -> Trip:
    def trip(folder: Path) -> tuple[Tally, float, str]:
        from tests.io.test_native_usdz import scan, vertices
        from tests.io.test_usdz import roomplan

        a, b = roomplan(folder / "room.usdz"), scan(folder / "scan.usdz")
        tally, out = join("usdz", folder, *[Source(a, TILTED), Source(b, YAW)][:count])
        expected = [TILTED.move_points(vertices(a)), YAW.move_points(vertices(b))][:count]
        return tally, float(np.abs(vertices(out) - np.concatenate(expected)).max()), "usd-core, our reader"

    return trip


def trip_robot_maps(folder: Path) -> tuple[Tally, float, str]:
    """The error is that of entities; pixels are off by half a pixel."""
    import json

    from tests.io.test_native_robot_maps import home, turn

    motion = turn(180, 0.013, 0.004)
    a, b = home(folder / "a.json", ("Bath", "Hall")), home(folder / "b.json", ("Kitchen", ""))
    tally, out = join("robot_map", folder, Source(a), Source(b, motion))
    before, after = (json.loads(path.read_text())["entities"] for path in (b, out))
    old, new = (
        np.array([xy for entity in listed for xy in zip(entity["points"][::2], entity["points"][1::2], strict=True)])
        / (100, -100)
        for listed in (before, after[-len(before) :])
    )
    expected = motion.move_points(np.column_stack([old, np.zeros(len(old))]))[:, :2]
    return tally, float(np.abs(new - expected).max()), "our reader"


def trip_e57(folder: Path) -> tuple[Tally, float, str]:
    import pye57

    poses = random_poses(3)
    scans = [
        (box_points(200, k).astype(float), quaternions(poses[k : k + 1])[0][[3, 0, 1, 2]], poses[k, :3, 3]) for k in range(3)
    ]
    write_many_scans(folder / "a.e57", scans)
    tally, out = join("e57", folder, Source(folder / "a.e57", TILTED))
    file, found = pye57.E57(str(out)), np.tile(np.eye(4), (3, 1, 1))
    for k in range(3):
        header = file.get_header(k)
        found[k, :3, :3], found[k, :3, 3] = header.rotation_matrix, header.translation
        assert np.array_equal(file.read_scan_raw(k)["cartesianX"], scans[k][0][:, 0])
    file.close()
    return tally, measure(found, poses, TILTED), "pye57; points are equal to the bit"


def trip_cloud(name: str, library: str) -> Trip:
    def trip(folder: Path) -> tuple[Tally, float, str]:
        points, colors, path = box_points(), box_colors(), folder / name
        if path.suffix == ".ply":
            write_ply(path, points, colors, text=False, order="<", kind="f8")
        elif path.suffix == ".pcd":
            write_pcd(path, points, colors, ascii=False, compressed=False)
        else:
            write_las(path, points, colors)
        before = read_places(path)
        key = "las" if path.suffix in (".las", ".laz") else path.suffix[1:]
        tally, out = join(key, folder, Source(path, TILTED))
        return tally, measure(read_places(out), before, TILTED), library

    return trip


def read_places(path: Path) -> Array:
    if path.suffix == ".ply":
        from plyfile import PlyData

        rows = PlyData.read(str(path))["vertex"].data
        return np.stack([np.asarray(rows[axis], float) for axis in "xyz"], axis=1)
    if path.suffix == ".pcd":
        from topomerge.io import read_points

        return read_points(path).points.astype(float)
    import laspy

    las = laspy.read(path)
    return np.stack([np.asarray(v) for v in (las.x, las.y, las.z)], axis=1)


def trip_trajectory(name: str) -> Trip:
    def trip(folder: Path) -> tuple[Tally, float, str]:
        poses = random_poses(200)
        turns, times = quaternions(poses), np.arange(200.0)
        if name == "KITTI":
            source = write_lines(folder / "poses.txt", poses[:, :3].reshape(-1, 12), "%.12e")
        elif name == "TUM":
            source = write_lines(folder / "walk.tum", np.column_stack([times, poses[:, :3, 3], turns]), "%.12f")
        else:
            rows = np.column_stack([1.4e18 + times, poses[:, :3, 3], turns[:, [3, 0, 1, 2]], np.zeros((200, 9))])
            source = write_lines(folder / "data.csv", rows, "%.12f", ",", "#timestamp\n")
        tally, out = join("trajectory", folder, Source(source, TILTED))
        rows = np.loadtxt(out, delimiter="," if name == "EuRoC" else None)
        found = np.tile(np.eye(4), (200, 1, 1))
        if name == "KITTI":
            found[:, :3] = rows.reshape(-1, 3, 4)
        else:
            found[:, :3, 3] = rows[:, 1:4]
            found[:, :3, :3] = Rotation.from_quat(rows[:, 4:8] if name == "TUM" else rows[:, [5, 6, 7, 4]]).as_matrix()
        return tally, measure(found, poses, TILTED), "NumPy, SciPy"

    return trip


TRIPS: dict[str, Trip] = {
    "RTAB-Map 0.17, two sessions": trip_rtabmap("0.17.0"),
    "RTAB-Map 0.23, two sessions": trip_rtabmap("0.23.0"),
    "Cartographer, in a plane, 2 + 1 trajectories": trip_cartographer(False),
    "Cartographer, in space, 2 + 1 trajectories": trip_cartographer(True),
    "slam_toolbox, one session": trip_karto(1),
    "slam_toolbox, two sessions": trip_karto(2),
    "g2o, SE3, two graphs": trip_g2o(GRAPH, TILTED),
    "g2o, SE2, two graphs": trip_g2o(PLANE, YAW),
    "Spark-DSG, two graphs of three rooms, two of them shared": trip_dsg,
    "USDZ, RoomPlan's, one file": trip_usdz(1),
    "USDZ, RoomPlan's and a scanner's of another unit and axis": trip_usdz(2),
    "Valetudo, two maps of the same two rooms; its points are whole cm": trip_robot_maps,
    "E57, three stations": trip_e57,
    "LAS": trip_cloud("a.las", "laspy"),
    "LAZ": trip_cloud("a.laz", "laspy"),
    "PLY, of doubles": trip_cloud("a.ply", "plyfile"),
    "PCD, of floats": trip_cloud("a.pcd", "our reader"),
    "KITTI": trip_trajectory("KITTI"),
    "TUM": trip_trajectory("TUM"),
    "EuRoC": trip_trajectory("EuRoC"),
}


def iter_lines() -> Iterator[tuple[str, str, str, str]]:
    """The lines of the table."""
    for name, trip in TRIPS.items():
        with tempfile.TemporaryDirectory() as folder:
            tally, error, library = trip(Path(folder))
        counts = ", ".join(f"{kind} {a} → {b}" for kind, (a, b) in tally.counts.items() if a or b)
        yield name, counts, f"{error:.0e}" if error else "0", library


def main(words: list[str]) -> None:
    table = write_table(HEADS, iter_lines())
    print(table)
    if words:
        stamp = build_stamp("python -m tests.io.native_round_trips docs/results/native.md", ["topomerge.io.native"], TRIPS)
        write_blocks(Path(words[0]), {"native-round-trips": table}, stamp)


if __name__ == "__main__":
    main(sys.argv[1:])
