"""An atlas in a folder: adding later is building at once, taking out takes back, a kill leaves the old or the new one."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import topomerge as tm
from tests.fusion.atlas.atlas_scenes import NAMES, office_map, stranger
from topomerge.errors import InputError
from topomerge.fusion.atlas.store import _find_free_name, add, read_atlas, remove


def named(*numbers: int) -> list[tuple[str, tm.TopometricMap]]:
    return [(NAMES[k], office_map(k)) if k < 4 else ("stranger", stranger()) for k in numbers]


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """West, east and a stranger, added at once."""
    folder = tmp_path_factory.mktemp("atlas") / "built"
    add(folder, named(0, 2, 4), tm.render_atlas_html)
    return folder


@pytest.fixture
def folder(built, tmp_path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(built, tmp_path / "built"))


def listing_of(folder: Path) -> dict:
    """What the atlas says, but for how long it took."""
    listing = json.loads((folder / "atlas.json").read_text(encoding="utf-8"))
    return {key: value for key, value in listing.items() if key != "seconds"}


def names(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and p.name != ".lock")


MAPS = ["maps/east.tmap", "maps/stranger.tmap", "maps/west.tmap"]
WHOLE = ["atlas.json", "map_0.tmap", *MAPS, "merged_0.ply", "pairs.json", "report.html", "report_stamp.css"]


@pytest.mark.longer
def test_what_is_written(built):
    assert names(built) == WHOLE
    listing = listing_of(built)
    assert listing["format"] == 1 and listing["status"] == "parted" and "stranger stands apart" in listing["reason"]
    assert [m["name"] for m in listing["maps"]] == ["west", "east", "stranger"]
    assert [c["names"] for c in listing["components"]] == [["west", "east"], ["stranger"]]
    assert listing["components"][0]["map"] == "map_0.tmap" and "map" not in listing["components"][1]
    assert list(listing["transforms"]) == ["1"] and listing["transforms"]["1"]["into"] == 0
    joined = tm.load_map(built / "map_0.tmap")
    assert np.bitwise_or.reduce(joined.provenance) == 0b11
    assert [e.name for e in read_atlas(built).entries] == ["west", "east", "stranger"]
    page = (built / "report.html").read_text(encoding="utf-8")
    assert "Some maps are connected" in page and "http" not in page.replace("http-equiv", "")


@pytest.mark.longer
def test_adding_later_is_building_at_once(built, tmp_path):
    later = tmp_path / "later"
    add(later, named(0), tm.render_atlas_html)
    assert listing_of(later)["reason"].startswith("one map") and not (later / "map_0.tmap").exists()
    add(later, named(2), tm.render_atlas_html)
    add(later, named(4), tm.render_atlas_html)
    assert listing_of(later) == listing_of(built) and names(later) == WHOLE
    a, b = tm.load_map(later / "map_0.tmap"), tm.load_map(built / "map_0.tmap")
    assert np.array_equal(a.grid.cells, b.grid.cells) and np.array_equal(a.provenance, b.provenance)
    assert (later / "pairs.json").read_bytes() == (built / "pairs.json").read_bytes()


@pytest.mark.longer
def test_taking_out_takes_back(folder, built):
    before = listing_of(built)
    registered = (folder / "pairs.json").read_bytes()
    remove(folder, ["east"], tm.render_atlas_html)
    assert names(folder) == ["atlas.json", "maps/stranger.tmap", "maps/west.tmap", *WHOLE[-3:]]
    assert listing_of(folder)["status"] == "abstained" and not listing_of(folder)["transforms"]
    assert len((folder / "pairs.json").read_bytes()) < len(registered)
    add(folder, named(2), tm.render_atlas_html)
    assert [c["names"] for c in listing_of(folder)["components"]] == [["west", "east"], ["stranger"]]
    assert listing_of(folder)["components"][0]["made_of"] == before["components"][0]["made_of"]
    remove(folder, ["west", "east", "stranger"], tm.render_atlas_html)
    assert names(folder) == ["atlas.json", *WHOLE[-3:]] and listing_of(folder)["reason"] == "no map"


@pytest.mark.longer
def test_registrations_are_made_once(folder, monkeypatch):
    def fail(*_):
        raise AssertionError("registered again")

    monkeypatch.setattr("topomerge.fusion.atlas.solve.find_hypotheses", fail)
    monkeypatch.setattr("topomerge.fusion.fuse.join_rooms", fail)
    remove(folder, ["stranger"], tm.render_atlas_html)  # the joined map of the others stays what it was
    assert listing_of(folder)["status"] == "merged" and tm.load_map(folder / "map_0.tmap").source == "west + east"


def test_maps_of_one_name_and_maps_twice(folder):
    with pytest.raises(InputError, match="west: is in the atlas already, as west"):
        add(folder, named(0), tm.render_atlas_html)
    assert names(folder) == WHOLE
    entries = read_atlas(folder).entries
    assert [_find_free_name(n, entries) for n in ("West", "attic", "../..", ".")] == ["West-2", "attic", "_", "map"]


def test_damage_is_told_in_one_line(folder):
    with pytest.raises(InputError, match="attic: is no map of .*; it holds west, east, stranger"):
        remove(folder, ["attic"], tm.render_atlas_html)
    with pytest.raises(InputError, match="no such folder"):
        read_atlas(folder / "none")
    (folder / "pairs.json").write_text("{")  # it is remembered anew
    shutil.copy(folder / "maps" / "west.tmap", folder / "maps" / "east.tmap")
    with pytest.raises(InputError, match="east.tmap: "):
        remove(folder, ["stranger"], tm.render_atlas_html)
    (folder / "maps" / "east.tmap").unlink()
    with pytest.raises(InputError, match="east.tmap: no such file"):
        remove(folder, ["stranger"], tm.render_atlas_html)
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
        add(folder, named(1), tm.render_atlas_html)
    (folder / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        add(folder / "file", named(1), tm.render_atlas_html)


def test_a_failure_changes_nothing(folder, monkeypatch, tmp_path):
    def fail(*_):
        raise InputError("disk full")

    before = listing_of(folder)
    monkeypatch.setattr("topomerge.fusion.atlas.store.link_or_copy", fail)
    with pytest.raises(InputError, match="disk full"):
        remove(folder, ["stranger"], tm.render_atlas_html)
    assert listing_of(folder) == before and names(folder) == WHOLE
    monkeypatch.setattr("topomerge.fusion.atlas.store.save_map", fail)
    with pytest.raises(InputError):
        add(tmp_path / "new", named(0, 2), tm.render_atlas_html)
    assert not (tmp_path / "new").exists()
