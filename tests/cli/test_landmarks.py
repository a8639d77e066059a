"""`mark` and `find`: landmarks by hand, written whole, and found again in maps, folders and atlases."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.cli.processes import Run
from tests.io.scene_graphs import write_scene_graph
from tests.scenes import two_rooms
from tests.scenes_map import building, same
from topomerge.cli.landmarks import match_values
from topomerge.extraction.landmarks import add_landmarks
from topomerge.fusion.atlas.store import add
from topomerge.io.maps import load_map, save_map
from topomerge.types import build_landmarks
from topomerge.viz.atlas_report import render_atlas_html


@pytest.fixture
def marked(run: Run) -> Run:
    """`run` in a folder with a.tmap, a building of two storeys."""
    save_map(building(1, 2), "a.tmap")
    return run


def table(name: str = "a.tmap") -> list[tuple[str, str, int, int]]:
    landmarks = load_map(name).landmarks
    kinds = ["text", "tag", "radio", "pressure", "object", "name"]
    values = landmarks.get_values().tolist()
    return [(kinds[r["kind"]], v, int(r["room"]), int(r["storey"])) for r, v in zip(landmarks.table, values, strict=True)]


def test_marks_are_added_listed_and_removed(marked: Run) -> None:
    assert marked("mark", "a.tmap", "--room", "4", "--text", "2.113", "--name", "Lab") == (
        0,
        "2 added, 2 landmarks in all -> a.tmap\n",
        "",
    )
    x, y, z = load_map("a.tmap").rooms["centroid"][0].tolist()
    assert marked("mark", "a.tmap", "--at", f"{x},{y},{z}", "--object", "sofa", "--tag", "t:1", "-q") == (0, "", "")
    assert marked("mark", "a.tmap", "--storey", "1", "--text", "EXIT", "--text", "WC")[0] == 0
    added = [("text", "2.113", 4, 1), ("name", "Lab", 4, 1), ("tag", "t:1", 0, 0), ("object", "sofa", 0, 0)]
    assert table() == [*added, ("text", "EXIT", -1, 1), ("text", "WC", -1, 1)]
    assert set(load_map("a.tmap").landmarks.sources) == {"by hand"}
    assert same(replace(load_map("a.tmap"), landmarks=building(1, 1).landmarks), building(1, 2)), "all else stays"
    status, out, _ = marked("mark", "a.tmap", "--list", "--text", "2*")
    assert status == 0 and out.splitlines()[1:] == ["text,2.113,,,,,4,1,1.0,,,"]
    assert len(marked("mark", "a.tmap", "--list")[1].splitlines()) == 7
    assert marked("mark", "a.tmap", "--remove", "--text", "wc")[1] == "1 removed, 5 landmarks in all -> a.tmap\n"
    assert marked("mark", "a.tmap", "--remove", "--room", "4")[1] == "2 removed, 3 landmarks in all -> a.tmap\n"
    assert marked("mark", "a.tmap", "--remove", "--at", f"{x},{y},{z}", "--tag", "*")[1].startswith("1 removed")
    assert table() == [("object", "sofa", 0, 0), ("text", "EXIT", -1, 1)]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--text", "1"], "say where it is: give --room, --at or --storey"),
        (["--room", "1"], "say what to mark"),
        (["--room", "6", "--text", "1"], r"a.tmap: has no room 6 (0 to 5); see them with `topomerge info`"),
        (["--storey", "2", "--text", "1"], "has no storey 2 (0 to 1)"),
        (["--room", "1", "--text", "  "], "--text: is empty"),
        (["--at", "1,2", "--text", "1"], "must be X,Y,Z in metres"),
        (["--at", "1,2,nan", "--text", "1"], "must be X,Y,Z in metres"),
        (["--at", "1,2,inf", "--text", "1"], "must be X,Y,Z in metres"),
        (["--remove"], "--remove: say which landmarks"),
        (["--remove", "--text", "1"], "has no such landmark"),
        (["--remove", "--list"], "give one of them"),
        (["--from", "b.csv", "--room", "1"], "--from: the file says what and where"),
        (["--from", "b.csv"], "b.csv: no such file"),
        (["--from", "a.tmap"], "a.tmap: no landmarks can be read of it"),
    ],
)
def test_wrong_words_change_nothing(marked: Run, words: list[str], said: str) -> None:
    before = Path("a.tmap").read_bytes()
    status, out, err = marked("mark", "a.tmap", *words)
    assert (status, out) == (1, "") and said in err and err.count("\n") == 1
    assert Path("a.tmap").read_bytes() == before and sorted(p.name for p in Path().iterdir()) == ["a.tmap"]


def test_a_place_may_begin_with_a_minus(marked: Run) -> None:
    assert marked("mark", "a.tmap", "--at", "-3.5,1,2", "--text", "1")[0] == 0
    assert load_map("a.tmap").landmarks.table["position"].tolist() == [[-3.5, 1, 2]]


def test_what_a_file_says_is_taken_and_replaced(marked: Run) -> None:
    Path("signs.csv").write_text("kind,value,room\ntext,1,0\ntext,2,1\n")
    assert marked("mark", "a.tmap", "--from", "signs.csv")[1] == "2 added, 2 landmarks in all -> a.tmap\n"
    assert marked("mark", "a.tmap", "--room", "0", "--name", "Lab")[0] == 0
    Path("signs.csv").write_text("kind,value,room\ntext,3,0\n")
    assert marked("mark", "a.tmap", "--from", "signs.csv")[1] == "1 added, 2 landmarks in all -> a.tmap\n"
    assert table() == [("name", "Lab", 0, 0), ("text", "3", 0, 0)]
    assert marked("mark", "a.tmap", "--list")[1].splitlines()[0].startswith("kind,value,x,y,z")
    Path("list.csv").write_text(marked("mark", "a.tmap", "--list")[1])
    save_map(building(1, 2), "b.tmap")
    assert marked("mark", "b.tmap", "--from", "list.csv", "-q")[0] == 0
    assert table("b.tmap") == table()
    write_scene_graph(Path("empty.json"))
    assert "holds no landmarks and no names" in marked("mark", "a.tmap", "--from", "empty.json")[2]


def test_an_exported_map_takes_neither_radio_nor_marks_away(marked: Run) -> None:
    """GeoJSON has no radio, and names the sources of what it has: a table's, and "by hand"."""
    Path("a.csv").write_text("kind,value,room,number\ntext,1,0,\nradio,aa:bb,0,-60\n")
    assert marked("mark", "a.tmap", "--from", "a.csv", "-q")[0] == 0
    assert marked("mark", "a.tmap", "--room", "1", "--name", "Lab", "-q")[0] == 0
    assert marked("export", "a.tmap", "--to", "geojson", "-o", "a.geojson", "-q")[0] == 0
    assert marked("mark", "a.tmap", "--room", "1", "--object", "sofa", "-q")[0] == 0
    before = table()
    assert marked("mark", "a.tmap", "--from", "a.geojson")[1] == "2 added, 4 landmarks in all -> a.tmap\n"
    assert sorted(table()) == sorted(before)
    Path("a.csv").write_text("kind,value,room\ntext,1,0\n")
    assert marked("mark", "a.tmap", "--from", "a.csv")[1] == "1 added, 3 landmarks in all -> a.tmap\n"


