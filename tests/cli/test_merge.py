"""`topomerge merge`: files, exit statuses, and one line for whatever is wrong with the input."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import topomerge
from tests.fusion.plans_of import MOVE, office, part
from tests.scenes import two_rooms
from topomerge.cli.main import main as cli

Run = Callable[..., tuple[int, str, str]]
MERGE_FILES = ["map.tmap", "merge.json", "merged.ply", "report.html"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cloud of the west of an office's southern rooms, maps of their east and of another building; the first two merged."""
    place = tmp_path_factory.mktemp("merge")
    points = office().points()
    np.save(place / "a.npy", part(points, high=(11, 9)))
    for name, cloud in (("b", part(points, (3, -99), (14.5, 9))), ("c", two_rooms().points())):
        moved = MOVE.apply(cloud).astype(np.float32)
        topomerge.save_map(topomerge.extract(moved, name=f"{name}.ply"), place / f"{name}.tmap")
    assert cli(["merge", str(place / "a.npy"), str(place / "b.tmap"), "-o", str(place / "merged"), "-q"]) == 0
    (place / "copy.tmap").write_bytes((place / "b.tmap").read_bytes())
    (place / "broken.tmap").write_bytes((place / "b.tmap").read_bytes()[:-2000])
    (place / "text.ply").write_text("no points\n")
    Image.new("L", (8, 8)).save(place / "plan.png")
    np.save(place / "mm.npy", np.load(place / "a.npy")[::40] * 1000)
    return place


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], folder: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    monkeypatch.chdir(folder)

    def call(*words: str) -> tuple[int, str, str]:
        status = cli(["merge", *words])
        out, err = capsys.readouterr()
        return status, out, err

    return call


def listing(folder: Path) -> Any:
    return json.loads((folder / "merge.json").read_text())


def test_a_cloud_and_a_map_are_merged(folder: Path) -> None:
    merged = folder / "merged"
    assert sorted(p.name for p in merged.iterdir()) == MERGE_FILES
    merge = listing(merged)
    assert merge["status"] == "merged" and merge["probability"] >= 0.9
    assert [Path(m["source"]).name for m in merge["maps"]] == ["a.npy", "b.tmap"]
    matrix = np.array(merge["transforms"]["1"]["matrix"])
    middle = np.append(MOVE.apply(np.array([[10.0, 7.0, 1.0]]))[0], 1.0)
    assert np.allclose((matrix @ middle)[:3], [10.0, 7.0, 1.0], atol=0.08)
    assert merge["seconds"]["read"] > 0 and merge["seconds"]["extract"] > 0 and merge["seconds"]["fuse"] > 0
    assert (merged / "merged.ply").read_bytes()[:40].startswith(b"ply\nformat binary")
    assert topomerge.load_map(merged / "map.tmap").provenance is not None


@pytest.mark.longer
def test_a_refusal_has_status_two(run: Run, folder: Path) -> None:
    status, out, err = run("b.tmap", "c.tmap", "-o", "no")
    assert status == 2 and "not merged: probability" in out and err == ""
    assert sorted(p.name for p in (folder / "no").iterdir()) == ["merge.json", "report.html"]
    merge = listing(folder / "no")
    assert merge["status"] == "abstained" and merge["transforms"] == {} and merge["matches"] == []
    assert merge["reason"] in out


@pytest.mark.longer
def test_a_refusal_is_told_though_nothing_else_is(run: Run) -> None:
    status, out, err = run("b.tmap", "c.tmap", "-o", "no", "--quiet")
    assert status == 2 and out == "" and "not merged" in err and len(err.splitlines()) == 1


