"""Merges in the studio: the verdict, where maps lie, rigid and bent, and what people decide of them."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import topomerge as tm
from tests.fusion.atlas.atlas_scenes import office_map, truth

pytest.importorskip("starlette")

from topomerge.edits.journal import append_edits, build_edit, find_journal, read_journal
from topomerge.errors import InputError
from topomerge.matching.poses import pose_difference
from topomerge.studio.folder import StudioFolder
from topomerge.studio.maps import OpenMaps
from topomerge.studio.merges import accept_placed, decide, describe_merge, place_pair
from topomerge.types import Sim3


@pytest.fixture(scope="module")
def merged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two maps of one office and their merge."""
    root = tmp_path_factory.mktemp("merged")
    maps = []
    for k, name in ((0, "west"), (2, "east")):
        tm.save_map(office_map(k), root / f"{name}.tmap")
        maps.append(tm.load_map(root / f"{name}.tmap"))
    tm.merge(maps).save(root / "west + east")
    return root


def listed(root: Path) -> dict[str, Any]:
    return json.loads((root / "west + east" / "merge.json").read_text())


def test_the_verdict_is_told_with_its_evidence(merged: Path) -> None:
    folder, maps = StudioFolder(merged), OpenMaps()
    told = describe_merge(folder, maps, merged / "west + east")
    assert told["status"] == "merged" and told["proposed"] and told["reason"] == listed(merged)["reason"]
    assert [one["path"] for one in told["maps"]] == ["west.tmap", "east.tmap"]
    assert told["joined"] == "west + east/map.tmap" and told["report"] == "west + east/report.html"
    assert ("Matched rooms", str(len(listed(merged)["matches"]))) in told["facts"]
    assert all(share >= 0.005 for _, share in told["alternatives"]) and told["alternatives"][0][0] == "the same place"
    pose = Sim3.from_matrix(np.array(told["maps"][1]["matrix"]))
    shift, turn, _ = pose_difference(pose, truth(0, 2), np.zeros(3))
    assert shift < 0.3 and abs(turn) < 0.02
    assert json.loads(json.dumps(told)) is not None
    kinds = {entry["path"]: entry["kind"] for entry in folder.list_entries()}
    assert kinds == {"west.tmap": "map", "east.tmap": "map", "west + east": "merge", "west + east/map.tmap": "map"}


def test_maps_are_drawn_as_they_are_bent(merged: Path, tmp_path: Path) -> None:
    from topomerge.fusion.result import build_placements, serialise_bend
    from topomerge.types import Deformation

    map = office_map(2)
    floor = np.array([float(map.storeys["floor"][0])])
    moves, covariance = np.array([[0.3, 0.0, 0.0, 0.0], [0.3, 0.0, 0.0, 0.0]]), np.full((2, 3, 3), np.nan)
    anchors = np.stack([map.grid.bounds[0][:2], map.grid.bounds[1][:2]])
    bend = Deformation(anchors, np.zeros(2, np.int64), floor, moves, covariance, np.zeros(2, np.int32), 5.0)
    listing = listed(merged)
    listing["bend"] = {"1": serialise_bend(map, build_placements({1: Sim3()}, {1: bend})[1])}
    for name in ("west.tmap", "east.tmap"):
        (tmp_path / name).write_bytes((merged / name).read_bytes())
    (tmp_path / "both").mkdir()
    (tmp_path / "both" / "merge.json").write_text(json.dumps(json.loads(json.dumps(listing, default=float))))
    told = describe_merge(StudioFolder(tmp_path), OpenMaps(), tmp_path / "both")
    rigid, bent = OpenMaps().load(tmp_path / "east.tmap").list_walls()[0], told["maps"][1]["bent"][0]
    start = [[int(v) for v in d[1 : d.index("l")].split()] for d in (rigid, bent)]
    assert told["maps"][0]["bent"] is None and abs(np.hypot(*np.subtract(*start)) - 30) < 3  # cm


def test_a_damaged_merge_is_told(tmp_path: Path) -> None:
    (tmp_path / "both").mkdir()
    for text in ("", "[]", "{", "3"):
        (tmp_path / "both" / "merge.json").write_text(text)
        told = describe_merge(StudioFolder(tmp_path), OpenMaps(), tmp_path / "both")
        assert told["status"] == "damaged" and not told["proposed"]
    for text in ('{"maps": [3]}', '{"maps": [], "alternatives": 3}', '{"maps": [{}], "transforms": {"x": 1}}', '{"maps": null}'):
        (tmp_path / "both" / "merge.json").write_text(text)
        with pytest.raises(InputError, match="damaged"):
            describe_merge(StudioFolder(tmp_path), OpenMaps(), tmp_path / "both")


