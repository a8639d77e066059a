"""What reads a map reads it with its corrections: commands, merges and atlases; and the command that makes them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import topomerge as tm
from tests.cli.conftest import run as run
from tests.cli.processes import Run
from tests.edits.recipes import corridor_map
from tests.fusion.atlas.atlas_scenes import office_map
from tests.scenes import corridor
from tests.scenes_map import building
from topomerge.edits.apply import load_corrected_map
from topomerge.edits.journal import append_edits, build_edit, find_journal, read_journal
from topomerge.errors import InputError
from topomerge.fusion.atlas.store import add, read_atlas, remove, update
from topomerge.fusion.decisions import find_decisions
from topomerge.io.maps import save_map


@pytest.fixture
def edit(run: Run) -> Run:
    """`topomerge edit a.tmap …` in a folder with the map of the corridor."""
    save_map(corridor_map(), "a.tmap")

    def call(*words: str) -> tuple[int, str, str]:
        return run("edit", "a.tmap", "--by", "ann", *words)

    call.run = run  # type: ignore[attr-defined]
    return call


def rooms(path: str = "a.tmap") -> int:
    return len(load_corrected_map(path).rooms)


@pytest.mark.longer
def test_each_option_makes_a_line_and_the_map_stays(edit: Run) -> None:
    before = Path("a.tmap").read_bytes()
    for words in (
        ("--split-room", "8", "--line", "8,4.2,8,5.8"),
        ("--join-rooms", "0,2"),
        ("--add-door", "12,8", "--width", "0.8", "--shut"),
        ("--delete-door", "0"),
        ("--move-door", "10,4", "--to", "9,4"),
        ("--set-door", "14,4.0", "--shut"),
        ("--rename-room", "0", "Kitchen"),
        ("--set-room", "1", "--kind", "office", "--outside", "no", "--looked-into", "yes"),
        ("--assign-area", "0,1", "Ward A"),
        ("--add-landmark", "text", "101", "2.6,4.2,1.5"),
        ("--delete-landmark", "2.6,4.2,1.5"),
    ):
        status, out, err = edit(*words)
        assert (status, err) == (0, ""), (words, err)
        assert out.startswith("1 edit, ")
    journal = read_journal("a.edits.jsonl")
    assert journal.version == 11 and {e.by for e in journal.edits} == {"ann"}
    assert Path("a.tmap").read_bytes() == before and rooms() == 9
    lines = edit("--list")[1].splitlines()
    assert len(lines) == 11 and "split_room" in lines[0]


def test_edits_are_undone_restored_and_moved_to_another_map(edit: Run) -> None:
    edit("--join-rooms", "0,2")
    assert rooms() == 8
    assert edit("--undo")[0] == 0 and rooms() == 9
    assert edit("--redo")[0] == 0 and rooms() == 8
    assert edit("--redo") == (1, "", "topomerge: a.tmap: a.edits.jsonl: there is nothing to redo: no edit was taken back last\n")
    assert " - " in edit("--list")[1]
    save_map(corridor_map(0.08), "b.tmap")
    assert edit.run("edit", "b.tmap", "--from", "a.edits.jsonl")[0] == 0  # type: ignore[attr-defined]
    assert rooms("b.tmap") == 8
    assert edit("-o", "c.tmap")[0] == 0 and len(tm.load_map("c.tmap").rooms) == 8


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ((), "say what to do"),
        (("--split-room", "8"), "--split-room: needs --line"),
        (("--split-room", "77", "--line", "0,0,1,1"), "has no room 77 (0 to 8)"),
        (("--split-room", "8", "--line", "30,0,31,1"), "the line does not part room 8"),
        (("--join-rooms", "1,1"), "nothing to join"),
        (("--join-rooms", "1,x"), "has no room x"),
        (("--undo", "--redo"), "--undo and --redo: give one of them"),
        (("--rename-room", "0", "x", "--width", "1"), "--width: is for --add-door and --set-door and --set-window"),
        (("--delete-door", "99"), "there is no door 99 (0 to 7)"),
        (("--delete-window", "0"), "there is no window 0 (none)"),
        (("--add-door", "1"), "give X,Y or X,Y,Z"),
        (("--add-door", "2,2"), "split it first"),
        (("--add-door", "2,2", "--storey", "4"), "a storey from 0 to 0"),
        (("--add-landmark", "cat", "x", "1,1,1"), "kind must be one of"),
        (("--from", "no.jsonl"), "no.jsonl: no such file"),
        (("--accept", "0,1"), "--accept: is for the folder of a merge"),
        (("--undo",), "there is nothing to undo"),
        (("-o", "a.tmap"), "is the input"),
        (("-o", "b.ply"), "-o writes .tmap"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(edit: Run, words: tuple[str, ...], line: str) -> None:
    status, out, err = edit(*words)
    assert status == 1 and out == "" and err.count("\n") == 1 and line in err
    assert not Path("a.edits.jsonl").exists()


def test_commands_read_the_corrected_map(edit: Run) -> None:
    edit("--join-rooms", "0,2")
    run = edit.run  # type: ignore[attr-defined]
    assert len(json.loads(run("info", "a.tmap", "--json")[1])["rooms"]) == 8
    assert len(json.loads(run("info", "a.tmap", "--json", "--no-edits")[1])["rooms"]) == 9
    assert "1 edit;" in run("info", "a.tmap")[1]
    for extra, count in (((), 8), (("--no-edits",), 9)):
        assert run("export", "a.tmap", "--to", "graphml", "-o", "a.graphml", *extra)[1].startswith(f"{count} rooms")
        assert run("embed", "a.tmap", "-o", "a.npy", "--descriptor", "engineered", *extra)[1].startswith(f"{count} rooms")
        run("view", "a.tmap", "-o", "a.html", "--no-open", *extra)
        assert f"{count} rooms" in Path("a.html").read_text(encoding="utf-8")
    edit("--rename-room", "0", "Kitchen")
    assert "Kitchen" in run("find", "--name", "kitchen", "a.tmap")[1]
    assert "numbers the rooms of a.tmap anew" in run("mark", "a.tmap", "--room", "1", "--text", "x")[2]


def test_a_damaged_journal_is_named_by_every_command(edit: Run) -> None:
    Path("a.edits.jsonl").write_text("{}\n")
    assert "a.edits.jsonl: line 1: is no edit" in edit.run("info", "a.tmap")[2]  # type: ignore[attr-defined]
    assert edit.run("info", "a.tmap", "--no-edits")[0] == 0  # type: ignore[attr-defined]


@pytest.mark.longer
def test_a_scan_that_is_extracted_again_keeps_its_corrections(edit: Run) -> None:
    edit("--join-rooms", "0,2")
    append_edits("a.edits.jsonl", [build_edit("delete_door", at=[40, 40, 0])])
    points = corridor().points()
    np.savetxt("a.xyz", points)
    status, out, err = edit.run("extract", "a.xyz", "-o", "a.tmap", "--voxel-size", "0.12", "--json", "a.json")  # type: ignore[attr-defined]
    assert status == 0 and "8 rooms" in out and "edit 2 (delete_door) no longer applies: there is no door" in err
    assert len(tm.load_map("a.tmap").rooms) == 9 and rooms() == 8
    assert len(json.loads(Path("a.json").read_text())["rooms"]) == 8


@pytest.mark.longer
def test_merges_use_the_corrected_maps_and_say_so(tmp_path: Path) -> None:
    for name, k in (("a", 0), ("b", 2)):
        save_map(office_map(k), tmp_path / f"{name}.tmap")
    names = [tmp_path / "a.tmap", tmp_path / "b.tmap"]
    ends = tm.load_map(names[0]).edges["rooms"][0]
    from topomerge.edits.draft import find_room_place

    places = [find_room_place(tm.load_map(names[0]), int(r)) for r in ends]
    append_edits(find_journal(names[0]), [build_edit("join_rooms", at=places)])
    result = tm.merge(names)
    assert len(result.maps[0].rooms) == len(tm.load_map(names[0]).rooms) - 1
    result.save(tmp_path / "merged")
    listed = json.loads((tmp_path / "merged" / "merge.json").read_text())["maps"]
    assert listed[0]["edits"] == 1 and "edits" not in listed[1]


@pytest.fixture(scope="module")
def merged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two maps and their merge in `merged`."""
    from topomerge.cli.main import main

    folder = tmp_path_factory.mktemp("merge")
    for name, k in (("a", 0), ("b", 2)):
        save_map(office_map(k), folder / f"{name}.tmap")
    assert main(["merge", str(folder / "a.tmap"), str(folder / "b.tmap"), "-o", str(folder / "merged"), "-q"]) == 0
    return folder


