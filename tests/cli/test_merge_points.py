"""`topomerge merge --points`: the clouds themselves, bent and posed; whole or not there, and never beside another merge."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import topomerge
from tests.io.test_moved_points import exact
from tests.samples import write_e57, write_las
from tests.scenes import two_rooms
from tests.scenes_map import building
from tests.types.test_deformation import deformation
from topomerge.cli.inputs import LoadedMap
from topomerge.cli.main import main as cli
from topomerge.cli.merge import choose_point_files
from topomerge.fusion.result import MergeResult
from topomerge.io.maps import save_map
from topomerge.types import Array, Deformation, Sim3, TopometricMap

POSE = Sim3(0.4, (480_000.25, 5_400_000.5, 12.125))
BENDS = {
    0: deformation(np.random.default_rng(5).normal(0, (0.1, 0.1, 0.005, 0.0), (6, 4))),
    1: deformation(np.random.default_rng(6).normal(0, (0.2, 0.2, 0.01, 0.0), (6, 4))),
}
SCAN = two_rooms().points()[::70]
Run = Callable[..., tuple[int, str, str]]


def judged(maps: Sequence[TopometricMap], believed: bool, bends: dict[int, Deformation], apart: bool, **_: Any) -> MergeResult:
    """What a merge gives, without the search: every map but the first lies at POSE."""
    joined = building(1, 1)
    joined = topomerge.TopometricMap(**{**vars(joined), "provenance": np.ones(len(joined.grid), np.uint32)})
    poses = {1: POSE} if apart else dict.fromkeys(range(1, len(maps)), POSE)
    if not believed:
        return MergeResult("abstained", 0.1, "not merged: probability 0.10", maps=tuple(maps))
    return MergeResult("merged", 0.9, "merged", transforms=poses, map=joined, maps=tuple(maps), bends=bends)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    monkeypatch.chdir(tmp_path)

    def call(
        *words: str, believed: bool = True, bends: dict[int, Deformation] = BENDS, apart: bool = False
    ) -> tuple[int, str, str]:
        def merge(maps: Sequence[TopometricMap], force: bool = False, **more: Any) -> MergeResult:
            return judged(maps, believed or force, {} if more.get("rigid") else bends, apart, **more)

        monkeypatch.setattr(topomerge, "merge", merge, raising=False)
        loaded = LoadedMap(replace(building(1, 1), warnings=()), 0.0)
        monkeypatch.setattr("topomerge.cli.inputs._load_map", lambda path, args, start_task: loaded)
        monkeypatch.setattr("topomerge.viz.merge_report.render_merge_html", lambda result: "a report")
        status = cli(["merge", *words])
        out, err = capsys.readouterr()
        return status, out, err

    return call


def write(name: str, points: Array) -> Array:
    """A file of that format; its points as they can be read back."""
    colors = (np.arange(3 * len(points)) % 251).reshape(-1, 3).astype(np.uint8)
    suffix = Path(name).suffix
    if suffix in (".las", ".laz"):
        write_las(Path(name), points, colors)
    elif suffix == ".e57":
        write_e57(Path(name), [(points, np.array([1.0, 0, 0, 0]), np.zeros(3))], colors)
    elif suffix == ".npy":
        np.save(name, points)
    else:
        np.savetxt(name, np.hstack([points, colors]), fmt="%.6f", delimiter=",", header="x,y,z,r,g,b", comments="")
    cloud = topomerge.read_points(name)
    return cloud.points.astype(np.float64) + cloud.shift


@pytest.mark.parametrize("names", [("a.las", "b.laz"), ("a.e57", "b.las"), ("a.csv", "b.npy")])
def test_points_stand_where_the_merge_says(run: Run, names: tuple[str, str]) -> None:
    clouds = [write(names[0], SCAN), write(names[1], SCAN + np.float32(0.25))]
    status, out, err = run(*names, "-o", "m", "--points")
    assert status == 0 and err == "" and len(out.splitlines()) == 3
    for k, (name, cloud) in enumerate(zip(names, clouds, strict=True)):
        suffix = Path(name).suffix if "la" in Path(name).suffix else ".ply"
        path = Path("m") / f"{Path(name).stem}_merged{suffix}"
        bent = BENDS[k].apply(cloud)
        requested = POSE.apply(bent) if k else bent
        assert np.abs(bent - cloud).max() > 0.05
        assert np.abs(exact(path) - requested).max() < 1e-3
        assert topomerge.read_points(path).colors is not None or name.endswith(".npy")
        assert f"{len(cloud):,} points of {name} -> {path.name}" in out
    merge = json.loads(Path("m/merge.json").read_text())
    assert set(merge["bend"]) == {"0", "1"} and merge["transforms"]["1"]["matrix"] == POSE.matrix.tolist()


def test_rigid_points_are_only_posed(run: Run) -> None:
    cloud = write("a.csv", SCAN)
    write("b.csv", SCAN + np.float32(0.25))
    assert run("a.csv", "b.csv", "-o", "m", "--points", "--rigid", "-q")[:2] == (0, "")
    assert np.abs(exact(Path("m/a_merged.ply")) - cloud).max() < 1e-3
    assert json.loads(Path("m/merge.json").read_text())["bend"] == {}


def test_of_maps_it_is_said_that_they_have_no_points(run: Run) -> None:
    write("a.npy", SCAN)
    save_map(building(2, 1), Path("b.tmap"))
    status, out, err = run("a.npy", "b.tmap", "-o", "m", "--points")
    assert status == 0 and "points of a.npy" in out
    assert err.splitlines() == [
        "topomerge: warning: b.tmap: is a map, which has no points; give the scan that it was made of for --points"
    ]
    assert sorted(p.name for p in Path("m").iterdir()) == ["a_merged.ply", "map.tmap", "merge.json", "merged.ply", "report.html"]


def test_a_map_that_stands_apart_has_no_place(run: Run) -> None:
    for k, name in enumerate(("a.npy", "b.npy", "c.npy")):
        write(name, SCAN + np.float32(k))
    status, _, err = run("a.npy", "b.npy", "c.npy", "-o", "m", "--points", bends={}, apart=True)
    assert status == 0 and err.splitlines() == ["topomerge: warning: c.npy: stands apart, its points are not written"]
    assert sorted(p.stem for p in Path("m").glob("*_merged.*")) == ["a_merged", "b_merged"]


def test_a_refused_merge_has_no_points(run: Run) -> None:
    write("a.npy", SCAN)
    write("b.las", SCAN + np.float32(1))
    assert run("a.npy", "b.las", "-o", "m", "--points", "-q")[0] == 0
    status, out, err = run("a.npy", "b.las", "-o", "m", "--points", believed=False)
    assert status == 2 and err == "" and out.splitlines()[-1] == "not merged: probability 0.10; no points are written -> m"
    assert sorted(p.name for p in Path("m").iterdir()) == ["merge.json", "report.html"]  # those of the merge before are gone
    assert run("a.npy", "b.las", "-o", "m", "--points", "--force", believed=False)[0] == 0  # of this stand-in; 2 of the real one
    assert len(list(Path("m").glob("*_merged.*"))) == 2


def test_points_of_an_earlier_merge_do_not_stay(run: Run) -> None:
    """Nor do files of others go, nor what is an input now."""
    for k, name in enumerate(("a.npy", "b.npy", "c.npy")):
        write(name, SCAN + np.float32(k))
    assert run("a.npy", "b.npy", "-o", "m", "--points", "-q")[0] == 0
    assert json.loads(Path("m/merge.json").read_text())["points"] == {"0": "a_merged.ply", "1": "b_merged.ply"}
    Path("m/mine_merged.ply").write_bytes(b"mine")
    assert run("m/a_merged.ply", "c.npy", "-o", "m", "-q")[0] == 0
    assert sorted(p.name for p in Path("m").glob("*_merged.*")) == ["a_merged.ply", "mine_merged.ply"]
    merge = json.loads(Path("m/merge.json").read_text())
    assert merge["points"] == {}
    for odd in (5, {"0": 7}, {"0": "../a.npy"}, {"0": "x/../../b_merged.ply"}, {"0": "map.tmap"}):
        Path("m/merge.json").write_text(json.dumps({"points": odd}))
        assert run("a.npy", "c.npy", "-o", "m", "-q")[0] == 0
        assert Path("a.npy").exists() and Path("m/mine_merged.ply").read_bytes() == b"mine"


def test_inputs_that_are_called_alike(run: Run) -> None:
    """Also where the file system takes capitals for small letters; and only files of one suffix can be."""
    inputs = ["x/a.npy", "y/a.ply", "z/A.npy", "a_2.las", "w/a.las", "m.tmap"]
    files = {k: path.name for k, path in choose_point_files(inputs, Path("m")).items()}
    assert files == {0: "a_merged.ply", 1: "a_2_merged.ply", 2: "A_3_merged.ply", 3: "a_2_merged.las", 4: "a_merged.las"}
    for k, folder in enumerate(("x", "y")):
        Path(folder).mkdir()
        write(f"{folder}/a.npy", SCAN + np.float32(k))
    assert run("x/a.npy", "y/a.npy", "-o", "m", "--points", "-q")[0] == 0
    assert sorted(p.name for p in Path("m").glob("*_merged.*")) == ["a_2_merged.ply", "a_merged.ply"]


def test_an_input_is_never_overwritten(run: Run) -> None:
    write("a.npy", SCAN)
    Path("m").mkdir()
    cloud = topomerge.read_points("a.npy")
    topomerge.save_rooms_ply(building(1, 1), "m/a_merged.ply")
    before = Path("m/a_merged.ply").read_bytes()
    status, out, err = run("a.npy", "m/a_merged.ply", "-o", "m", "--points")
    assert status == 1 and out == "" and "m/a_merged.ply: is the input: it would be overwritten" in err
    assert Path("m/a_merged.ply").read_bytes() == before and len(cloud) == len(SCAN)
    assert run("a.npy", "m/a_merged.ply", "-o", "m", "-q")[0] == 0  # without --points it is only read


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_nothing_is_half_written(run: Run, monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    from topomerge.io import transformed_points

    write("a.npy", SCAN)
    write("b.csv", SCAN + np.float32(1))
    assert run("a.npy", "b.csv", "-o", "m", "--points", "-q")[0] == 0
    before = {p.name: p.read_bytes() for p in Path("m").iterdir()}
    whole, calls = transformed_points._build_vertices, []

    def failing(*arguments: Any) -> Array:
        calls.append(1)
        if len(calls) > 1:
            raise error
        return whole(*arguments)

    monkeypatch.setattr(transformed_points, "_build_vertices", failing)
    for folder in ("m", "new"):
        calls.clear()
        status, out, err = run("a.npy", "b.csv", "-o", folder, "--points", "-q")
        assert status == (1 if isinstance(error, OSError) else 130) and out == "" and len(err.splitlines()) <= 1
    assert {p.name: p.read_bytes() for p in Path("m").iterdir()} == before and not Path("new").exists()
