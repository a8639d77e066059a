"""A watched folder: stopped anywhere it ends as if never stopped, nothing is read twice, bad files are named once."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import time
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import topomerge as tm
from tests.fusion.atlas.atlas_scenes import NAMES, office_map, truth
from tests.scenes import Scene
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.extraction.landmarks import add_landmarks
from topomerge.fusion.atlas.folder import read_atlas
from topomerge.fusion.atlas.maps import Maps, hash_map
from topomerge.fusion.atlas.store import add, remove
from topomerge.fusion.atlas.watch import SOURCES_FILE, FolderWatcher, Reader, compute_stamp, iter_changes, read_sources
from topomerge.io.maps import load_map
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3, build_landmarks

SEEDS = {"three": 3, "twenty": 20}
forks = pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a copy of this process")


@cache
def room(width: int) -> tm.TopometricMap:
    """A room of its own width, which no other map shows."""
    return extract(Scene().shell(0, 0, 2.0 + 0.5 * width, 3).points(), name=f"room {width}")


@pytest.fixture
def apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is registered: the atlas keeps its maps apart, at once, however slow the machine is."""
    monkeypatch.setattr("topomerge.fusion.atlas.solve.find_hypotheses", lambda *_: ())
    monkeypatch.setattr("topomerge.fusion.atlas.watch.SECONDS_TO_ANSWER", float("inf"))


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    """A folder with four maps."""
    folder = tmp_path / "scans"
    folder.mkdir()
    for k in range(4):
        tm.save_map(room(k), folder / f"{k}.tmap")
    return folder


