"""An atlas in a folder: adding later is building at once, taking out takes back, a kill leaves the old or the new one."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

import topomerge as tm
from tests.fusion.atlas.atlas_scenes import NAMES, office_map, stranger
from topomerge.errors import InputError
from topomerge.fusion.atlas.folder import changing, finished
from topomerge.fusion.atlas.store import _free_name, add, read_atlas, remove


def named(*numbers: int) -> list[tuple[str, tm.TopometricMap]]:
    return [(NAMES[k], office_map(k)) if k < 4 else ("stranger", stranger()) for k in numbers]


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """West, east and a stranger, added at once."""
    folder = tmp_path_factory.mktemp("atlas") / "built"
    add(folder, named(0, 2, 4), tm.atlas_html)
    return folder


@pytest.fixture
def folder(built, tmp_path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(built, tmp_path / "built"))


def told(folder: Path) -> dict:
    """What the atlas says, but for how long it took."""
    listing = json.loads((folder / "atlas.json").read_text(encoding="utf-8"))
    return {key: value for key, value in listing.items() if key != "seconds"}


def names(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and p.name != ".lock")


MAPS = ["maps/east.tmap", "maps/stranger.tmap", "maps/west.tmap"]
WHOLE = ["atlas.json", "map_0.tmap", *MAPS, "merged_0.ply", "pairs.json", "report.html"]


def test_what_is_written(built):
    assert names(built) == WHOLE
    listing = told(built)
    assert listing["format"] == 1 and listing["status"] == "parted" and "stranger stands apart" in listing["reason"]
    assert [m["name"] for m in listing["maps"]] == ["west", "east", "stranger"]
    assert [c["names"] for c in listing["components"]] == [["west", "east"], ["stranger"]]
    assert listing["components"][0]["map"] == "map_0.tmap" and "map" not in listing["components"][1]
    assert list(listing["transforms"]) == ["1"] and listing["transforms"]["1"]["into"] == 0
    joined = tm.load_map(built / "map_0.tmap")
    assert np.bitwise_or.reduce(joined.provenance) == 0b11
    assert [e.name for e in read_atlas(built).entries] == ["west", "east", "stranger"]
    page = (built / "report.html").read_text(encoding="utf-8")
    assert "Some maps belong together" in page and "http" not in page.replace("http-equiv", "")


def test_adding_later_is_building_at_once(built, tmp_path):
    later = tmp_path / "later"
    add(later, named(0), tm.atlas_html)
    assert told(later)["reason"].startswith("one map") and not (later / "map_0.tmap").exists()
    add(later, named(2), tm.atlas_html)
    add(later, named(4), tm.atlas_html)
    assert told(later) == told(built) and names(later) == WHOLE
    a, b = tm.load_map(later / "map_0.tmap"), tm.load_map(built / "map_0.tmap")
    assert np.array_equal(a.grid.cells, b.grid.cells) and np.array_equal(a.provenance, b.provenance)
    assert (later / "pairs.json").read_bytes() == (built / "pairs.json").read_bytes()


def test_taking_out_takes_back(folder, built):
    before = told(built)
    registered = (folder / "pairs.json").read_bytes()
    remove(folder, ["east"], tm.atlas_html)
    assert names(folder) == ["atlas.json", "maps/stranger.tmap", "maps/west.tmap", "pairs.json", "report.html"]
    assert told(folder)["status"] == "abstained" and not told(folder)["transforms"]
    assert len((folder / "pairs.json").read_bytes()) < len(registered)
    add(folder, named(2), tm.atlas_html)
    assert [c["names"] for c in told(folder)["components"]] == [["west", "east"], ["stranger"]]
    assert told(folder)["components"][0]["made_of"] == before["components"][0]["made_of"]
    remove(folder, ["west", "east", "stranger"], tm.atlas_html)
    assert names(folder) == ["atlas.json", "pairs.json", "report.html"] and told(folder)["reason"] == "no map"


def test_registrations_are_made_once(folder, monkeypatch):
    def fail(*_):
        raise AssertionError("registered again")

    monkeypatch.setattr("topomerge.fusion.atlas.solve.hypotheses", fail)
    monkeypatch.setattr("topomerge.fusion.fuse.extract", fail)
    remove(folder, ["stranger"], tm.atlas_html)  # the joined map of the others stays what it was
    assert told(folder)["status"] == "merged" and tm.load_map(folder / "map_0.tmap").source == "west + east"


def test_maps_of_one_name_and_maps_twice(folder):
    with pytest.raises(InputError, match="west: is in the atlas already, as west"):
        add(folder, named(0), tm.atlas_html)
    assert names(folder) == WHOLE
    entries = read_atlas(folder).entries
    assert [_free_name(n, entries) for n in ("West", "attic", "../..", ".")] == ["West-2", "attic", "_", "map"]


def test_damage_is_told_in_one_line(folder):
    with pytest.raises(InputError, match="attic: is no map of .*; it holds west, east, stranger"):
        remove(folder, ["attic"], tm.atlas_html)
    with pytest.raises(InputError, match="no such folder"):
        read_atlas(folder / "none")
    (folder / "pairs.json").write_text("{")  # it is remembered anew
    shutil.copy(folder / "maps" / "west.tmap", folder / "maps" / "east.tmap")
    with pytest.raises(InputError, match="east.tmap: "):
        remove(folder, ["stranger"], tm.atlas_html)
    (folder / "maps" / "east.tmap").unlink()
    with pytest.raises(InputError, match="east.tmap: no such file"):
        remove(folder, ["stranger"], tm.atlas_html)
    text = (folder / "atlas.json").read_text()
    for wrong, words in (
        (text[:-40], "damaged"),
        (text.replace('"format": 1', '"format": 7'), "reads format 1"),
        (text.replace('"name": "west"', '"name": "../../west"'), "damaged"),
        (text.replace('"map": "map_0.tmap"', '"map": "/etc/map_0.tmap"'), "damaged"),
        ("[]", "damaged"),
    ):
        (folder / "atlas.json").write_text(wrong)
        with pytest.raises(InputError, match=words) as error:
            read_atlas(folder)
        assert "\n" not in str(error.value)
    (folder / "atlas.json").unlink()
    with pytest.raises(InputError, match="atlas.json is missing"):
        add(folder, named(1), tm.atlas_html)
    (folder / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        add(folder / "file", named(1), tm.atlas_html)


def test_a_failure_changes_nothing(folder, monkeypatch, tmp_path):
    def fail(*_):
        raise InputError("disk full")

    before = told(folder)
    monkeypatch.setattr("topomerge.fusion.atlas.store.link_or_copy", fail)
    with pytest.raises(InputError, match="disk full"):
        remove(folder, ["stranger"], tm.atlas_html)
    assert told(folder) == before and names(folder) == WHOLE
    monkeypatch.setattr("topomerge.fusion.atlas.store.save_map", fail)
    with pytest.raises(InputError):
        add(tmp_path / "new", named(0, 2), tm.atlas_html)
    assert not (tmp_path / "new").exists()


def state(folder: Path) -> dict[str, str]:
    """Its files after an interrupted change was finished."""
    finished(folder)
    return {p.name: p.read_text() for p in folder.rglob("*") if p.is_file() and not str(p.relative_to(folder)).startswith(".")}


def change(folder: Path) -> None:
    gone = ["old"]
    with changing(folder, gone) as place:
        (place / "maps").mkdir()
        for name in ("a", "maps/b", "new"):
            (place / name).write_text("2")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a copy of this process")
def test_a_kill_at_any_moment_leaves_the_old_or_the_new(tmp_path):
    """Every call that changes a file system is the last one once."""
    calls = [(Path, "replace"), (Path, "unlink"), (Path, "mkdir"), (Path, "write_text"), (shutil, "rmtree")]
    old, new = {"a": "1", "b": "1", "old": "1"}, {"a": "2", "b": "2", "new": "2"}
    seen = set()
    for last in range(30):
        folder = tmp_path / str(last)
        (folder / "maps").mkdir(parents=True)
        for name in ("a", "maps/b", "old"):
            (folder / name).write_text("1")
        child = os.fork()
        if child == 0:
            left = [last]
            for owner, name in calls:
                _killing(owner, name, left)
            change(folder)
            os._exit(0)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        now = state(folder)
        assert now in (old, new)
        seen.add(("killed" if status else "done", now == new))
        if not status:
            break
        change(folder)  # goes on as if nothing had been
        assert state(folder) == new
    assert seen == {("killed", False), ("killed", True), ("done", True)}


def _killing(owner: object, name: str, left: list[int]) -> None:
    """Let a function end the process when it is called after `left` others."""
    call = getattr(owner, name)

    def counted(*args, **settings):
        if not left[0]:
            os._exit(9)
        left[0] -= 1
        return call(*args, **settings)

    setattr(owner, name, counted)


def test_one_change_at_a_time(tmp_path):
    fcntl = pytest.importorskip("fcntl")
    with (tmp_path / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="is being changed by another process"), changing(tmp_path, []):
            pass
