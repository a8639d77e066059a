"""Landmarks in files: what is written comes back, what is wrong is told with its line, and tables beside scans are read."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.cases import list_longer
from tests.io.test_maps import rewritten
from tests.scenes import two_rooms
from tests.scenes_map import building, same
from topomerge import archive, read_points
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.io.landmarks import find_landmark_file, format_landmark_table, parse_landmarks, read_landmark_file
from topomerge.io.listing import convert_map_to_json, format_map
from topomerge.io.maps import load_landmarks, load_map, save_map
from topomerge.types import LANDMARK_DTYPE, LONGEST_VALUE, Array, Landmarks, TopometricMap, build_landmarks, join_landmarks

AWAY = 1e10


def some_landmarks() -> Landmarks:
    """One of each kind, with and without a position, a room, a storey and a number."""
    at = np.array([[3.0, -1.0, 1.5]])
    return join_landmarks(
        [
            build_landmarks("text", ["2.113"], "signs.csv", at, sigma=0.25, room=0, storey=0, confidence=0.75, number=1.5),
            build_landmarks("tag", ["tag36h11:7"], "by hand", room=1, storey=0, time=1.7e9 + 0.125),
            build_landmarks("radio", ["aa:bb", "cc:dd"], "bag", at, number=[-60.0, -71.5], group=3, storey=0, room=0),
            build_landmarks("pressure", [""], "bag", number=1013.25, storey=1),
            build_landmarks("name", ['Küche; "rot", klein'], "home.json", room=2, storey=0),
        ]
    )


def with_landmarks() -> TopometricMap:
    return replace(building(1, 2), landmarks=some_landmarks())


def equal(a: Landmarks, b: Landmarks, sources: bool = True) -> bool:
    columns = [n for n in LANDMARK_DTYPE.names or () if n not in ("value", "source")]
    said = [[(m.values[v], m.sources[s] if sources else "") for v, s in m.table[["value", "source"]].tolist()] for m in (a, b)]
    return said[0] == said[1] and all(np.array_equal(a.table[n], b.table[n], equal_nan=True) for n in columns)


def test_a_map_keeps_its_landmarks(tmp_path: Path) -> None:
    save_map(with_landmarks(), tmp_path / "a.tmap")
    back = load_map(tmp_path / "a.tmap")
    assert same(back, with_landmarks())
    save_map(back, tmp_path / "b.tmap")
    assert (tmp_path / "a.tmap").read_bytes() == (tmp_path / "b.tmap").read_bytes()
    alone, storeys = load_landmarks(tmp_path / "a.tmap")
    assert equal(alone, some_landmarks()) and storeys.tolist() == [0, 0, 0, 1, 1, 1]


def test_a_map_without_landmarks_holds_no_tables_of_them_and_older_files_are_read(tmp_path: Path) -> None:
    save_map(building(1, 1), tmp_path / "a.tmap")
    assert not [name for name in archive.list_arrays(tmp_path / "a.tmap") if "landmark" in name]
    older = rewritten(tmp_path / "a.tmap", tmp_path / "older.tmap", format=np.array(2, "<i4"))
    assert same(load_map(older), building(1, 1)) and len(load_landmarks(older)[0]) == 0
    with pytest.raises(InputError, match="is of format 1, and this topomerge reads format 3; make it again"):
        load_map(rewritten(older, tmp_path / "oldest.tmap", format=np.array(1, "<i4")))


@pytest.mark.parametrize("count", [50_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_many_landmarks_are_written_and_read(count: int, tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    values = [f"aa:{k:06x}" for k in range(count)]
    many = build_landmarks("radio", values, "bag", random.uniform(0, 9, (count, 3)), number=random.uniform(-90, -40, count))
    save_map(replace(building(1, 1), landmarks=many), tmp_path / "a.tmap")
    assert equal(load_map(tmp_path / "a.tmap").landmarks, many)


def changed(column: str, value: object) -> Array:
    table = some_landmarks().table.copy()
    table[column][0] = value
    return table


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"landmarks": changed("position", (np.inf, 0, 0))}, "position that is no number"),
        ({"landmarks": changed("position", (np.nan, 0, 0))}, "position that is no number"),
        ({"landmarks": changed("position", (AWAY, 0, 0))}, "position that is no number or beyond 1e"),
        ({"landmarks": changed("sigma", -1)}, "a sigma that is no number"),
        ({"landmarks": changed("number", np.inf)}, "a number that is no number"),
        ({"landmarks": changed("time", -np.inf)}, "a time that is no number"),
        ({"landmarks": changed("confidence", np.nan)}, "confidence that is not from 0 to 1"),
        ({"landmarks": changed("confidence", 1.5)}, "confidence that is not from 0 to 1"),
        ({"landmarks": changed("kind", 9)}, "landmark's kind does not exist"),
        ({"landmarks": changed("value", 77)}, "landmark's value does not exist"),
        ({"landmarks": changed("room", 99)}, "landmark's room does not exist"),
        ({"landmarks": changed("storey", 2)}, "landmark's storey does not exist"),
        ({"landmarks": np.zeros(2, [("kind", "u1")])}, "landmarks has other columns"),
        ({"landmark_strings": None}, "'landmark_strings' is missing"),
        ({"landmarks": None}, "'landmarks' is missing"),
        ({"landmark_strings": np.frombuffer(b'[["a"]]', np.uint8)}, "have no strings"),
        ({"landmark_strings": np.frombuffer(b'[["a", 1], []]', np.uint8)}, "can't be printed"),
        ({"landmark_strings": np.frombuffer(b'[["a\\u001b[2J"], ["b"]]', np.uint8)}, "can't be printed"),
        ({"landmark_strings": np.frombuffer(b"[" * 100_000, np.uint8)}, "damaged"),
        ({"landmark_strings": np.frombuffer(json.dumps([["x" * 201], ["b"]]).encode(), np.uint8)}, "longer than 200"),
        *list_longer(({"landmarks": np.zeros(2_000_001, LANDMARK_DTYPE)}, "declares 2,000,001 landmarks, more than 2,000,000")),
    ],
)
def test_hostile_maps_are_refused_in_one_line(tmp_path: Path, change: dict[str, Array | None], said: str) -> None:
    save_map(with_landmarks(), tmp_path / "a.tmap")
    rewritten(tmp_path / "a.tmap", tmp_path / "bad.tmap", **change)
    with pytest.raises(InputError, match=said) as caught:
        load_map(tmp_path / "bad.tmap")
    assert str(caught.value).startswith(str(tmp_path / "bad.tmap")) and "\n" not in str(caught.value)


def test_what_a_reader_gives_is_bounded_before_it_is_written(tmp_path: Path) -> None:
    odd = ["a\nb\x00c", "x" * 999, "\ud800", " ", "ok"]
    at = np.array([[np.inf, 0, 0], [0, np.nan, 0], [1, 2, 3], [0, 0, 0], [AWAY, 0, 0]])
    landmarks = build_landmarks("text", odd, "r", at, sigma=[-1, np.inf, 0.5, 1, 1], confidence=[np.nan, 7, 0.5, 1, 1])
    save_map(replace(building(1, 1), landmarks=landmarks), tmp_path / "a.tmap")
    back = load_map(tmp_path / "a.tmap").landmarks
    assert back.get_values().tolist() == ["a b\ufffdc", "x" * LONGEST_VALUE, "\ufffd", "ok"]
    assert np.isfinite(back.table["position"]).all(axis=1).tolist() == [False, False, True, False]
    assert np.isnan(back.table["sigma"]).tolist() == [True, True, False, False]
    assert back.table["confidence"].tolist() == [0, 1, 0.5, 1]


def test_json_gives_them_back() -> None:
    listing = json.loads(json.dumps(convert_map_to_json(with_landmarks()), allow_nan=False))
    assert equal(parse_landmarks(listing["landmarks"], "a.json"), some_landmarks())
    assert [room.get("name") for room in listing["rooms"]] == ["2.113", None, 'Küche; "rot", klein', None, None, None]
    assert convert_map_to_json(building(1, 1))["landmarks"] == []
    with pytest.raises(InputError, match=r"a\.json: landmark 1 is damaged \('noise' is not in list\)|a\.json: landmark"):
        parse_landmarks([{"kind": "noise", "value": "x"}], "a.json")


def test_info_counts_and_names() -> None:
    text = format_map(with_landmarks())
    assert "6 landmarks (1 text, 1 tag, 2 radio, 1 pressure, 1 name); " in text.splitlines()[0]
    assert text.splitlines()[2].split()[-3:] == ["name", "leads", "to"] and " 2.113  2" in text
    assert "landmark" not in format_map(building(1, 1)) and "name" not in format_map(building(1, 1))


def test_a_table_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "landmarks.csv"
    path.write_text(format_landmark_table(some_landmarks()), encoding="utf-8")
    back = read_landmark_file(path)
    assert equal(back, some_landmarks(), sources=False) and back.sources == ("landmarks.csv",)
    path.write_text("\ufeffValue;KIND;x;y;z\n\n 101 ;text;1;2;3\n;pressure;;;\n", encoding="utf-8")
    back = read_landmark_file(path)
    assert back.get_values().tolist() == ["101", ""] and back.table["position"][0].tolist() == [1, 2, 3]
    path.write_text("kind,value\n", encoding="utf-8")
    assert len(read_landmark_file(path)) == 0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "line 1: kind and value must be among the columns"),
        ("kind,x,y,z\n", "line 1: kind and value must be among"),
        ("kind,value,colour\n", "line 1: 'colour' is no column"),
        ("kind,value,kind\n", "line 1: 'kind' is no column, or is there twice"),
        ("kind,value\ntext,a\nsmell,b\n", "line 3: kind must be one of text, tag"),
        ("kind,value\ntext\n", "line 2: has 1 columns, not 2"),
        ("kind,value\ntext,\n", "line 2: value is empty"),
        ("kind,value,x,y,z\ntext,a,1,2,3\n\ntext,a,nan,2,3\n", "line 4: x is no finite number"),
        ("kind,value,x,y,z\ntext,a,1,inf,3\n", "line 2: y is no finite number"),
        ("kind,value,x,y,z\ntext,a,1,2,far\n", "line 2: z is no finite number"),
        ("kind,value,x,y,z\ntext,a,1,2,\n", "line 2: x, y and z belong together"),
        ("kind,value,room\ntext,a,1.5\n", "line 2: room must be 0, 1, 2"),
        ("kind,value,storey\ntext,a,-7\n", "line 2: storey must be 0, 1, 2"),
        ("kind,value,group\ntext,a,1e30\n", "line 2: group must be 0, 1, 2"),
        ("kind,value,confidence\ntext,a,1.1\n", "line 2: confidence must be 0 to 1"),
        ("kind,value,sigma\ntext,a,-1\n", "line 2: sigma must not be below 0"),
        (f'kind,value\ntext,"{"x" * 200_000}"\n', "is no line of a table"),
    ],
)
def test_a_wrong_line_is_named(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "a.landmarks.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=said) as caught:
        read_landmark_file(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_bytes_that_are_no_text(tmp_path: Path) -> None:
    (tmp_path / "landmarks.csv").write_bytes(b"kind,value\ntext,\xff\xfe\n")
    with pytest.raises(InputError, match="is no text in UTF-8"):
        read_landmark_file(tmp_path / "landmarks.csv")


def scan_of_two_rooms(folder: Path, text: str, turn: Array | None = None) -> Path:
    points = two_rooms().points()
    np.save(folder / "scan.npy", points if turn is None else points @ turn.T)
    (folder / "scan.landmarks.csv").write_text(text)
    return folder / "scan.npy"


def test_a_table_beside_a_scan_is_read_without_an_option(tmp_path: Path) -> None:
    path = scan_of_two_rooms(tmp_path, "kind,value,x,y,z,sigma\ntext,101,1000,1000,1500,200\n")
    assert find_landmark_file(path) == tmp_path / "scan.landmarks.csv"
    cloud = read_points(path, unit="mm")
    assert cloud.landmarks is not None and cloud.landmarks.table["position"].tolist() == [[1, 1, 1.5]]
    assert cloud.landmarks.table["sigma"].tolist() == [0.2]
    turned = read_points(path, unit="mm", up="y").landmarks
    assert turned is not None and turned.table["position"].tolist() == [[1, -1.5, 1]]
    (tmp_path / "scan.landmarks.csv").write_text("kind,value\nsmell,x\n")
    with pytest.raises(InputError, match=r"scan\.landmarks\.csv, line 2: kind"):
        read_points(path)
    (tmp_path / "scan.landmarks.csv").unlink()
    assert read_points(path).landmarks is None


def test_the_only_file_of_a_folder_has_the_folders_table(tmp_path: Path) -> None:
    path = scan_of_two_rooms(tmp_path, "")
    beside, shared = tmp_path / "scan.landmarks.csv", tmp_path / "landmarks.csv"
    beside.unlink()
    shared.write_text("kind;value;x;y;z\ntext;101;1,5;1;1,5\ntext;102;;;\n")  # as a spreadsheet in German saves it
    cloud = read_points(path)
    assert cloud.landmarks is not None and cloud.landmarks.table["position"][0].tolist() == [1.5, 1, 1.5]
    assert cloud.warnings[-1].startswith(f"{shared}: 1 landmark without a place, a room and a storey")
    np.save(tmp_path / "other.npy", two_rooms().points())
    cloud = read_points(path)
    assert cloud.landmarks is None and cloud.warnings == (
        f"{shared}: lies beside several files and was not read; name it scan.landmarks.csv if it is this one's",
    )
    shared.rename(tmp_path / "scan.npy.landmarks.csv")
    assert len(read_points(path).landmarks or ()) == 2


def test_a_folder_has_a_table_of_its_own(tmp_path: Path) -> None:
    points = two_rooms().points()
    for k, part in enumerate(np.array_split(points, 2)):
        np.save(tmp_path / f"{k}.npy", part)
    (tmp_path / "landmarks.csv").write_text("kind,value,x,y,z\nobject,sofa,1,1,0.4\n")
    cloud = read_points(tmp_path, one_frame=True)
    assert len(cloud) == len(points) and cloud.landmarks is not None and cloud.landmarks.values == ("sofa",)


@pytest.mark.longer
def test_extraction_gives_them_rooms_also_of_tilted_scans(tmp_path: Path) -> None:
    said = "kind,value,x,y,z,room\ntext,101,1,1,1.5,\nname,Lab,,,,1\nname,gone,,,,9\n"
    map = extract(read_points(scan_of_two_rooms(tmp_path, said)), name="scan.npy")
    rooms = map.landmarks.table["room"].tolist()
    lo, hi = map.rooms["lo"][rooms[0]], map.rooms["hi"][rooms[0]]
    assert (lo[:2] <= 1).all() and (hi[:2] >= 1).all() and rooms[1:] == [1, -1]
    assert map.warnings[-1] == "1 landmark of rooms that the map does not have (2 rooms, from 0)"
    angle = np.radians(6)
    tilt = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    x, y, z = (tilt @ (1, 1, 1.5)).tolist()
    tilted = extract(read_points(scan_of_two_rooms(tmp_path, f"kind,value,x,y,z\ntext,101,{x},{y},{z}\n", tilt)))
    assert "levelled" in tilted.parameters
    floor = float(tilted.storeys["floor"][0])
    assert tilted.landmarks.table["position"][0, 2] - floor == pytest.approx(1.5, abs=0.15)
    assert tilted.landmarks.table["room"][0] >= 0
