"""What corrections teach: truth out of corrected maps, and the user that corrects a map to its truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from topomerge.datasets.pairs.edited_truth import build_edited_truth, build_map_truth
from topomerge.datasets.pairs.pairs_file import read_pairs_file
from topomerge.datasets.simulation.floor_truth import evaluate_map

from tests.cli.conftest import run as run
from tests.cli.processes import Run
from tests.edits.recipes import corridor_map
from tests.fusion.atlas.atlas_scenes import office_map
from topomerge.edits.apply import apply_edits
from topomerge.edits.draft import find_room_place
from topomerge.edits.journal import Edit, append_edits, build_edit, find_journal, read_journal
from topomerge.errors import InputError
from topomerge.evaluation.edits import GESTURES, SHOWN, correct_to_truth, estimate_minutes, save_corrections
from topomerge.evaluation.rooms import Settings, list_cases, measure
from topomerge.evaluation.tasks import Data
from topomerge.io.maps import load_map, save_map


def test_what_a_simulated_user_corrected_is_kept_and_teaches(tmp_path: Path) -> None:
    spoilt = apply_edits(corridor_map(), (build_edit("join_rooms", at=[[2, 2, 0], [2, 5, 0]]),)).map
    edits, corrected = correct_to_truth(spoilt, build_map_truth(corridor_map())[0])
    for _ in range(2):  # the journal begins anew
        save_corrections(spoilt, edits, tmp_path / "maps" / "home.tmap")
    assert len(read_journal(find_journal(tmp_path / "maps" / "home.tmap")).edits) == len(edits) > 0
    made = build_edited_truth(tmp_path / "maps", tmp_path / "truth")
    assert (made.maps, made.edits, made.rooms) == (1, len(edits), len(corrected.rooms))
    assert load_map(tmp_path / "truth" / "home.tmap").navigable_room.tolist() == corrected.navigable_room.tolist()


def test_a_map_is_right_by_its_own_truth():
    truth, rooms = build_map_truth(corridor_map())
    scores = evaluate_map(corridor_map(), truth)
    assert scores.rooms.iou > 0.99 and scores.doors.precision == scores.doors.recall == 1 and scores.edges.recall == 1
    assert scores.storeys and scores.true_rooms == len(rooms) == 9


@pytest.mark.parametrize(
    "spoiling",
    [
        (),
        pytest.param((build_edit("join_rooms", at=[[2, 2, 0], [2, 5, 0]]),), marks=pytest.mark.longer),
        pytest.param((build_edit("join_rooms", at=[[2, 2, 0], [6, 2, 0], [6, 8, 0], [6, 5, 0]]),), marks=pytest.mark.longer),
        pytest.param(
            (build_edit("split_room", at=[8, 5, 0], line=[[8, 4.2], [8, 5.8]]), build_edit("delete_door", at=[2, 4, 0])),
            marks=pytest.mark.longer,
        ),
        (
            build_edit("split_room", at=[2, 2, 0], line=[[0, 2], [4, 2]]),
            build_edit("join_rooms", at=[[10, 2, 0], [10, 5, 0]]),
            build_edit("add_door", at=[4, 8, 0]),
            build_edit("move_door", at=[6, 6, 0], to=[7.2, 6, 0]),
        ),
    ],
)
def test_a_simulated_user_corrects_a_spoilt_map(spoiling: tuple[Edit, ...]) -> None:
    truth, _ = build_map_truth(corridor_map())
    spoilt = apply_edits(corridor_map(), spoiling)
    assert len(spoilt.applied) == len(spoiling)
    edits, corrected = correct_to_truth(spoilt.map, truth)
    scores = evaluate_map(corrected, truth)
    assert scores.rooms.iou > 0.95 and scores.rooms.recall == scores.rooms.precision == 1
    assert scores.doors.precision == scores.doors.recall == 1
    assert len(edits) <= 2 * len(spoiling) + 3 and (len(edits) > 0) == (len(spoiling) > 0)
    replayed = apply_edits(spoilt.map, edits)
    assert not replayed.refused and replayed.map.edges.tobytes() == corrected.edges.tobytes()


@pytest.fixture
def folder(run: Run) -> Run:
    """`run` in a folder with three maps: a corrected, b and c of one office, merged by hand and kept apart."""
    Path("maps").mkdir()
    for name, map in (("a", office_map(0)), ("b", office_map(2)), ("c", corridor_map())):
        save_map(map, f"maps/{name}.tmap")
    first = load_map("maps/a.tmap")
    append_edits(
        "maps/a.edits.jsonl",
        [
            build_edit("join_rooms", at=[find_room_place(first, int(r)) for r in first.edges["rooms"][0]]),
            build_edit("rename_room", at=find_room_place(first, 0), name="Hall"),
            build_edit("delete_door", at=[900, 900, 0]),
        ],
    )
    assert run("merge", "maps/a.tmap", "maps/b.tmap", "-o", "maps/ab", "-q")[0] == 0
    assert run("edit", "maps/ab", "--accept", "0,1")[0] == 0
    run("merge", "maps/a.tmap", "maps/c.tmap", "-o", "maps/ac", "-q")
    assert run("edit", "maps/ac", "--reject", "0,1")[0] == 0
    return run


@pytest.mark.longer
def test_corrected_maps_become_captures_pairs_and_true_rooms(folder: Run, tmp_path: Path) -> None:
    status, out, err = folder("dataset", "from-edits", "maps", "-o", "data")
    assert status == 0 and err == ""
    rooms = len(load_map("maps/a.tmap").rooms) - 1
    lines = out.splitlines()
    assert lines[1].split() == ["a", str(rooms), "2", f"{2 / rooms:.2f}", "1", "join_rooms,", "1", "rename_room"]
    assert lines[2].split()[:3] == ["all", str(rooms), "2"]
    assert "edit 3 (delete_door) no longer applies" in lines[3]
    assert lines[4:6] == ["a b: one place", "a c: different"]
    assert lines[6] == f"1 corrected map, 2 pairs, {2 / rooms:.2f} edits a room -> data"
    assert len(load_map("data/a.tmap").rooms) == rooms
    listing = read_pairs_file("data")
    assert {name: c.path.resolve() for name, c in listing.captures.items()} == {
        "a": tmp_path / "data" / "a.tmap",
        "b": tmp_path / "maps" / "b.tmap",
        "c": tmp_path / "maps" / "c.tmap",
    }
    true = json.loads(Path("maps/ab/merge.json").read_text())["transforms"]["1"]["matrix"]
    one, other = listing.pairs
    assert np.allclose(one.matrix, true, atol=1e-5) and other.different
    status, out, err = folder("dataset", "check", "data")
    assert (status, err.count("WRONG"), out.count("WRONG")) == (0, 0, 0), out
    settings = Settings(data=Data(), path="data", cache=str(tmp_path / "cache"))
    assert [case.set for case in list_cases(settings)] == ["corrected maps"]
    row = measure(settings, lambda text: None)[0]
    assert (
        row["error"] == "" and row["rooms"] == int((load_map("data/a.tmap").rooms["entered"] >= 0.5).sum()) and row["iou"] > 0.4
    )


@pytest.mark.longer
def test_what_teaches_nothing_is_told(folder: Run, run: Run) -> None:
    assert "no such folder" in run("dataset", "from-edits", "none", "-o", "data")[2]
    Path("empty").mkdir()
    assert "holds no map that was corrected" in run("dataset", "from-edits", "empty", "-o", "data")[2]
    assert "-o: dataset from-edits needs" in run("dataset", "from-edits", "maps")[2]
    with pytest.raises(InputError, match="path=empty: holds no"):
        list_cases(Settings(path="empty"))
    find_journal("maps/a.tmap").write_text("{\n")
    status, _, err = run("dataset", "from-edits", "maps", "-o", "data")
    assert status == 1 and "a.edits.jsonl: line 1" in err


def test_minutes_are_of_the_keystroke_level_model() -> None:
    split = Edit("split_room", {"at": [0.0, 0.0, 0.0], "line": [[0.0, 0.0], [1.0, 0.0]]})  # a thought, S, two clicks
    join = Edit("join_rooms", {"at": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]})  # a thought, J, three clicks
    assert estimate_minutes([], 4) == pytest.approx(4 * 1.35 / 60)
    assert estimate_minutes([split], 0) == pytest.approx((1.35 + 0.28 + 2 * 1.3) / 60)
    assert estimate_minutes([join, split], 4) == pytest.approx((4 * 1.35 + 2 * 1.63 + 5 * 1.3) / 60)
    assert GESTURES.keys() == set(SHOWN)  # whatever the simulated user does has its gesture