def test_what_comes_with_a_scan_is_taken(marked: Run) -> None:
    np.save("b.npy", two_rooms().points())
    Path("b.landmarks.csv").write_text("kind,value,room\nobject,sofa,1\n")
    assert marked("mark", "a.tmap", "--from", "b.npy")[1] == "1 added, 1 landmark in all -> a.tmap\n"
    assert table() == [("object", "sofa", 1, 0)]


def test_a_place_far_outside_is_told(marked: Run) -> None:
    assert "a.tmap: no room is at 100000,5,5" in marked("mark", "a.tmap", "--at", "100000,5,5", "--text", "1")[2]


def test_the_strongest_reading_of_each_room_is_found(marked: Run) -> None:
    readings = build_landmarks("radio", ["aa:bb"] * 3, "phone", room=[1, 1, 2], number=[-70.0, -60.0, -80.0])
    save_map(add_landmarks(building(1, 2), readings), "a.tmap")
    lines = marked("find", "--radio", "AA*", "a.tmap")[1].splitlines()[1:]
    assert [line.split()[2:6] for line in lines] == [["aa:bb", "(-60", "dBm)", "0"], ["aa:bb", "(-80", "dBm)", "0"]]


def test_patterns() -> None:
    landmarks = build_landmarks("text", ["2.113", "2x113", "EXIT", "a*b", "(1)"], "here")

    def fits(*patterns: str) -> list[str]:
        return landmarks.get_values()[match_values(landmarks, ("text",), patterns)].tolist()

    assert fits("2.113") == ["2.113"] and fits("2?113") == ["2.113", "2x113"] and fits(" exit ") == ["EXIT"]
    assert fits("2*", "(1)") == ["2.113", "2x113", "(1)"] and fits("") == [] and len(fits("*")) == 5
    assert not match_values(landmarks, ("tag",), ["*"]).any()
    landmarks = build_landmarks("text", ["C-209", "c 209", "C\u2013209", "C.209"], "here")
    assert fits("c209") == fits("C-209") == ["C-209", "c 209", "C\u2013209"]


