"""Finding a place in an atlas: the right map and rooms come first, shares sum to one, and what is kept beside it is checked."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import topomerge
from tests.fusion.atlas.atlas_scenes import NAMES, office_map, stranger
from topomerge import archive
from topomerge.cli.main import main as cli
from topomerge.embedding.quarter_turns import TurnedRows
from topomerge.errors import InputError
from topomerge.fusion.atlas import find as finding
from topomerge.fusion.atlas.find import find, rank_sightings, register_sightings
from topomerge.fusion.atlas.folder import read_atlas
from topomerge.fusion.atlas.rooms_index import ROOMS_FILE
from topomerge.fusion.atlas.store import add, remove
from topomerge.types import build_landmarks
from topomerge.viz.atlas_report import render_atlas_html


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An atlas of the office's west and a stranger."""
    folder = tmp_path_factory.mktemp("atlas") / "built"
    add(folder, [(NAMES[0], office_map(0)), ("stranger", stranger())], render_atlas_html)
    find(folder, office_map(0))  # writes the rows of its rooms
    return folder


@pytest.fixture
def house(built: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(built, tmp_path / "house"))


def unit_rows(rooms: int, seed: int) -> TurnedRows:
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(rooms, 4, 8))
    return TurnedRows(rows / np.linalg.norm(rows, axis=2, keepdims=True), rng.uniform(0, 20, (rooms, 2)))


def test_rooms_seen_again_and_turned_lead_to_their_map() -> None:
    maps = [unit_rows(6, k) for k in range(5)]
    new = TurnedRows(np.roll(maps[3].rows[[4, 1, 5]], 2, axis=1), 3 - maps[3].places[[4, 1, 5]])
    sightings = rank_sightings(["a", "b", "c", "d", "e"], maps, new, 3)
    assert sightings[0].name == "d" and len(sightings) == 3
    assert {(i, j) for i, j, _ in sightings[0].rooms} == {(0, 4), (1, 1), (2, 5)}
    assert sum(s.share for s in rank_sightings(list("abcde"), maps, new, 5)) == pytest.approx(1.0)


def test_rooms_that_stand_to_each_other_as_those_of_the_new_map_count_more() -> None:
    here = unit_rows(5, 0)
    shuffled = TurnedRows(here.rows, here.places[[1, 2, 3, 4, 0]])  # the same rooms in another building
    new = TurnedRows(here.rows, here.places + 3.0)
    first, second = rank_sightings(["shuffled", "here"], [shuffled, here], new, 2)
    assert first.name == "here" and first.share > 2 * second.share


def test_plain_rows_and_maps_without_rooms() -> None:
    rows = [np.eye(4)[:2], np.zeros((0, 4)), np.eye(4)[2:]]
    sightings = rank_sightings(["a", "none", "b"], rows, np.eye(4)[[3]], 3)
    assert sightings[0].name == "b" and sightings[0].rooms[0][:2] == (0, 1)
    assert {s.name: s.share for s in sightings}["none"] == 0.0


def test_a_map_of_the_atlas_finds_itself_and_rows_are_kept(house: Path) -> None:
    first = find(house, office_map(0))
    assert first[0].name == NAMES[0] and first[0].share > 0.5
    assert len(first[0].rooms) > 2 and all(i == j and cosine > 0.999 for i, j, cosine in first[0].rooms)
    written = (house / ROOMS_FILE).read_bytes()
    assert find(house, office_map(0)) == first and (house / ROOMS_FILE).read_bytes() == written
    (house / ROOMS_FILE).unlink()
    assert find(house, office_map(0)) == first


