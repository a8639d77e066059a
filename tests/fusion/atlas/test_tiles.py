"""Large joined maps in tiles: each room and cell in one, pages that lead to each other, and go with the joined map."""

from __future__ import annotations

import json
import urllib.request
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from urllib.error import HTTPError

import numpy as np
import pytest

import topomerge as tm
from tests.fusion.atlas.test_watch import room
from tests.scenes_map import building
from tests.viz.chromium import Page
from topomerge.fusion.atlas import store as tiles_module
from topomerge.fusion.atlas.maps import Maps
from topomerge.fusion.atlas.result import AtlasResult
from topomerge.fusion.atlas.store import add, find_nearest_rooms, remove, select_tile, split_into_tiles
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3, TopometricMap
from topomerge.viz.report_server import serve


@pytest.fixture(scope="module")
def large() -> TopometricMap:
    map = building(pairs=2, storeys=2)
    return replace(map, provenance=np.ones(len(map.grid), np.uint32))


@pytest.fixture
def small_tiles(monkeypatch: pytest.MonkeyPatch, large: TopometricMap) -> None:
    """A joined map shows a large building, in tiles of a few rooms."""
    monkeypatch.setattr(tiles_module, "TILE_CELLS", 30_000)
    monkeypatch.setattr(AtlasResult, "join_component", lambda *_: large)

    def hypotheses(maps: Maps, i: int, j: int, *_: object) -> tuple[PoseHypothesis, ...]:
        return (PoseHypothesis(Sim3(0.0, (20.0 * (j - i), 0.0, 0.0)), probability=0.995),)

    monkeypatch.setattr("topomerge.fusion.atlas.solve.find_hypotheses", hypotheses)


def test_each_room_and_each_cell_is_in_one_tile(monkeypatch: pytest.MonkeyPatch, large: TopometricMap) -> None:
    monkeypatch.setattr(tiles_module, "TILE_CELLS", 30_000)
    parts = split_into_tiles(large)
    assert len(parts) > 3 and sorted(np.concatenate(parts).tolist()) == list(range(len(large.rooms)))
    maps = [select_tile(large, rooms) for rooms in parts]
    assert all(len(m.grid) <= 30_000 or len(rooms) == 1 for m, rooms in zip(maps, parts, strict=True))
    cells = np.concatenate([m.grid.cells for m in maps])
    assert len(cells) == len(large.grid) and (np.unique(cells, axis=0) == np.unique(large.grid.cells, axis=0)).all()
    for part, rooms in zip(maps, parts, strict=True):
        rows = large.grid.find_rows(part.grid.cells)
        assert (part.room == large.room[rows]).all() and (part.provenance == large.provenance[rows]).all()  # type: ignore[index]
        assert set(part.navigable_room.tolist()) <= set(rooms.tolist()) and np.isin(part.edges["rooms"], rooms).any(axis=1).all()
    assert sum(len(m.navigable) for m in maps) == int((large.navigable_room >= 0).sum())


def test_a_cell_of_no_room_goes_with_the_nearest(large: TopometricMap) -> None:
    owner = find_nearest_rooms(large)
    inside = large.room >= 0
    assert (owner[inside] == large.room[inside]).all() and (owner >= 0).all() and not inside.all()
    cells = large.grid.cells[~inside][::300]
    near = [np.abs(large.grid.cells[inside][:, :2] - c[:2]).max(axis=1).min() for c in cells]
    given = [np.abs(large.grid.cells[inside & (large.room == r)][:, :2] - c[:2]).max(axis=1).min()
             for c, r in zip(cells, owner[~inside][::300], strict=True)]  # fmt: skip
    assert max(np.array(given) - np.array(near)) <= 2 * tiles_module.NEAREST_BY / large.grid.edge


