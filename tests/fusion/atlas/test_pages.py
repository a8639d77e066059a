"""An atlas of many joined maps: each has a page of its own, written and made anew only where something changed."""

from __future__ import annotations

import json
import os
import re
import weakref
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import topomerge as tm
from tests.fusion.atlas.test_watch import room
from tests.viz.chromium import Page
from topomerge.fusion.atlas import store
from topomerge.fusion.atlas.folder import read_atlas
from topomerge.fusion.atlas.maps import MapFiles, Maps, hash_map
from topomerge.fusion.atlas.result import AtlasResult
from topomerge.fusion.atlas.store import add, remove
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3, TopometricMap

Named = tuple[str, TopometricMap]


@pytest.fixture(autouse=True)
def in_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rooms 0 and 1 lie side by side, 2 and 3, and so on; a joined map shows one of them; more than one joined map are many."""
    number = {hash_map(room(k)): k for k in range(8)}

    def hypotheses(maps: Maps, i: int, j: int, *_: object) -> tuple[PoseHypothesis, ...]:
        a, b = number[maps.keys[i]], number[maps.keys[j]]
        aside = Sim3(0.0, (20.0 if a < b else -20.0, 0.0, 0.0))
        return (PoseHypothesis(aside, probability=0.995),) if a // 2 == b // 2 else ()

    def joined(result: AtlasResult, n: int) -> TopometricMap:
        map = result.maps[result.components[n][0]]
        return replace(map, provenance=np.ones(len(map.grid), np.uint64))

    monkeypatch.setattr("topomerge.fusion.atlas.solve.find_hypotheses", hypotheses)
    monkeypatch.setattr(AtlasResult, "join_component", joined)
    monkeypatch.setattr(store, "JOINED_ON_ONE_PAGE", 1)


def named(*numbers: int) -> list[Named]:
    return [(f"room-{k}", room(k)) for k in numbers]


def content(folder: Path) -> dict[str, bytes]:
    """All that an atlas holds, but for how long it took."""
    files = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file() and p.name != ".lock"}
    files["report.html"] = re.sub(rb"in [0-9.]+ s\.", b"", files["report.html"])
    files["atlas.json"] = re.sub(rb'"seconds": [0-9.]+', b"", files["atlas.json"])
    return files


def pages(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.glob("map_*.html"))


class Counted:
    """A report that notes whose pages it made."""

    def __init__(self) -> None:
        self.made: list[object] = []

    def __call__(self, *args: object, **words: object) -> str:
        self.made.append(words.get("component", "all"))
        return tm.render_atlas_html(*args, **words)  # type: ignore[arg-type]


def test_each_joined_map_has_its_page_and_the_report_names_them(tmp_path: Path) -> None:
    folder = tmp_path / "house"
    add(folder, named(0, 1, 2, 3, 4), tm.render_atlas_html)
    assert pages(folder) == ["map_0.html", "map_1.html"]
    listing = json.loads((folder / "atlas.json").read_text())
    assert [c.get("page") for c in listing["components"]] == ["map_0.html", "map_1.html", None]
    index, page = ((folder / name).read_text(encoding="utf-8") for name in ("report.html", "map_1.html"))
    assert 'href="map_0.html"' in index and 'href="map_1.html"' in index and 'id="joined-' not in index
    assert "4 of 5 maps, in 2 joined maps" in index and "stand apart: 1" in index
    assert 'id="joined-1"' in page and 'id="scene-data"' in page and 'href="report.html"' in page
    assert "room-2" in page and "room-3" in page and "room-0" not in page and "room-4" not in page


@pytest.mark.longer
def test_pages_of_what_did_not_change_are_taken_over_and_those_of_what_is_gone_go(tmp_path: Path) -> None:
    folder, counted = tmp_path / "house", Counted()
    add(folder, named(0, 1, 2, 3), counted)
    assert counted.made == [0, 1, "all"]
    before = {name: (folder / name).read_bytes() for name in ("map_0.html", "map_1.html", "map_0.tmap", "merged_1.ply")}
    add(folder, named(4), counted)
    assert counted.made == [0, 1, "all", "all"]
    assert before == {name: (folder / name).read_bytes() for name in before}
    add(folder, named(5), counted)
    assert counted.made[-2:] == [2, "all"] and len(pages(folder)) == 3
    remove(folder, ["room-4"], counted)
    assert pages(folder) == ["map_0.html", "map_1.html"] and not (folder / "map_2.tmap").exists()
    remove(folder, ["room-0"], counted)
    assert pages(folder) == [] and 'id="joined-0"' in (folder / "report.html").read_text()


@pytest.mark.longer
def test_the_open_page_of_a_joined_map_follows_the_atlas(tmp_path: Path) -> None:
    folder = tmp_path / "house"
    add(folder, named(0, 1, 2, 3, 4, 5), tm.render_atlas_html)
    with Page(folder / "map_1.html", tmp_path / "profile") as page:
        page.run("window.opened = true")
        page.wait("performance.now() > 5000 && window.opened === true")  # nothing changed: nothing is loaded
        remove(folder, ["room-0"], tm.render_atlas_html)
        page.wait("document.readyState === 'complete' && window.opened === undefined")
        assert "room-4" in page.run("document.body.innerText") and "room-2" not in page.run("document.body.innerText")
        page.run("window.opened = true")
        remove(folder, ["room-2"], tm.render_atlas_html)  # one joined map is left, which the report shows
        page.wait("document.readyState === 'complete' && window.opened === undefined")
        assert page.run("location.pathname").endswith("report.html")


@pytest.mark.longer
def test_an_atlas_that_is_renamed_says_so_on_its_pages(tmp_path: Path) -> None:
    add(tmp_path / "house", named(0, 1, 2, 3), tm.render_atlas_html)
    (tmp_path / "house").rename(tmp_path / "yard")
    add(tmp_path / "yard", named(4), tm.render_atlas_html)
    assert "All of yard" in (tmp_path / "yard" / "map_0.html").read_text()


@pytest.mark.longer
def test_an_atlas_from_before_there_were_pages_opens_and_gets_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "house"
    with monkeypatch.context() as before:
        before.setattr(store, "JOINED_ON_ONE_PAGE", 99)
        add(folder, named(0, 1, 2, 3), tm.render_atlas_html)
    assert pages(folder) == [] and all("page" not in c for c in read_atlas(folder).listing["components"])  # type: ignore[index]
    joined = (folder / "map_0.tmap").read_bytes()
    with monkeypatch.context() as after:
        after.setattr(AtlasResult, "join_component", None)  # what is there is taken over
        add(folder, named(4), tm.render_atlas_html)
    assert pages(folder) == ["map_0.html", "map_1.html"] and (folder / "map_0.tmap").read_bytes() == joined


@pytest.mark.longer
def test_stopped_between_two_pages_and_taken_up_again_it_is_the_same(tmp_path: Path) -> None:
    def stopped(*args: object, **words: object) -> str:
        if words.get("component") == 1:
            raise KeyboardInterrupt
        return tm.render_atlas_html(*args, **words)  # type: ignore[arg-type]

    for parent in ("whole", "stopped"):
        (tmp_path / parent).mkdir()
    add(tmp_path / "whole" / "house", named(*range(6)), tm.render_atlas_html)
    folder = tmp_path / "stopped" / "house"
    with pytest.raises(KeyboardInterrupt):
        add(folder, named(*range(6)), stopped)
    assert not (folder / "atlas.json").exists() and not pages(folder)
    add(folder, named(*range(6)), tm.render_atlas_html)
    assert content(folder) == content(tmp_path / "whole" / "house")


@pytest.mark.longer
def test_two_that_add_at_once_give_what_one_gives(tmp_path: Path) -> None:
    rooms = named(*range(8))

    def adding(some: list[Named]) -> None:
        for one in some:
            add(tmp_path / "both" / "house", [one], tm.render_atlas_html)

    with ThreadPoolExecutor(2) as people:
        list(people.map(adding, (rooms[::2], rooms[1::2])))
    held = read_atlas(tmp_path / "both" / "house")
    belong = {frozenset(c["names"]) for c in held.listing["components"]}  # type: ignore[index]
    assert belong == {frozenset((f"room-{k}", f"room-{k + 1}")) for k in range(0, 8, 2)}
    assert len(pages(held.folder)) == 4 and all((held.folder / name).is_file() for name in held.list_files())


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts open files")
def test_maps_are_read_when_they_are_asked_for_and_closed(tmp_path: Path) -> None:
    def opened() -> list[str]:
        names = (os.path.realpath(f"/proc/self/fd/{n}") for n in os.listdir("/proc/self/fd"))
        return [name for name in names if name.endswith((".tmap", ".ply", ".html"))]

    add(tmp_path / "house", named(0, 1, 2, 3), lambda *_, **__: "")
    assert opened() == []
    joined = MapFiles({0: tmp_path / "house" / "map_0.tmap", 7: tmp_path / "none.tmap"})
    assert list(joined) == [0, 7] and len(joined) == 2
    first = joined[0]
    assert opened() == [] and first is not joined[0] and hash_map(first) == hash_map(joined[0])
    with pytest.raises(tm.InputError, match="no such file"):
        joined[7]


def test_maps_that_are_added_are_in_memory_one_after_the_other(tmp_path: Path) -> None:
    alive: list[weakref.ref[TopometricMap]] = []

    def one_by_one() -> Iterator[Named]:
        for k in range(5):
            assert sum(of() is not None for of in alive) <= 1
            map = replace(room(k), source=f"again {k}")
            alive.append(weakref.ref(map))
            yield f"room-{k}", map

    add(tmp_path / "house", one_by_one(), lambda *_, **__: "")
    assert [e.name for e in read_atlas(tmp_path / "house").entries] == [f"room-{k}" for k in range(5)]