@pytest.mark.longer
def test_decisions_hold_when_a_merge_is_run_again(merged: Path, run: Run) -> None:
    shutil.copytree(merged, "x")
    names = ("x/a.tmap", "x/b.tmap", "-o", "x/merged")
    shutil.copytree("x/merged", "x/other")

    def read(folder: str = "x/merged") -> dict:
        return json.loads(Path(folder, "merge.json").read_text(encoding="utf-8"))

    first = read()
    assert first["decided"] == []
    assert run("merge", *names, "-q")[0] == 0  # the sources are named as they are now
    assert run("edit", "x/merged", "--reject", "0,1", "-q") == (0, "", "")
    status, out, _ = run("merge", *names)
    assert status == 2 and out.startswith("not merged: rejected by hand")
    assert read()["decided"] == [{"maps": [0, 1], "accepted": False}] and not read()["transforms"]
    assert "has no transform of map 1" in run("edit", "x/merged", "--accept", "0,1")[2]
    assert run("merge", *names, "--no-edits", "-q")[0] == 0
    assert run("edit", "x/merged", "--accept", "0,1", "-q") == (0, "", "")
    accepted = np.array(read()["transforms"]["1"]["matrix"])
    status, out, _ = run("merge", *names)
    assert status == 0 and out.startswith("merged: accepted by hand")
    assert np.allclose(read()["transforms"]["1"]["matrix"], accepted, atol=1e-9)
    assert all(match["probability"] > 0.3 for match in read()["matches"][:1])
    assert "leave --poses out" in run("merge", *names, "--poses", "rooms")[2]
    assert run("edit", "x/merged", "--list")[1].count("\n") == 2
    status, _, err = run("merge", "x/b.tmap", "x/a.tmap", "-o", "x/merged", "-q")
    assert status == 0 and "edit 2 (accept_merge) no longer applies: map 0 was x/a.tmap, and is x/b.tmap now" in err