class Lines:
    """What a watch says, and which files it read."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self.warned: list[str] = []
        self.read: list[str] = []

    def __call__(self, line: str, is_warning: bool) -> None:
        (self.warned if is_warning else self.told).append(line)

    def map(self, path: Path) -> tm.TopometricMap:
        self.read.append(path.name)
        return load_map(path)


def watch(folder: Path, atlas: Path, lines: Lines | None = None, **settings: object) -> FolderWatcher:
    lines = lines or Lines()
    reader = Reader(lines.map, "", lambda error, path: f"{path.name}: {error}" if isinstance(error, InputError) else None)
    return FolderWatcher(folder, atlas, reader, tm.render_atlas_html, lines, settle=0.0, **settings)  # type: ignore[arg-type]


def seen(folder: Path, atlas: Path, **settings: object) -> Lines:
    """Look at a folder until there is nothing to wait for."""
    lines = Lines()
    one = watch(folder, atlas, lines, **settings)
    while one.update():
        pass
    return lines


def state(atlas: Path) -> dict[str, object]:
    """All that an atlas holds, but for how long it took and which pairs were tried on the way."""
    files = {str(p.relative_to(atlas)): p.read_bytes() for p in sorted(atlas.rglob("*")) if p.is_file() and p.suffix != ".html"}
    listing = json.loads(files.pop("atlas.json"))
    assert not [name for name in files if name.startswith((".new", ".next"))]
    return {**files, "pairs.json": b"", ".lock": b"", "atlas.json": {k: v for k, v in listing.items() if k != "seconds"}}


def in_a_copy(work: object) -> int:
    """Let a copy of this process work; its number."""
    child = os.fork()
    if child == 0:
        try:
            work()  # type: ignore[operator]
            os._exit(0)
        finally:
            os._exit(1)
    return child


@pytest.mark.longer
@forks
@pytest.mark.parametrize("kills", ["three", pytest.param("twenty", marks=pytest.mark.slow)])
def test_killed_at_random_moments_it_ends_as_if_never_killed(scans, apart, tmp_path, kills):
    began = time.monotonic()
    seen(scans, tmp_path / "whole")
    took, rng = time.monotonic() - began, random.Random(SEEDS[kills])
    atlas, killed = tmp_path / "killed", 0
    for n in range(SEEDS[kills]):
        if n % 4 == 0:
            shutil.rmtree(atlas, ignore_errors=True)  # else it would be done after a few
        child = in_a_copy(lambda: seen(scans, atlas))
        time.sleep(rng.uniform(0.05, took))
        os.kill(child, signal.SIGKILL)
        killed += os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
        if (atlas / "atlas.json").exists():
            assert {e.name for e in read_atlas(atlas).entries} <= set("0123")
            for entry in read_atlas(atlas).entries:
                assert load_map(atlas / entry.file).rooms.size == entry.rooms
    seen(scans, atlas)
    assert killed and state(atlas) == state(tmp_path / "whole")


@pytest.mark.longer
@forks
def test_two_that_add_at_once_lose_nothing(apart, tmp_path):
    rooms = [room(k) for k in range(6)]

    def adding(numbers: range) -> None:
        for k in numbers:
            add(tmp_path / "house", [(f"room-{k}", rooms[k])], tm.render_atlas_html)

    children = [in_a_copy(lambda n=n: adding(range(n, 6, 2))) for n in range(2)]
    assert [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children] == [0, 0]
    held = read_atlas(tmp_path / "house")
    assert {e.name for e in held.entries} == {f"room-{k}" for k in range(6)}
    assert all((tmp_path / "house" / e.file).is_file() for e in held.entries)


def test_each_file_is_read_once_and_a_copy_not_at_all(scans, apart, tmp_path):
    lines = seen(scans, tmp_path / "site")
    assert lines.read == ["0.tmap", "1.tmap", "2.tmap", "3.tmap"] and not lines.warned
    assert lines.told[0] == "0.tmap -> 0: 1 room; stands apart"
    shutil.copy(scans / "2.tmap", scans / "again.tmap")
    os.utime(scans / "1.tmap", ns=(1, 1))
    lines = seen(scans, tmp_path / "site")
    assert lines.read == [] and lines.told == [] and len(read_atlas(tmp_path / "site").entries) == 4
    sources = read_sources(tmp_path / "site")
    assert sources[str(scans / "again.tmap")].map == "2"
    assert sources[str(scans / "1.tmap")].stamp == compute_stamp(scans / "1.tmap", "")
    (tmp_path / "site" / SOURCES_FILE).unlink()  # all are read again, and only noted
    before = (tmp_path / "site" / "report_stamp.css").read_text()
    lines = seen(scans, tmp_path / "site")
    assert len(lines.read) == 5 and "is in the atlas already, as 0" in lines.told[0]
    assert (tmp_path / "site" / "report_stamp.css").read_text() == before


def test_what_was_taken_out_stays_out_until_its_file_changes(scans, apart, tmp_path):
    seen(scans, tmp_path / "site")
    remove(tmp_path / "site", ["3"], tm.render_atlas_html)
    assert seen(scans, tmp_path / "site").read == []
    tm.save_map(room(5), scans / "3.tmap")
    assert seen(scans, tmp_path / "site").told == ["3.tmap -> 3: 1 room; stands apart"]


def test_a_bad_file_is_named_once_and_tried_again_when_it_changes(scans, apart, tmp_path):
    (scans / "1.tmap").write_bytes((scans / "1.tmap").read_bytes()[:-500])
    (scans / "notes.md").write_text("no map")
    (scans / ".4.tmap.part").write_text("half")
    lines = seen(scans, tmp_path / "site")
    assert len(lines.warned) == 1 and lines.warned[0].startswith("1.tmap: ") and "\n" not in lines.warned[0]
    assert [e.name for e in read_atlas(tmp_path / "site").entries] == ["0", "2", "3"]
    again = seen(scans, tmp_path / "site")
    assert not again.read and not again.warned
    tm.save_map(room(1), scans / "1.tmap")
    assert seen(scans, tmp_path / "site").told == ["1.tmap -> 1: 1 room; stands apart"]


def test_a_file_that_grows_is_waited_for(scans, apart, tmp_path):
    one = watch(scans, tmp_path / "site")
    one.settle = 3600.0
    assert one.update() and one.update() and not (tmp_path / "site").exists()
    one.settle = 0.0
    assert not one.update() and len(read_atlas(tmp_path / "site").entries) == 4


def test_a_file_that_changes_while_it_is_read_is_read_again(scans, apart, tmp_path):
    lines = Lines()
    one = watch(scans, tmp_path / "site", lines)

    def read(path: Path) -> tm.TopometricMap:
        if path.name == "2.tmap" and "2.tmap" not in lines.read:
            map = lines.map(path)
            tm.save_map(room(5), path)
            return map
        return lines.map(path)

    one.reader = Reader(read, "", one.reader.failure)
    one.update()
    assert "2" not in {e.name for e in read_atlas(tmp_path / "site").entries}
    one.update()
    assert lines.read.count("2.tmap") == 2 and lines.told[-1].startswith("2.tmap -> 2: ")


def test_wrong_folders_are_refused(scans, tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        watch(tmp_path / "none", tmp_path / "site")
    with pytest.raises(InputError, match="give another folder"):
        watch(scans, scans)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.txt").write_text("")
    with pytest.raises(InputError, match="is no atlas"):
        watch(scans, tmp_path / "other")


def test_the_atlas_may_lie_in_the_folder(scans, apart):
    assert len(seen(scans, scans / "site").read) == 4 and seen(scans, scans / "site").read == []


@pytest.mark.longer
def test_the_stamp_of_the_page_changes_with_the_atlas(scans, apart, tmp_path):
    seen(scans, tmp_path / "site")
    stamp = (tmp_path / "site" / "report_stamp.css").read_text()
    assert stamp.split('"')[1] in (tmp_path / "site" / "report.html").read_text()
    tm.save_map(room(6), scans / "6.tmap")
    seen(scans, tmp_path / "site")
    later = (tmp_path / "site" / "report_stamp.css").read_text()
    assert later != stamp and later.split('"')[1] in (tmp_path / "site" / "report.html").read_text()


def test_damaged_notes_are_made_anew(scans, apart, tmp_path):
    seen(scans, tmp_path / "site")
    for wrong in ("{", "[]", '{"format": 2}', '{"format": 1, "files": {"a": {}}}', '{"format": 1, "files": {"a": 3}}'):
        (tmp_path / "site" / SOURCES_FILE).write_text(wrong)
        assert read_sources(tmp_path / "site") == {}


@pytest.mark.slow
def test_a_wrong_link_is_given_up_when_a_third_map_contradicts_it(tmp_path, monkeypatch):
    """West and east are believed to lie side by side, 99 m apart, where nothing contradicts; north knows where both are."""
    scans = tmp_path / "scans"
    scans.mkdir()
    places = {hash_map(office_map(k)): k for k in (0, 2, 3)}

    def claimed(maps: Maps, i: int, j: int, *_: object) -> tuple[PoseHypothesis, ...]:
        one, two = places[maps.keys[i]], places[maps.keys[j]]
        wrong = Sim3(0.0, (99.0, 0.0, 0.0)) if {one, two} == {0, 2} else Sim3()
        return (PoseHypothesis(wrong @ truth(one, two), probability=0.9 if {one, two} == {0, 2} else 0.995),)

    monkeypatch.setattr("topomerge.fusion.atlas.solve.find_hypotheses", claimed)
    for k in (0, 2):
        tm.save_map(office_map(k), scans / f"{NAMES[k]}.tmap")
    lines = seen(scans, tmp_path / "site")
    assert "; lies with west (0." in lines.told[0]
    (east, west) = (read_atlas(tmp_path / "site").get_poses()[name][1] for name in ("east", "west"))
    assert np.linalg.norm((east.inverse() @ west @ truth(0, 2)).translation) > 50
    tm.save_map(office_map(3), scans / "north.tmap")
    lines = seen(scans, tmp_path / "site")
    assert "; lies with east, west (" in lines.told[0]
    assert lines.told[1].startswith("no longer believed: east, west: ")
    (east, west) = (read_atlas(tmp_path / "site").get_poses()[name][1] for name in ("east", "west"))
    assert np.linalg.norm((east.inverse() @ west @ truth(0, 2)).translation) < 0.3


def test_what_is_left_to_be_registered_follows_when_nothing_new_is_there(scans, tmp_path, monkeypatch):
    """No time at all is left for the answer: the maps are there first, and joined by the next looks."""
    made: list[tuple[int, int]] = []

    def claimed(maps: Maps, i: int, j: int, *_: object) -> tuple[PoseHypothesis, ...]:
        made.append((i, j))
        return ()

    monkeypatch.setattr("topomerge.fusion.atlas.solve.find_hypotheses", claimed)
    monkeypatch.setattr("topomerge.fusion.atlas.watch.SECONDS_TO_ANSWER", -1.0)
    lines = Lines()
    one = watch(scans, tmp_path / "site", lines)
    assert one.update() and not made and len(read_atlas(tmp_path / "site").entries) == 4
    assert lines.told[0] == "0.tmap -> 0: 1 room; stands apart so far, there is more to be tried"
    assert not read_atlas(tmp_path / "site").complete
    assert not one.update() and len(made) == 6 and read_atlas(tmp_path / "site").complete
    assert not watch(scans, tmp_path / "site").update() and len(made) == 6


def test_words_of_what_is_taken_apart_and_joined():
    before = {"a": 0, "b": 0, "c": 1}
    assert list(iter_changes({"a": 0, "b": 1, "c": 0, "d": 0}, before)) == ["taken apart: a | b", "joined now: a + c"]
    assert list(iter_changes({"a": 0, "b": 0, "c": 1, "d": 0}, before)) == []


def test_a_change_of_a_lone_table_or_a_trajectory_has_its_scan_read_again(apart, tmp_path):
    """Tables that are named as in a folder of scans belong to the only file of theirs."""
    folder = tmp_path / "scans"
    folder.mkdir()
    for name in ("a.ply", "landmarks.csv", "radio.csv", "poses.txt"):
        (folder / name).write_text("1")

    def look() -> list[str]:
        lines = Lines()
        lines.map = lambda path: (lines.read.append(path.name), room(len((folder / "landmarks.csv").read_text())))[1]
        watch(folder, tmp_path / "site", lines, replacing=False).update()
        return lines.read

    assert look() == ["a.ply"] and look() == []
    for name in ("landmarks.csv", "radio.csv", "poses.txt"):
        (folder / name).write_text("22")
        assert look() == ["a.ply"] and look() == []
    (folder / "b.ply").write_text("1")
    assert look() == ["a.ply", "b.ply", "poses.txt"] and look() == []  # the tables are nobody's now
    (folder / "landmarks.csv").write_text("333")
    assert look() == []


def test_a_table_of_landmarks_is_no_map_but_its_map_is_read_again(scans, apart, tmp_path):
    seen(scans, tmp_path / "site")
    (scans / "1.landmarks.csv").write_text("kind,value,room\nname,Lab,0\n")
    lines = seen(scans, tmp_path / "site")
    assert lines.read == ["1.tmap"] and not lines.warned and len(read_atlas(tmp_path / "site").entries) == 4
    assert seen(scans, tmp_path / "site").read == []
    (scans / "1.landmarks.csv").write_text("kind,value,room\nname,Hall,0\n")
    assert seen(scans, tmp_path / "site").read == ["1.tmap"]


def test_maps_that_differ_by_a_sign_are_two():
    marked = add_landmarks(room(1), build_landmarks("text", ["101"], "here", room=0))
    assert len({hash_map(room(1)), hash_map(marked)}) == 2 and hash_map(marked) == hash_map(marked)
    assert len({hash_map(add_landmarks(room(1), build_landmarks("text", [v], "here", room=0))) for v in ("101", "102")}) == 2
