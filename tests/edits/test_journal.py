"""The journal: what a line may hold, what a crash leaves, and two people at one file."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from topomerge.edits.journal import (
    ConflictError,
    Edit,
    append_edits,
    build_edit,
    build_redo,
    build_undo,
    find_journal,
    read_journal,
    select_effective,
)
from topomerge.errors import InputError


def rename(name: str) -> Edit:
    return build_edit("rename_room", at=[1, 2, 0], name=name)


def test_edits_come_back_as_they_were_written(tmp_path):
    path = find_journal(tmp_path / "a.tmap")
    assert path.name == "a.edits.jsonl" and find_journal(tmp_path).name == "merge.edits.jsonl"
    edits = [rename("Küche"), build_edit("split_room", by="Ann", at=(1.5, 2, 0), line=[(0, 0), (3, 0)])]
    assert read_journal(path).version == 0
    assert append_edits(path, edits[:1], 0) == 1
    assert append_edits(path, edits[1:]) == 2
    journal = read_journal(path)
    assert journal.edits == tuple(edits) and journal.version == 2 and not journal.warnings
    assert journal.edits[1].values["at"] == [1.5, 2, 0]
    line = json.loads(path.read_text(encoding="utf-8").splitlines()[0])
    assert list(line)[:4] == ["id", "time", "by", "op"] and line["name"] == "Küche"


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"op": "paint_room"}, "take one of split_room"),
        ({"op": "rename_room", "at": [1, 2, 0]}, "lacks 'name'"),
        ({"op": "rename_room", "at": [1, 2], "name": "x"}, r"at must be \[x, y, z\]"),
        ({"op": "rename_room", "at": [1, 2, float("nan")], "name": "x"}, "at must be"),
        ({"op": "rename_room", "at": [1, 2, 1e12], "name": "x"}, "at must be"),
        ({"op": "rename_room", "at": [1, 2, 0], "name": "a\nb"}, "name must be"),
        ({"op": "rename_room", "at": [1, 2, 0], "name": "x", "colour": 1}, "has no 'colour'"),
        ({"op": "set_door", "at": [1, 2, 0], "width": True}, "width must be m above 0"),
        ({"op": "set_door", "at": [1, 2, 0], "width": 0}, "width must be"),
        ({"op": "set_door", "at": [1, 2, 0], "open": 1}, "open must be true, false or null"),
        ({"op": "split_room", "at": [1, 2, 0], "line": [[0, 0]]}, "line must be two or more"),
        ({"op": "add_landmark", "at": [1, 2, 0], "kind": "cat", "value": "x"}, "kind must be one of"),
        ({"op": "accept_merge", "maps": [1, 0], "matrix": [[1]]}, "maps must be"),
        ({"op": "place_map", "map": 1, "matrix": [[1, 0, 0, 0]] * 4}, "matrix must be"),
        ({"op": "undo"}, "lacks 'edit'"),
        ({"op": "undo", "edit": "x", "by": 7}, "by must be"),
        ({"op": "undo", "edit": "x", "time": 7}, "time must be"),
        ({"op": 7}, "is no edit"),
        ([], "is no edit"),
    ],
)
def test_a_line_that_is_no_edit_is_named(tmp_path, values, words):
    path = tmp_path / "a.edits.jsonl"
    append_edits(path, [rename("x")])
    with path.open("a") as file:
        file.write(json.dumps(values) + "\n")
    with pytest.raises(InputError, match=f"a.edits.jsonl: line 2: .*{words}") as error:
        read_journal(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("line", [b"{", b"\xff\xfe", b"[" * 5000, b'"' + b"x" * 70_000 + b'"', b""])
def test_a_line_that_is_no_json_is_named(tmp_path, line):
    path = tmp_path / "a.edits.jsonl"
    path.write_bytes(line + b"\n")
    with pytest.raises(InputError, match="line 1: is"):
        read_journal(path)


def test_a_line_that_a_crash_cut_off_is_left_out_and_replaced(tmp_path, caplog):
    path = tmp_path / "a.edits.jsonl"
    append_edits(path, [rename("one"), rename("two")])
    whole = path.read_bytes()
    for cut in range(whole.index(b"\n") + 2, len(whole)):
        path.write_bytes(whole[:cut])
        journal = read_journal(path)
        assert journal.version == 1 and "line 2 was cut off" in journal.warnings[0]
    assert append_edits(path, [rename("three")], expected_version=1) == 2
    assert [edit.values["name"] for edit in read_journal(path).edits] == ["one", "three"]


def test_who_has_not_seen_the_last_edit_is_told_and_nothing_is_lost(tmp_path):
    path = tmp_path / "a.edits.jsonl"
    append_edits(path, [rename("mine")], expected_version=0)
    with pytest.raises(ConflictError, match="somebody else has edited") as error:
        append_edits(path, [rename("yours")], expected_version=0)
    assert error.value.version == 1 and read_journal(path).version == 1
    with pytest.raises(InputError, match="already"):
        append_edits(path, read_journal(path).edits)
    append_edits(path, [rename("yours")], expected_version=error.value.version)
    assert [edit.values["name"] for edit in read_journal(path).edits] == ["mine", "yours"]


def test_a_disk_that_is_full_leaves_the_journal_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / "a.edits.jsonl"
    append_edits(path, [rename("one")])
    before = path.read_bytes()

    def fail(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(InputError, match="can't be written"):
        append_edits(path, [rename("two")])
    assert path.read_bytes() == before


def test_a_folder_that_is_missing_is_named(tmp_path):
    with pytest.raises(InputError, match="can't be written"):
        append_edits(tmp_path / "no" / "a.edits.jsonl", [rename("x")])
    with pytest.raises(InputError, match="can't be read"):
        read_journal(tmp_path)


WRITER = """
import sys
from topomerge.edits.journal import append_edits, build_edit
for k in range(40):
    append_edits(sys.argv[1], [build_edit("rename_room", by=sys.argv[2], at=[1, 2, 0], name=str(k))])
"""


def test_processes_that_write_at_once_lose_nothing(tmp_path):
    path = tmp_path / "a.edits.jsonl"
    workers = [subprocess.Popen([sys.executable, "-c", WRITER, str(path), name]) for name in ("ann", "bob", "eve")]
    assert [worker.wait() for worker in workers] == [0, 0, 0]
    edits = read_journal(path).edits
    for name in ("ann", "bob", "eve"):
        assert [edit.values["name"] for edit in edits if edit.by == name] == [str(k) for k in range(40)]


@given(st.lists(st.sampled_from(["edit", "undo", "redo"]), max_size=25))
def test_undo_and_redo_are_a_stack(ways):
    """Against the two stacks of an editor."""
    edits: list[Edit] = []
    held: list[str] = []
    undone: list[str] = []
    for number, way in enumerate(ways):
        if way == "edit":
            edits.append(rename(str(number)))
            held.append(edits[-1].id)
            undone = []
        elif not (held if way == "undo" else undone):
            with pytest.raises(InputError, match=f"nothing to {way}"):
                (build_undo if way == "undo" else build_redo)(edits)
        else:
            edits.append((build_undo if way == "undo" else build_redo)(edits))
            source, target = (held, undone) if way == "undo" else (undone, held)
            target.append(source.pop())
        assert [edit.id for edit in select_effective(edits)] == held