@pytest.mark.longer
def test_matched_rooms_place_a_map(merged: Path, run: Run) -> None:
    shutil.copytree(merged, "x")
    run("merge", "x/a.tmap", "x/b.tmap", "-o", "x/merged", "-q")
    listing = json.loads(Path("x/merged/merge.json").read_text(encoding="utf-8"))
    same = [f"{i}={j}" for i, j in (match["rooms"] for match in listing["matches"])]
    assert len(same) >= 2
    assert "fix no pose" in run("edit", "x/merged", "--match-rooms", "0,1", same[0])[2]
    assert "give two numbers as A=B" in run("edit", "x/merged", "--match-rooms", "0,1", "5")[2]
    assert "has no maps 0 and 2" in run("edit", "x/merged", "--match-rooms", "0,2", ",".join(same))[2]
    assert run("edit", "x/merged", "--match-rooms", "0,1", ",".join(same))[0] == 0
    assert run("merge", "x/a.tmap", "x/b.tmap", "-o", "x/merged")[1].startswith("merged: accepted by hand")
    again = json.loads(Path("x/merged/merge.json").read_text(encoding="utf-8"))
    old, new = (np.array(one["transforms"]["1"]["matrix"]) for one in (listing, again))
    assert np.linalg.norm((old - new)[:3, 3]) < 0.3


def test_decisions_that_do_not_apply_are_told() -> None:
    maps = [building(1), building(2)]
    eye = np.eye(4)
    far = [[500.0, 0, 0], [500.0, 0, 0]]
    decisions = find_decisions(
        maps,
        [
            build_edit("reject_merge", maps=[0, 3]),
            build_edit("rename_room", at=[0, 0, 0], name="x"),
            build_edit("match_rooms", maps=[0, 1], at=far),
            build_edit("reject_merge", maps=[0, 1]),
            build_edit("accept_merge", maps=[0, 1], matrix=eye),
        ],
    )
    assert [refused.line for refused in decisions.refused] == [1, 2, 3]
    assert decisions.poses[0, 1] == tm.Sim3()


@pytest.mark.longer
def test_of_three_maps_a_pair_is_kept_apart() -> None:
    maps = [office_map(0), office_map(1), office_map(2)]
    free = tm.merge(maps)
    assert sorted(free.transforms) == [1, 2]
    apart = tm.merge(maps, poses={(0, 1): None, (0, 2): None, (1, 2): None})
    assert apart.status == "abstained" and not apart.transforms
    held = tm.merge(maps, poses={(0, 2): free.transforms[2], (0, 1): None, (1, 2): None})
    assert sorted(held.transforms) == [2]


@pytest.mark.longer
def test_an_atlas_is_put_together_with_the_corrections_of_its_maps(tmp_path: Path) -> None:
    folder = tmp_path / "atlas"
    add(folder, [("west", office_map(0)), ("east", office_map(2))], tm.render_atlas_html)
    before = read_atlas(folder).entries[0]
    map = tm.load_map(folder / before.file)
    from topomerge.edits.draft import find_room_place

    places = [find_room_place(map, int(r)) for r in map.edges["rooms"][0]]
    journal = find_journal(folder / before.file)
    append_edits(journal, [build_edit("join_rooms", at=places)])
    assert tm.find(folder, office_map(2))[0].name == "east"  # as it was put together
    update(folder, tm.render_atlas_html)
    after = read_atlas(folder).entries[0]
    assert after.rooms == before.rooms - 1 and after.edits == 1 and after.key != before.key
    assert read_atlas(folder).entries[1].key == office_key(folder, 1)
    update(folder, tm.render_atlas_html)
    assert read_atlas(folder).entries[0] == after
    remove(folder, ["west"], tm.render_atlas_html)
    assert not journal.exists()
    with pytest.raises(InputError, match="no such folder"):
        update(tmp_path / "none", tm.render_atlas_html)


def office_key(folder: Path, k: int) -> str:
    from topomerge.fusion.atlas.maps import hash_map

    return hash_map(tm.load_map(folder / read_atlas(folder).entries[k].file))