@pytest.mark.longer
def test_the_map_on_which_it_lies_best_comes_first(house: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the rooms look like; those on which it was not laid follow as they were."""
    first, second = find(house, office_map(0))
    assert first.fit is not None and second.fit is not None and first.fit > 3 > second.fit
    turned = (replace(second, fit=None), replace(first, fit=None))
    assert register_sightings(read_atlas(house), office_map(0), turned) == (first, second)
    monkeypatch.setattr(finding, "COARSE_CANDIDATES", 1)
    assert register_sightings(read_atlas(house), office_map(0), turned) == (second, turned[1])


@pytest.mark.longer
def test_maps_that_hold_the_same_rare_strings_come_first(house: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sign that both hold counts, also where the looks of rooms left the map out; words of all buildings do not."""
    signs = build_landmarks("text", ["4.711", "EXIT"], "r", room=0)
    folder = tmp_path / "signs"
    marked = replace(stranger(), landmarks=signs)
    add(folder, [(NAMES[0], office_map(0)), ("stranger", marked)], render_atlas_html)
    names = [e.name for e in read_atlas(folder).entries]
    new = replace(office_map(0), landmarks=signs)
    assert finding.rank_by_landmarks(read_atlas(folder), new) == {names.index("stranger"): 1.0}
    assert finding.rank_by_landmarks(read_atlas(folder), office_map(0)) == {}
    exits = replace(new, landmarks=build_landmarks("text", ["EXIT"], "r", room=0))
    assert finding.rank_by_landmarks(read_atlas(folder), exits) == {} and find(folder, exits) == find(house, office_map(0))
    told = {s.name: s.landmarks for s in find(folder, new)}
    assert told == {NAMES[0]: 0.0, "stranger": 1.0}
    monkeypatch.setattr(finding, "SHORTLIST", 1)
    monkeypatch.setattr(finding, "STRING_ODDS", 1000.0)
    assert [s.name for s in find(folder, new, 1)] == ["stranger"] and [s.name for s in find(folder, exits, 1)] == [NAMES[0]]


def test_what_the_atlas_loses_is_found_no_more(house: Path) -> None:
    remove(house, [NAMES[0]], render_atlas_html)
    assert [s.name for s in find(house, office_map(0))] == ["stranger"]


def test_a_file_of_rooms_that_is_damaged_or_another_s_is_refused(house: Path, tmp_path: Path) -> None:
    path = house / ROOMS_FILE
    good, arrays = path.read_bytes(), archive.read(path)
    path.write_bytes(good[:-40])
    with pytest.raises(InputError, match="rooms.npz: damaged"):
        find(house, office_map(0))
    archive.write({**arrays, "embedder": arrays["embedder"][::-1]}, path)
    with pytest.raises(InputError, match="of another embedder; delete it"):
        find(house, office_map(0))
    archive.write({"embedder": arrays["embedder"], "0" * 16: np.zeros((1, 4), np.float32)}, path)
    with pytest.raises(InputError, match="of another atlas; delete it"):
        find(house, office_map(0))
    short = {name: array if name == "embedder" else array[:1] for name, array in arrays.items()}
    archive.write(short, path)
    with pytest.raises(InputError, match="does not fit the map"):
        find(house, office_map(0))
    archive.write({name: array[..., 1:] if array.ndim == 3 else array for name, array in arrays.items()}, path)
    with pytest.raises(InputError, match="does not fit the map"):
        find(house, office_map(0))
    archive.write({name: array for name, array in arrays.items() if not name.endswith(".places")}, path)
    with pytest.raises(InputError, match="does not fit the map"):
        find(house, office_map(0))


def test_a_map_and_a_folder_that_were_swapped_are_told(house: Path) -> None:
    with pytest.raises(InputError, match="find takes the folder of an atlas and a map, .*, not TopometricMap and "):
        find(office_map(0), house)  # type: ignore[arg-type]


def test_empty_atlases_and_maps_without_rooms(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        find(tmp_path / "nowhere", office_map(0))


def test_an_atlas_that_may_only_be_read_is_looked_through(house: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(arrays: object, path: Path) -> None:
        raise InputError(f"{path}: can't be written")

    monkeypatch.setattr(archive, "write", refused)
    (house / ROOMS_FILE).unlink()
    assert find(house, office_map(0))[0].name == NAMES[0] and not (house / ROOMS_FILE).exists()


@pytest.mark.longer
def test_the_command(house: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    topomerge.save_map(office_map(0), tmp_path / "new.tmap")
    assert cli(["atlas", "find", str(house), str(tmp_path / "new.tmap")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("map") and lines[1].startswith(NAMES[0]) and "0 = 0" in lines[1]
    assert lines[3] == "" and lines[4].startswith("Listed by fit, best first") and lines[5].startswith("share: ")
    assert cli(["atlas", "find", str(house), str(tmp_path / "new.tmap"), "--json", "--first", "1"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert len(listed) == 1 and listed[0]["name"] == NAMES[0]
    assert cli(["atlas", "find", str(house), str(tmp_path / "new.tmap"), "--first", "0"]) == 1
    assert "must be a whole number from 1 on" in capsys.readouterr().err
    assert cli(["atlas", "find", str(house)]) == 1
    assert "name the one map" in capsys.readouterr().err
