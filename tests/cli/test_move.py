"""`topomerge merge --native` and `topomerge move`: what comes in leaves in its own format, with the new poses."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tests.cli import test_merge_points
from tests.cli.test_merge_points import BENDS, Run, run
from tests.io import test_karto
from tests.io.test_native import PLANE, quaternions, random_poses, write_lines
from tests.io.test_native_robot_maps import home
from tests.io.test_native_rtabmap import poses_of, write_session
from tests.samples import box_points, write_ply
from tests.scenes_map import building
from topomerge.cli.main import main as cli
from topomerge.fusion.frames import LEAST_DOUBT, read_file_frames
from topomerge.io.maps import save_map
from topomerge.io.native.pose_graph import read_pose_graph
from topomerge.io.points import read_points
from topomerge.io.trajectory import read_trajectory
from topomerge.types import Array, Deformation, Placement, Sim3

__all__ = ["run"]  # a fixture
NEAR = Sim3(0.4, (3.25, -1.5, 0.125))


@pytest.fixture(autouse=True)
def near(monkeypatch: pytest.MonkeyPatch) -> None:
    """Floats of a database hold no national grid."""
    monkeypatch.setattr(test_merge_points, "POSE", NEAR)


def write_listing(folder: Path, sources: list[str], bends: dict[int, Deformation] | None = None, **more: object) -> Path:
    folder.mkdir(exist_ok=True)
    into = {str(k): {"into": 0, "matrix": NEAR.matrix.tolist(), "rmse_m": 0.04} for k in range(1, len(sources))}
    bend = {str(k): b.to_json() for k, b in (bends or {}).items()}
    listing = {"maps": [{"source": s} for s in sources], "transforms": into, "bend": bend} | more
    (folder / "merge.json").write_text(json.dumps(listing))
    return folder


def test_a_merge_writes_one_database(run: Run, tmp_path: Path) -> None:
    for name in "ab":
        write_session(tmp_path / f"{name}.db")
    status, out, err = run("a.db", "b.db", "-o", "merged", "--native", "--rigid")
    assert status == 0 and err.count("tag 5 lies") == 1 and "a.db + b.db" in out and "nodes" in out
    first, joined = poses_of(tmp_path / "a.db"), poses_of(tmp_path / "merged/joined.db")
    count = max(first)
    np.testing.assert_allclose(joined[1], first[1], atol=1e-7)
    np.testing.assert_allclose(joined[1 + count], NEAR.matrix @ first[1], rtol=0, atol=1e-6)


def test_a_merge_writes_one_pose_graph_of_slam_toolbox(run: Run, tmp_path: Path) -> None:
    with zipfile.ZipFile(Path(test_karto.__file__).parent / "karto_archives.zip") as archive:
        for name in "ab":
            for suffix in ("posegraph", "data"):
                (tmp_path / f"{name}.{suffix}").write_bytes(archive.read(f"room.{suffix}"))
    status, out, _ = run("a.posegraph", "b.posegraph", "-o", "merged", "--native", "--rigid")
    assert status == 0 and "a.posegraph + b.posegraph" in out and (tmp_path / "merged/joined.data").is_file()
    one, both = (read_points(tmp_path / name) for name in ("a.posegraph", "merged/joined.posegraph"))
    assert one.poses is not None and both.poses is not None and len(both.poses) == 2 * len(one.poses)
    moved = NEAR.apply(one.poses[:, :3, 3])
    np.testing.assert_allclose(both.poses[: len(one.poses)], one.poses, atol=1e-9)
    np.testing.assert_allclose(both.poses[len(one.poses) :, :2, 3], moved[:, :2], atol=1e-9)


def test_two_scans_of_iphones_become_one_file(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    from tests.io.test_native_usdz import vertices
    from tests.io.test_usdz import roomplan

    for name in "ab":
        roomplan(tmp_path / f"{name}.usdz")
    status, out, _ = run("a.usdz", "b.usdz", "-o", "merged", "--native", "--rigid")
    assert status == 0 and "a.usdz + b.usdz: 20 meshes, 4 objects" in out
    one, both = vertices(tmp_path / "a.usdz"), vertices(tmp_path / "merged/joined.usdz")
    np.testing.assert_allclose(both, np.concatenate([one, NEAR.apply(one)]), rtol=0, atol=1e-6)


def test_two_maps_of_a_vacuum_robot_become_one(run: Run, tmp_path: Path) -> None:
    for name in "ab":
        home(tmp_path / f"{name}.json")
    status, out, _ = run("a.json", "b.json", "-o", "merged", "--native", "--rigid")
    assert status == 0 and "rooms" in out and "Bath" in (tmp_path / "merged/joined.json").read_text()


def test_mixed_formats_each_in_its_own(run: Run, tmp_path: Path) -> None:
    write_session(tmp_path / "a.db")
    write_ply(tmp_path / "b.ply", box_points(), None, text=False, order="<", kind="f8")
    assert run("a.db", "b.ply", "-o", "merged", "--native", "--rigid")[0] == 0
    assert sorted(p.name for p in (tmp_path / "merged").iterdir() if "moved" in p.name) == ["a_moved.db", "b_moved.ply"]


def test_what_has_no_form_is_named(run: Run, tmp_path: Path) -> None:
    write_session(tmp_path / "a.db")
    (tmp_path / "c.bt").write_bytes(b"# Octomap OcTree binary file\n")
    status, _, err = run("a.db", "c.bt", "-o", "merged", "--native", "--rigid")
    assert status == 0 and "c.bt: has no form" in err and (tmp_path / "merged/a_moved.db").exists()


def test_a_map_is_told_how_its_file_is_moved(run: Run, tmp_path: Path) -> None:
    write_session(tmp_path / "a.db")
    save_map(building(1), tmp_path / "c.tmap")
    status, _, err = run("a.db", "c.tmap", "-o", "merged", "--native", "--rigid")
    assert status == 0 and "c.tmap: is a map; name the file that it was made of, by `topomerge move merged 1=FILE" in err


def test_a_refused_merge_moves_nothing(run: Run, tmp_path: Path) -> None:
    for name in "ab":
        write_session(tmp_path / f"{name}.db")
    assert run("a.db", "b.db", "-o", "merged", "--native", believed=False)[0] == 2
    assert not (tmp_path / "merged/joined.db").exists()


def test_what_was_merged_is_moved_later(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sources = [str(write_session(tmp_path / f"{name}.db")) for name in "ab"]
    merged = write_listing(tmp_path / "merged", sources)
    assert cli(["move", str(merged), "-o", str(tmp_path / "out")]) == 0
    assert "links between sessions" in capsys.readouterr().out
    first, joined = poses_of(tmp_path / "a.db"), poses_of(tmp_path / "out/joined.db")
    np.testing.assert_allclose(joined[1 + max(first)], NEAR.matrix @ first[1], rtol=0, atol=1e-6)


def move_graph(folder: Path, merged: Path, *files: str) -> dict[int, Array]:
    assert cli(["move", str(merged), *files, "-o", str(folder / "out"), "-q"]) == 0
    (path,) = (folder / "out").iterdir()
    return {k: vertex.pose for k, vertex in read_pose_graph(path).vertices.items()}


def test_files_beside_the_maps_are_moved_by_their_numbers(tmp_path: Path) -> None:
    merged = write_listing(tmp_path / "merged", ["a.tmap", "b.tmap"])
    (tmp_path / "b.g2o").write_text(PLANE)
    poses = move_graph(tmp_path, merged, f"1={tmp_path / 'b.g2o'}")
    np.testing.assert_allclose(poses[10][:2, 3], NEAR.translation[:2], atol=1e-9)


def test_bent_maps_bend_their_trajectories(tmp_path: Path) -> None:
    poses = random_poses()
    rows = np.column_stack([np.arange(20.0), poses[:, :3, 3], quaternions(poses)])
    walk = write_lines(tmp_path / "walk.tum", rows)
    merged = write_listing(tmp_path / "merged", ["a.ply", "b.ply"], BENDS)
    assert cli(["move", str(merged), f"1={walk}", "-o", str(tmp_path / "out"), "-q"]) == 0
    moved = read_trajectory(tmp_path / "out/walk_moved.tum").poses
    np.testing.assert_allclose(moved[:, :3, 3], Placement(NEAR, BENDS[1]).transform_points(poses[:, :3, 3]), rtol=0, atol=1e-6)
    assert np.abs(moved[:, :3, :3] - NEAR.matrix[:3, :3] @ poses[:, :3, :3]).max() > 1e-4


def test_a_tilted_first_file_stays_where_it_is(tmp_path: Path) -> None:
    """merge.json lays files on the file of the first map, also where that was levelled."""
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]
    merged = write_listing(tmp_path / "merged", ["a.ply", "b.ply"])
    listing = json.loads((merged / "merge.json").read_text())
    listing["maps"][0]["levelled"] = turn.tolist()
    listing["transforms"]["1"]["matrix"] = (np.linalg.inv(turn) @ NEAR.matrix).tolist()
    (merged / "merge.json").write_text(json.dumps(listing))
    a, b = read_file_frames(merged)
    assert a.motion is not None and b.motion is not None and a.motion.still
    np.testing.assert_allclose(b.motion.matrix, np.linalg.inv(turn) @ NEAR.matrix, atol=1e-12)


def test_maps_go_out_as_a_graph_and_come_back(tmp_path: Path) -> None:
    """`export --to g2o`, an optimiser, and `move` with its result."""
    merged = write_listing(tmp_path / "merged", ["a.tmap", "b.tmap", "c.tmap"])
    save_map(building(1, 1), merged / "map.tmap")
    assert cli(["export", str(merged), "--to", "g2o", "-o", str(tmp_path / "maps.g2o"), "-q"]) == 0
    graph = read_pose_graph(tmp_path / "maps.g2o")
    assert sorted(graph.vertices) == [0, 1, 2] and graph.fixed == [0] and [e[1] for e in graph.edges] == [(0, 1), (0, 2)]
    np.testing.assert_allclose(graph.vertices[1].pose, NEAR.matrix, atol=1e-12)
    assert float(graph.edges[0][3].split()[7]) == pytest.approx(0.04**-2) and LEAST_DOUBT < 0.04
    text = (tmp_path / "maps.g2o").read_text().replace(f"1 {NEAR.translation[0]!r} ", "1 9.0 ")
    (tmp_path / "better.g2o").write_text(text)
    (tmp_path / "b.g2o").write_text(PLANE)
    poses = move_graph(tmp_path, tmp_path / "better.g2o", f"1={tmp_path / 'b.g2o'}")
    np.testing.assert_allclose(poses[10][:2, 3], (9.0, NEAR.translation[1]), atol=1e-9)


def test_links_of_an_atlas_are_edges(tmp_path: Path) -> None:
    merged = write_listing(tmp_path / "merged", ["a", "b", "c"], links=[{"maps": [0, 1]}, {"maps": [1, 2]}])
    save_map(building(1, 1), merged / "map.tmap")
    assert cli(["export", str(merged), "--to", "g2o", "-o", str(tmp_path / "maps.g2o"), "-q"]) == 0
    assert [e[1] for e in read_pose_graph(tmp_path / "maps.g2o").edges] == [(0, 1), (1, 2)]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["nowhere"], "no such file or folder"),
        (["nowhere.g2o", "0=a.tmap"], "no such file or folder"),
        (["."], "is no folder of a merge"),
        (["merged"], "a.tmap: is a map; name the file"),
        (["merged", "7=b.g2o"], "there is no map 7"),
        (["merged", "1=b.g2o", "1=c.g2o"], "map 1 has two files"),
        (["merged", "1=none.g2o"], "no such file"),
        (["merged", "1=walls.obj"], "are written again"),
        (["apart", "1=b.g2o"], "stands apart"),
        (["alone"], "brought no maps together"),
        (["torn"], "damaged"),
        (["large", "1=b.g2o"], "times as large in the joined frame"),
    ],
)
def test_refusals(words: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    write_listing(tmp_path / "merged", ["a.tmap", "b.tmap"])
    apart = write_listing(tmp_path / "apart", ["a.tmap", "b.tmap", "c.tmap"])
    listing = json.loads((apart / "merge.json").read_text())
    del listing["transforms"]["1"]
    (apart / "merge.json").write_text(json.dumps(listing))
    write_listing(tmp_path / "alone", ["a.tmap"])
    write_listing(tmp_path / "torn", ["a", "b"], maps=3)
    large = write_listing(tmp_path / "large", ["a.tmap", "b.tmap"])
    listing = json.loads((large / "merge.json").read_text())
    listing["transforms"]["1"]["matrix"] = Sim3(0.1, (0, 0, 0), 2.0).matrix.tolist()
    (large / "merge.json").write_text(json.dumps(listing))
    (tmp_path / "b.g2o").write_text(PLANE)
    (tmp_path / "walls.obj").write_text("v 0 0 0\n")
    assert cli(["move", *words, "-o", "out"]) == 1
    err = capsys.readouterr().err
    assert told in err and err.count("\n") == 1 and not (tmp_path / "out").exists()