def test_find_in_maps_folders_and_atlases(marked: Run) -> None:
    marked("mark", "a.tmap", "--room", "4", "--text", "2.113", "--name", "2.113", "-q")
    Path("maps").mkdir()
    shutil.copy("a.tmap", "maps/b.tmap")
    save_map(building(2, 1), "maps/c.tmap")
    marked("mark", "maps/c.tmap", "--at", "3,-1,1.5", "--tag", "2.113", "-q")
    add("site", [("a", load_map("a.tmap"))], render_atlas_html)
    status, out, err = marked("find", "--text", "2.113", "a.tmap", "maps", "site")
    lines = [line.split() for line in out.splitlines()]
    assert (status, err) == (0, "") and lines[0] == ["map", "kind", "value", "storey", "room", "place"]
    assert [line[0] for line in lines[1:]] == ["a.tmap"] * 2 + ["maps/b.tmap"] * 2 + ["site/maps/a.tmap"] * 2
    assert lines[1] == ["a.tmap", "text", "2.113", "1", "4", "–"]
    status, out, _ = marked("find", "--tag", "2*", "maps", "--json")
    (found,) = json.loads(out)
    assert status == 0 and (found["map"], found["room"], found["position"]) == ("maps/c.tmap", 0, [3, -1, 1.5])
    assert marked("find", "--text", "9.999", "a.tmap", "maps") == (2, "not found: text 9.999 (in 3 maps)\n", "")
    assert marked("find", "--name", "x", "a.tmap", "--json") == (2, "[]\n", "")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["a.tmap"], "say what to look for"),
        (["--text", "1", "none.tmap"], "none.tmap: no such file"),
        (["--text", "1", "empty"], "empty: holds no .tmap and no atlas"),
        (["--text", "1", "a.ply"], "a.ply: is no map"),
        (["--text", "1", "bad.tmap"], "bad.tmap: is not a map"),
    ],
)
def test_what_cannot_be_searched(marked: Run, words: list[str], said: str) -> None:
    Path("empty").mkdir()
    Path("a.ply").write_text("ply")
    Path("bad.tmap").write_text("no archive")
    status, out, err = marked("find", *words)
    assert (status, out) == (1, "") and said in err and err.count("\n") == 1


def test_terminals_are_not_steered(marked: Run) -> None:
    map = load_map("a.tmap")
    save_map(replace(map, landmarks=build_landmarks("text", ["\x1b[2J<b>\nx"], "here", np.zeros((1, 3)))), "a.tmap")
    out = marked("find", "--text", "*", "a.tmap")[1]
    assert "\x1b" not in out and "\ufffd[2J<b> x" in out and len(out.splitlines()) == 2
    assert "\x1b" not in marked("mark", "a.tmap", "--list")[1] + marked("info", "a.tmap")[1]


def test_merge_and_extract_read_the_table_beside_their_input(marked: Run) -> None:
    Path("a.landmarks.csv").write_text("kind,value,room\nname,Lab,0\n")
    status, _, err = marked("merge", "a.tmap", "missing.tmap", "-o", "out")
    assert status == 1 and "missing.tmap" in err
    Path("a.landmarks.csv").write_text("kind,value,room\nnoise,Lab,0\n")
    save_map(building(2, 1), "b.tmap")
    status, _, err = marked("merge", "a.tmap", "b.tmap", "-o", "out")
    assert status == 1 and "a.landmarks.csv, line 2: kind must be one of" in err


@pytest.mark.longer
def test_a_scan_and_the_table_beside_it_become_a_map(run: Run) -> None:
    np.save("scan.npy", two_rooms().points())
    Path("scan.landmarks.csv").write_text("kind,value,x,y,z\ntext,101,1,1,1.5\nobject,sofa,1,1,0.4\n")
    assert run("extract", "scan.npy", "-o", "s.tmap", "-q") == (0, "", "")
    (sign, sofa), out = table("s.tmap"), run("info", "s.tmap")[1]
    assert (sign[:2], sofa[:2], sign[3], sofa[3]) == (("text", "101"), ("object", "sofa"), 0, 0) and sofa[2] >= 0
    assert "2 landmarks (1 text, 1 object); " in out.splitlines()[0]
    assert run("embed", "scan.npy", "--descriptor", "engineered", "-o", "a.npy", "-q")[0] == 0