@pytest.mark.longer
def test_force_writes_all_and_keeps_the_status(run: Run, folder: Path) -> None:
    status, out, _ = run("b.tmap", "c.tmap", "-o", "forced", "--force")
    assert status == 2 and "force" in out
    assert sorted(p.name for p in (folder / "forced").iterdir()) == MERGE_FILES
    merge = listing(folder / "forced")
    assert merge["status"] == "abstained" and list(merge["transforms"]) == ["1"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("b.tmap", "b.tmap"), "b.tmap: is given twice"),
        (("b.tmap", "./merged/../b.tmap"), "is given twice"),
        (("b.tmap", "copy.tmap"), "copy.tmap: is the same map as b.tmap"),
        (("b.tmap",), "merge takes two maps or more, 1 given; give another one"),
        ((".",), "a folder is one map; name the files in it"),
        (("a.npy", "b.tmap", "a.npy"), "a.npy: is given twice"),
        (("b.tmap", "missing.ply"), "missing.ply: no such file"),
        (("b.tmap", "broken.tmap"), "topomerge: broken.tmap: "),
        (("b.tmap", "text.ply"), "topomerge: text.ply: "),
        (("b.tmap", "mm.npy"), "topomerge: mm.npy: "),
        (("b.tmap", "plan.png"), "plan.png: an image does not say how large a pixel is; give --resolution"),
        (("b.tmap", "c.tmap", "--threshold", "2"), "from 0 to 1"),
        (("b.tmap", "c.tmap", "--scale", "2"), "invalid choice"),
    ],
)
def test_bad_input_is_told_in_one_line(run: Run, folder: Path, words: tuple[str, ...], message: str) -> None:
    status, out, err = run(*words, "-o", "new")
    assert status == 1 and out == ""
    assert message in err and len(err.splitlines()) == 1
    assert not (folder / "new").exists()


def test_bad_folders(run: Run, folder: Path) -> None:
    (folder / "file").write_text("")
    for place, message in (("file", "is a file"), ("file/merged", "can't be made"), ("merged", "is the input")):
        first = "merged/map.tmap" if place == "merged" else "b.tmap"
        status, _, err = run(first, "c.tmap", "-o", place)
        assert status == 1 and message in err and len(err.splitlines()) == 1
    assert sorted(p.name for p in (folder / "merged").iterdir()) == MERGE_FILES


@pytest.mark.longer
def test_the_report_in_a_browser(folder: Path, tmp_path: Path) -> None:
    """The slider fades one map, rooms that are one light up together, and nothing is said on the console."""
    from tests.viz import test_report as report

    probe = """
addEventListener("load", () => setTimeout(() => {
  const seen = {}, slider = document.querySelector("[data-blend]");
  const of = (name) => document.querySelector(".of-" + name).style.opacity;
  seen.both = [of("a"), of("b")];
  slider.value = 1;
  slider.dispatchEvent(new Event("input"));
  seen.b = [of("a"), of("b")];
  const mates = JSON.parse(document.getElementById("mates").textContent);
  const room = Object.keys(mates).find((one) => one[0] === "a");
  document.querySelector(`path[data-room="${room}"]`).dispatchEvent(new PointerEvent("pointerover", { bubbles: true }));
  const lit = (one) => document.querySelector(`path[data-room="${one}"]`).classList.contains("mate");
  seen.mates = mates[room].every(lit);
  document.title = JSON.stringify(seen);
}, 500));
"""
    text = (folder / "merged" / "report.html").read_text(encoding="utf-8")
    page = tmp_path / "report.html"
    page.write_text(report.with_probe(text, probe), encoding="utf-8")
    shown, console = report.browse(page, "--dump-dom", "--disable-3d-apis")
    assert console == []
    title = re.search("<title>(.*?)</title>", shown)
    assert title
    seen = json.loads(title[1].replace("&quot;", '"'))
    assert seen == {"both": ["1", "1"], "b": ["0", "1"], "mates": True}


def test_options_that_contradict_each_other_are_no_files_fault(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a.ply", "b.ply"):
        Path(name).write_text("never read")
    for words, message in (
        (["--risk", "5", "--threshold", "0.5"], "--threshold and --risk"),
        (["--risk", "1e-5"], "--risk 1e-05:"),
    ):
        assert cli(["merge", "a.ply", "b.ply", "-o", "m", *words]) == 1
        assert capsys.readouterr().err.startswith(f"topomerge: {message}")
    assert not Path("m").exists()