@pytest.mark.longer
def test_rooms_that_are_one_place_a_map_and_a_map_that_was_moved_snaps(merged: Path) -> None:
    maps, paths = OpenMaps(), [merged / "west.tmap", merged / "east.tmap"]
    rooms = [m["rooms"] for m in listed(merged)["matches"]]
    placed = place_pair(maps, paths, {"rooms": rooms})
    pose = Sim3.from_matrix(np.array(placed["matrix"]))
    assert pose_difference(pose, truth(0, 2), np.zeros(3))[0] < 0.3 and len(placed["words"]) > 2
    moved = (Sim3(0.0, (0.7, -0.5, 0.0)) @ pose).matrix.tolist()
    again = Sim3.from_matrix(np.array(place_pair(maps, paths, {"matrix": moved})["matrix"]))
    assert pose_difference(again, pose, np.zeros(3))[0] < 0.1
    for odd in ({"rooms": rooms[:1]}, {"rooms": [[0, 99], [1, 1]]}, {"rooms": "ab"}, {}, {"matrix": [[1]]}, {"matrix": "x"}):
        with pytest.raises(InputError):
            place_pair(maps, paths, odd)
    with pytest.raises(InputError, match="two maps"):
        place_pair(maps, paths[:1], {"rooms": rooms})


def test_what_was_placed_by_hand_is_decided_in_the_journal(merged: Path) -> None:
    rooms = [m["rooms"] for m in listed(merged)["matches"]][:2]
    paths, place = [merged / "west.tmap", merged / "east.tmap"], merged / "by hand"
    matrix = truth(0, 2).matrix.tolist()
    accept_placed(OpenMaps(), paths, place, {"matrix": matrix, "rooms": rooms, "by": "Ada"})
    edits = read_journal(find_journal(place)).edits
    assert [edit.op for edit in edits] == ["match_rooms", "match_rooms", "accept_merge"] and edits[0].by == "Ada"
    assert edits[-1].values["matrix"] == matrix and edits[-1].values["sources"] == ["west.tmap", "east.tmap"]
    (find_journal(place)).unlink()
    place.rmdir()


def test_a_merge_is_accepted_and_rejected(merged: Path) -> None:
    folder, path = StudioFolder(merged), merged / "west + east"
    journal = find_journal(path)
    words = decide(folder, path, {"verdict": "accept", "by": "Ada"})
    assert words == ("merge", "west.tmap", "east.tmap", "-o", "west + east")
    decide(folder, path, {"verdict": "reject"})
    accepted, rejected = read_journal(journal).edits
    assert (accepted.op, rejected.op) == ("accept_merge", "reject_merge") and accepted.values["maps"] == [0, 1]
    decisions = describe_merge(folder, OpenMaps(), path)["decisions"]
    assert decisions[0].startswith("accepted · Ada · 20") and decisions[1].startswith("rejected · 20")
    append_edits(journal, [build_edit("undo", edit=rejected.id)])
    assert len(describe_merge(folder, OpenMaps(), path)["decisions"]) == 1
    with pytest.raises(InputError, match="only a merge of two maps"):
        decide(folder, path, {"verdict": "maybe"})
    journal.unlink()


@pytest.mark.longer
def test_a_rejected_merge_is_merged_anew_apart(merged: Path) -> None:
    from starlette.testclient import TestClient

    from topomerge.studio.server import Studio

    studio, base = Studio(merged), "http://127.0.0.1:8000"
    with TestClient(studio.app, base) as client:
        client.get(f"/?token={studio.access.token}")
        answer = client.post("/api/decide/west + east", json={"verdict": "reject"}, headers={"origin": base})
        assert answer.status_code == 202, answer.text
        end = time.monotonic() + 240
        while (job := client.get("/api/folder").json()["jobs"][-1])["state"] in ("waiting", "running"):
            assert time.monotonic() < end
            time.sleep(0.2)
        assert (job["state"], job["status"]) == ("done", 2), job
        told = client.get("/api/merge/west + east").json()
    assert told["status"] == "abstained" and "by hand" in told["reason"] and not told["proposed"] and told["joined"] is None