def test_a_small_map_and_one_without_rooms_are_one_tile(large: TopometricMap) -> None:
    assert [part.tolist() for part in split_into_tiles(large)] == [list(range(len(large.rooms)))]
    whole = select_tile(large, split_into_tiles(large)[0])
    assert (whole.grid.cells == large.grid.cells).all() and len(whole.edges) == len(large.edges)
    nowhere, unwalked = np.full(len(large.grid), -1, np.int32), np.full(len(large.navigable), -1, np.int32)
    bare = replace(large, room=nowhere, navigable_room=unwalked, rooms=large.rooms[:0], edges=large.edges[:0])
    assert len(split_into_tiles(bare)) == 1 and len(select_tile(bare, split_into_tiles(bare)[0]).grid) == len(bare.grid)


@pytest.mark.longer
def test_a_large_joined_map_has_a_page_for_each_tile(tmp_path: Path, small_tiles: None, large: TopometricMap) -> None:
    folder = tmp_path / "house"
    add(folder, [("one", room(0)), ("two", room(1))], tm.render_atlas_html)
    component = json.loads((folder / "atlas.json").read_text())["components"][0]
    files = component["tiles"]
    assert component["page"] == "map_0.html" and len(files) == len(split_into_tiles(large)) > 3
    index, overview = ((folder / name).read_text(encoding="utf-8") for name in ("report.html", "map_0.html"))
    assert 'href="map_0.html"' in index and 'id="scene-data"' not in overview
    assert all(f'href="{name}"' in overview for name in files)
    for k, name in enumerate(files):
        page = (folder / name).read_text(encoding="utf-8")
        rooms = split_into_tiles(large)[k]
        assert 'href="map_0.html"' in page and 'id="scene-data"' in page
        assert all(f'<tr data-room="{r}"' in page for r in rooms) and page.count('<tr data-room="') == len(rooms)
    before = {name: (folder / name).read_bytes() for name in files}
    add(folder, [("three", room(2))], tm.render_atlas_html)
    assert sorted(p.name for p in folder.glob("*_tile_*")) == sorted(files) and before.keys() == set(files)
    remove(folder, ["two", "three"], tm.render_atlas_html)
    assert not list(folder.glob("*_tile_*")) and not list(folder.glob("map_*"))


@pytest.mark.longer
def test_the_same_atlas_has_the_same_tiles(tmp_path: Path, small_tiles: None) -> None:
    for name in ("house", "again"):
        add(tmp_path / name / "atlas", [("one", room(0)), ("two", room(1))], tm.render_atlas_html)
    pages = [{p.name: p.read_bytes() for p in (tmp_path / name / "atlas").glob("map_*.html")} for name in ("house", "again")]
    assert pages[0] == pages[1] and len(pages[0]) > 4


@pytest.mark.longer
def test_the_page_of_a_tile_shows_its_cells(tmp_path: Path, small_tiles: None) -> None:
    folder = tmp_path / "house"
    add(folder, [("one", room(0)), ("two", room(1))], tm.render_atlas_html)
    with Page(folder / "map_0_tile_1.html", tmp_path / "profile") as page:
        page.wait("document.querySelector('.scene').dataset.state === 'shown'")
        assert page.run("document.querySelectorAll('.plan-view svg').length") == 2


def test_an_atlas_is_served_with_the_pages_that_it_leads_to(tmp_path: Path) -> None:
    for name in ("report.html", "map_0.html", "map_0_tile_3.html", "report_stamp.css", "atlas.json", "other.html"):
        (tmp_path / name).write_text(name)
    heard: list[str] = []
    listening = serving(tmp_path / "report.html", heard.append)
    try:
        base = heard[0].rsplit("/", 1)[0]
        for name in ("report.html", "map_0.html", "map_0_tile_3.html", "report_stamp.css"):
            with urllib.request.urlopen(f"{base}/{name}", timeout=10) as answer:
                assert answer.read().decode() == name
        for name in ("atlas.json", "other.html", "map_1.html", "../report.html", "map_0.tmap"):
            with pytest.raises(HTTPError, match="404"):
                urllib.request.urlopen(f"{base}/{name}", timeout=10)
    finally:
        assert listening.is_alive()


def serving(page: Path, tell: Callable[[str], object]) -> Thread:
    """A page served as long as the tests run."""
    ready = Event()
    thread = Thread(target=serve, args=(page, 0, lambda address: (tell(address), ready.set())), daemon=True)
    thread.start()
    assert ready.wait(10)
    return thread
