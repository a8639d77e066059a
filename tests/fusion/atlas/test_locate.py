"""Where was a scan taken: a part of a map is found where it was cut, turned as it was turned; strangers and twins are told."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import topomerge as tm
from tests.cases import list_longer
from tests.fusion.atlas.atlas_scenes import office_map, stranger
from tests.fusion.plans_of import office
from topomerge import archive
from topomerge.cli.main import main as cli
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.extraction.landmarks import add_landmarks
from topomerge.fusion.atlas.folder import Entry, StoredAtlas, read_atlas
from topomerge.fusion.atlas.locate import LOCATE, Location, Place, Query, find_places, locate, prepare_query
from topomerge.fusion.atlas.place_index import INDEX_FOLDER, PlaceIndex, open_index
from topomerge.fusion.atlas.store import add, remove
from topomerge.landmarks.map_search import build_landmark_index
from topomerge.types import Array, PointCloud, Sim3, TopometricMap, build_landmarks
from topomerge.viz.atlas_report import render_atlas_html

LOW, HIGH = (-0.4, -0.4), (7.0, 7.0)  # of the part that is scanned, m in the frame of the office
STRAIGHT = Sim3()
SENSOR = np.array([2.5, 2.0, 1.5])


@cache
def whole() -> TopometricMap:
    """All of the office."""
    return extract(office().points(), name="office")


def scan_part(frame: Sim3 = STRAIGHT, low: tuple[float, float] = LOW, high: tuple[float, float] = HIGH) -> PointCloud:
    """A part of the office from a sensor in it, in a frame of its own."""
    points = office().points()
    inside = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)
    poses = np.eye(4)[None].copy()
    poses[0, :3, 3] = frame.apply(SENSOR[None])[0]
    moved = frame.apply(points[inside]).astype(np.float32)
    return PointCloud(moved, poses=poses, pose_of=np.zeros(len(moved), np.int32), upright=True)


@cache
def query() -> Query:
    """The part, prepared once."""
    return prepare_query(scan_part())


@cache
def index() -> PlaceIndex:
    """The office and a stranger."""
    return PlaceIndex.from_maps({"office": whole(), "stranger": stranger()})


def room_at(map: TopometricMap, place: Array) -> int:
    """The room on whose floor a place stands."""
    floor = map.navigable.compute_centroids()
    return int(map.navigable_room[np.hypot(*(floor[:, :2] - place[:2]).T).argmin()])


@cache
def answer_of_part() -> Location:
    """Where the part is."""
    return locate(index(), scan_part())


def test_a_part_of_a_map_is_found_where_it_was_cut() -> None:
    answer = answer_of_part()
    assert answer.status == "located" and answer.told == 1, answer.reason
    place = answer.places[0]
    assert place.map == "office" and place.storey == 0
    assert np.allclose(place.pose.apply(SENSOR[None])[0], SENSOR, atol=0.12) and abs(place.pose.yaw) < np.radians(1.0)
    assert place.room == room_at(whole(), SENSOR) and place.probability >= LOCATE.sure
    covariance = np.array(place.covariance)
    assert np.allclose(covariance, covariance.T) and (np.linalg.eigvalsh(covariance) > 0).all() and covariance[0, 0] < 0.1**2


@pytest.mark.parametrize("frame", [Sim3(1.2, (4.0, -7.0, 0.6)), *list_longer(Sim3(-2.9, (30.0, 12.0, -2.0)))])
def test_a_turned_scan_gives_the_pose_that_turns_it_back(frame: Sim3) -> None:
    straight, turned = answer_of_part(), locate(index(), scan_part(frame))
    assert turned.status == straight.status == "located"
    back = turned.places[0].pose @ frame
    assert np.allclose(back.apply(SENSOR[None]), straight.places[0].pose.apply(SENSOR[None]), atol=0.12)
    assert abs(back.yaw - straight.places[0].pose.yaw) < np.radians(1.0) and turned.places[0].room == straight.places[0].room


def test_a_scan_of_another_building_is_not_here() -> None:
    """As sure as it may be: by the usual .99 it is told only that no place fits."""
    atlas = PlaceIndex.from_maps({"stranger": stranger()})
    answer = locate(atlas, query(), replace(LOCATE, absent=0.9))
    assert answer.status == "not here" and not answer.told and answer.nowhere >= 0.5 and "not here" in answer.reason
    usual = locate(atlas, query())
    assert usual.status == "ambiguous" and not usual.told and "no place fits well" in usual.reason


def test_two_copies_of_one_map_cannot_be_told_apart() -> None:
    twins = PlaceIndex.from_maps({"one": whole(), "two": whole(), "stranger": stranger()})
    answer = locate(twins, query())
    assert answer.status == "ambiguous" and answer.told == 2 and "cannot tell between 2" in answer.reason
    assert {p.map for p in answer.places[:2]} == {"one", "two"}
    assert answer.places[0].probability == pytest.approx(answer.places[1].probability, abs=1e-6)
    assert sum(p.probability for p in answer.places) + answer.nowhere <= 1 + 1e-9


def test_maps_of_one_building_name_one_place() -> None:
    twins = PlaceIndex.from_maps({"one": whole(), "two": whole()})
    joined = replace(twins, maps=tuple(replace(m, building=0) for m in twins.maps))
    answer = locate(joined, query())
    assert answer.status == "located" and answer.places[0].probability > 0.9


@pytest.mark.longer
def test_a_map_is_found_as_its_scan_is() -> None:
    answer = locate(index(), office_map(1))
    assert answer.status == "located" and answer.places[0].map == "office"


def test_a_sign_tells_twins_apart() -> None:
    def with_sign(map: TopometricMap, text: str, at: Array) -> TopometricMap:
        return add_landmarks(map, build_landmarks("text", [text], "hand", at[None]))

    at = np.array([0.1, 2.0, 1.5])
    twins = PlaceIndex.from_maps({"one": with_sign(whole(), "4.711", at), "two": with_sign(whole(), "2.113", at)})
    scan = replace(scan_part(), landmarks=build_landmarks("text", ["2.113"], "hand", at[None]))
    answer = locate(twins, scan)
    assert answer.status == "located" and answer.places[0].map == "two"
    two = next(m for m in twins.maps if m.name == "two")
    assert any(two.rooms) and answer.places[0].room_name == two.rooms[answer.places[0].room]


def test_landmarks_name_the_maps_that_hold_the_same_rare_strings() -> None:
    def with_texts(*texts: str) -> TopometricMap:
        return replace(whole(), landmarks=build_landmarks("text", list(texts), "hand", np.zeros((len(texts), 3)) + SENSOR))

    maps = [with_texts("2.113", "EXIT"), with_texts("4.711", "EXIT"), whole(), with_texts("2.113", "4.711")]
    found = build_landmark_index(maps)
    assert [k for k, _ in found.rank(with_texts("4.711"))] == [1, 3] and found.rank(with_texts("EXIT")) == []
    assert [k for k, _ in found.rank(maps[0], but=0)] == [3] and found.rank(whole()) == []


def test_the_same_scan_gives_the_same_answer() -> None:
    first, second = answer_of_part(), locate(index(), scan_part())
    assert replace(first, seconds={}) == replace(second, seconds={})


def test_a_scan_without_walls_is_refused() -> None:
    floor = np.random.default_rng(0).uniform(0, 4, (4000, 3)) * (1, 1, 0.001)
    with pytest.raises(InputError, match="walls"):
        prepare_query(PointCloud(floor.astype(np.float32), upright=True))


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("atlas") / "house"
    add(folder, [("office", whole()), ("stranger", stranger())], render_atlas_html)
    return folder


def test_an_atlas_keeps_its_index(built: Path, tmp_path: Path) -> None:
    house = Path(shutil.copytree(built, tmp_path / "house"))
    first = tm.locate(house, query())
    files = sorted((house / INDEX_FOLDER).glob("*.npz"))
    assert len(files) == 2 and {f.stem for f in files} == {e.key for e in read_atlas(house).entries}
    before = [f.stat().st_mtime_ns for f in files]
    again = tm.locate(house, query())
    assert [f.stat().st_mtime_ns for f in files] == before
    direct = answer_of_part()
    for answer in (again, direct):
        assert answer.status == first.status == "located" and answer.places[0].room == first.places[0].room
        assert answer.places[0].probability == pytest.approx(first.places[0].probability, abs=0.02)
    remove(house, ["stranger"], render_atlas_html)
    open_index(house)
    assert len(list((house / INDEX_FOLDER).glob("*.npz"))) == 1


def _load_all(house: Path) -> None:
    for storey in open_index(house).storeys:
        storey.load()


@pytest.mark.parametrize("change", ["cut", "head", "shape", "nan"])
def test_a_damaged_index_is_told(built: Path, tmp_path: Path, change: str) -> None:
    house = Path(shutil.copytree(built, tmp_path / "house"))
    open_index(house)
    path = sorted((house / INDEX_FOLDER).glob("*.npz"))[0]
    if change == "cut":
        path.write_bytes(path.read_bytes()[:200])
    else:
        arrays = archive.read(path)
        key = {"head": "0.head", "shape": "0.rooms", "nan": "0.directions"}[change]
        arrays[key] = {"head": arrays["0.head"][:3], "shape": arrays["0.rooms"][:4], "nan": arrays["0.directions"] * np.nan}[
            change
        ]
        archive.write(arrays, path)
    with pytest.raises(InputError, match=r"locate/.*\.npz: .*delete|damaged|cut"):
        _load_all(house)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_an_atlas_that_may_only_be_read_is_searched(built: Path, tmp_path: Path) -> None:
    house = Path(shutil.copytree(built, tmp_path / "house"))
    shutil.rmtree(house / INDEX_FOLDER, ignore_errors=True)
    house.chmod(0o500)
    try:
        assert tm.locate(house, query()).status == "located"
    finally:
        house.chmod(0o700)


def test_an_empty_atlas_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("topomerge.fusion.atlas.place_index.read_atlas", lambda folder: StoredAtlas(tmp_path))
    with pytest.raises(InputError, match="holds no maps yet"):
        open_index(tmp_path)
    assert Entry("a", "k", "s", 1, 1).file == "maps/a.tmap"


@pytest.mark.longer
def test_the_command_tells_and_exits(built: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def write(path: Path, points: Array) -> str:
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
        head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
        path.write_bytes(head.encode() + points.astype("<f4").tobytes())
        return str(path)

    scan = write(tmp_path / "scan.ply", scan_part().points)
    assert cli(["locate", str(built), scan]) == 0
    assert capsys.readouterr().out.startswith("office, storey 0, room ")
    assert cli(["locate", str(built), scan, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["status"] == "located" and np.array(told["places"][0]["pose"]).shape == (4, 4) and told["format"] == 1
    small = write(tmp_path / "other.ply", stranger().grid.compute_centroids()[:, [1, 0, 2]] * (1.31, 0.77, 1.0))
    assert cli(["locate", str(built), small, "-q"]) == 2
    assert cli(["locate", str(tmp_path / "none"), scan]) == 1
    assert "no such folder" in capsys.readouterr().err


def test_a_place_without_a_room_and_an_angle_of_nought() -> None:
    place = Place("a", 0, 0, -1, Sim3(-0.001), (0.0, 0.0, 0.0), ((0.0,) * 3,) * 3, 0.9)
    assert "no room" in place.describe() and "facing 0 degrees" in place.describe()
    assert Location("located", (place,), 1, 0.1, "").serialise()["places"][0]["room"] is None


def test_all_probabilities_sum_to_one() -> None:
    judged = find_places(index(), query(), LOCATE)
    assert len(judged) == LOCATE.judged and all(np.isfinite(j.features).all() for j in judged)
    answer: Location = locate(index(), query())
    assert 0 <= answer.nowhere <= 1 and all(0 <= p.probability <= 1 for p in answer.places)
