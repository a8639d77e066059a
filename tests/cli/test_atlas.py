"""`topomerge atlas` and `topomerge merge` of more than two: files, exit statuses, one line for whatever is wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import topomerge
from tests.fusion.plans_of import MOVE, part
from tests.scenes import Scene, two_rooms
from topomerge.cli.main import main as cli
from topomerge.fusion.atlas.folder import read_atlas
from topomerge.fusion.atlas.maps import Maps
from topomerge.fusion.atlas.solve import Journal, find_hypotheses, solve
from topomerge.matching.poses import PoseHypothesis

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps of a flat, of most of it in another frame, and of another building, and an atlas of them."""
    place = tmp_path_factory.mktemp("atlas")
    scene = Scene().shell(0, 0, 13, 9).wall((5, 0), (5, 9), doors=(2.0,)).wall((5, 5), (13, 5), doors=(4.0,))
    for x, y in ((0.1, 7.0), (5.2, 0.1), (5.2, 8.2)):  # cupboards: an empty rectangle looks the same upside down
        scene.box(x, y, 0, x + 1.6, y + 0.7, 2)
    flat = scene.points()
    clouds = {"west": flat, "east": MOVE.apply(part(flat, high=(11, 99))), "stranger": two_rooms().points()}
    for name, points in clouds.items():
        topomerge.save_map(topomerge.extract(points.astype(np.float32), name=name), place / f"{name}.tmap")
    words = [str(place / f"{name}.tmap") for name in ("west", "east", "stranger")]

    def hypotheses(maps: Maps, i: int, j: int, *more: Any) -> tuple[PoseHypothesis, ...]:  # what two buildings are is tried below
        return () if "stranger" in (maps[i].source, maps[j].source) else find_hypotheses(maps, i, j, *more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("topomerge.fusion.atlas.solve.find_hypotheses", hypotheses)
        assert cli(["atlas", "add", str(place / "house"), *words, "-q"]) == 0
    return place


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], folder: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    monkeypatch.chdir(folder)

    def call(*words: str) -> tuple[int, str, str]:
        status = cli(list(words))
        out, err = capsys.readouterr()
        return status, out, err

    return call


@pytest.mark.longer
def test_listing(run: Run) -> None:
    status, out, err = run("atlas", "list", "house")
    assert status == 0 and err == ""
    lines = out.splitlines()
    assert "2 maps belong together (west, east)" in lines[0] and "stranger stands apart" in lines[0]
    assert [line.split()[:1] for line in lines[1:]] == [["map"], ["west"], ["east"], ["stranger"]]
    assert "map_0.tmap" in lines[2] and "apart" in lines[4]
    status, out, _ = run("atlas", "list", "house", "--json")
    assert status == 0 and json.loads(out)["components"][0]["names"] == ["west", "east"]


STRANGE = [
    {"maps": None}, {"maps": [{}]}, {"components": 3}, {"components": [{"maps": [[], []]}]}, {"reason": None}, {"format": [1]},
    {"settings": 1e999}, {"maps": [{"name": [], "key": "", "source": {}, "rooms": 1e999, "storeys": -1}]},
]  # fmt: skip


@pytest.mark.parametrize("change", STRANGE)
def test_a_strangers_listing(run: Run, folder: Path, change: dict[str, object]) -> None:
    listing = json.loads((folder / "house" / "atlas.json").read_text())
    (folder / "strange").mkdir(exist_ok=True)
    for changed in (listing | change, {k: v for k, v in listing.items() if k not in change}):
        (folder / "strange" / "atlas.json").write_text(json.dumps(changed))
        status, out, err = run("atlas", "list", "strange")
        assert status == 0 or (status == 1 and err.count("\n") == 1 and out == ""), err
        assert status == 0 or "damaged" in err or "of format" in err, err


REGISTRATIONS = [[], {"features": []}, {"yaw": 10**400}, {"translation": 3}, {"scale": 0}, {"probability": 7}]


@pytest.mark.parametrize("strange", REGISTRATIONS)
def test_strange_registrations_are_made_anew(run: Run, folder: Path, strange: object) -> None:
    path = folder / "house" / "pairs.json"
    before = path.read_text()

    def registrations() -> object:
        return Journal(folder / "house", read_atlas(folder / "house").settings)

    stored = json.loads(before)
    assert len(registrations()) == len(stored["pairs"]) > 0
    try:
        good = next(p["hypotheses"][0] for p in stored["pairs"] if p["hypotheses"])
        stored["pairs"][0]["hypotheses"] = [good | strange if isinstance(strange, dict) else strange]
        path.write_text(json.dumps(stored))
        assert registrations() == {}
    finally:
        path.write_text(before)


@pytest.mark.longer
def test_nothing_connected_is_status_two(run: Run, folder: Path) -> None:
    status, out, err = run("atlas", "add", "two", "west.tmap", "stranger.tmap")
    assert status == 2 and "nothing could be connected: all 2 maps stand apart" in out and err == ""
    status, out, err = run("atlas", "remove", "two", "stranger", "--quiet")
    assert status == 0 and out == "" and err == ""
    assert not list((folder / "two").glob("map_*")) and [p.name for p in (folder / "two" / "maps").iterdir()] == ["west.tmap"]


@pytest.mark.longer
def test_what_is_stated_of_the_maps_is_heard_and_stays(run: Run, folder: Path) -> None:
    """West and east are joined, surer than where nothing is stated; the stranger stays apart; what was said holds for what is
    taken out later."""
    status, out, err = run("atlas", "add", "floor", "west.tmap", "east.tmap", "stranger.tmap", "--known", "storey")
    assert status == 0 and err == "" and "2 maps belong together (west, east)" in out and "stranger stands apart" in out
    plain, stated = (read_atlas(folder / name) for name in ("house", "floor"))
    assert (plain.settings["same"], stated.settings["same"]) == ("nothing", "storey")
    sure, surer = (
        {tuple(link["maps"]): link["probability"] for link in json.loads((folder / name / "atlas.json").read_text())["links"]}
        for name in ("house", "floor")
    )
    assert set(sure) == set(surer) and all(surer[pair] >= sure[pair] for pair in sure)
    assert run("atlas", "remove", "floor", "stranger", "-q")[0] == 0
    assert read_atlas(folder / "floor").settings["same"] == "storey"
    status, out, err = run("atlas", "add", "new", "west.tmap", "--known", "house")
    assert status == 1 and "--known" in err and not (folder / "new").exists()


@pytest.mark.longer
def test_three_maps_are_merged(run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Journal(folder / "house", read_atlas(folder / "house").settings)  # of the same maps
    monkeypatch.setattr("topomerge.fusion.pipeline.solve", lambda maps, settings, _: solve(maps, settings, made))
    status, out, err = run("merge", "west.tmap", "east.tmap", "stranger.tmap", "-o", "merged")
    assert status == 0 and "west.tmap, east.tmap" in out and "stranger.tmap stands apart" in out and err == ""
    merge = json.loads((folder / "merged" / "merge.json").read_text())
    assert merge["status"] == "merged" and list(merge["transforms"]) == ["1"] and len(merge["maps"]) == 3
    assert np.bitwise_or.reduce(topomerge.load_map(folder / "merged" / "map.tmap").provenance) == 0b11


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("add", "house"), "house: name the maps"),
        (("add", "new", "missing.ply"), "missing.ply: no such file"),
        (("add", "new", "west.tmap", "./west.tmap"), "west.tmap: is given twice"),
        (("add", "house", "west.tmap"), "west.tmap: is in the atlas already, as west"),
        (("add", "west.tmap", "east.tmap"), "west.tmap: is a file"),
        (("add", "other", "east.tmap"), "other: is no atlas"),
        (("add", "new", "broken.tmap"), "topomerge: broken.tmap: "),
        (("add", "new", "west.tmap", "--threshold", "2"), "from 0 to 1"),
        (("add", "new", "west.tmap", "--jobs", "0"), "--jobs: must be a whole number from 1 on, not '0'"),
        (("find", "house", "west.tmap", "--first", "0"), "--first: must be a whole number from 1 on, not '0'"),
        (("remove", "house", "attic"), "attic: is no map of house; it holds west, east, stranger"),
        (("remove", "house"), "name the maps to take out; it holds west, east, stranger"),
        (("remove", "nowhere", "west"), "nowhere: no such folder"),
        (("list", "other"), "other: is no atlas"),
        (("list", "house", "west"), "list takes the folder only"),
        (("show", "house"), "invalid choice"),
    ],
)
def test_bad_input_is_told_in_one_line(run: Run, folder: Path, words: tuple[str, ...], message: str) -> None:
    (folder / "broken.tmap").write_bytes((folder / "west.tmap").read_bytes()[:-2000])
    (folder / "other").mkdir(exist_ok=True)
    (folder / "other" / "notes.txt").write_text("mine")
    before = (folder / "house" / "atlas.json").read_bytes()
    status, out, err = run("atlas", *words)
    assert status == 1 and out == "" and message in err and len(err.splitlines()) == 1
    assert not (folder / "new").exists() and (folder / "house" / "atlas.json").read_bytes() == before
