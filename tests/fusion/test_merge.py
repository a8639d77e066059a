"""Two maps of one building become one; maps that do not belong together do not; what is written can be read."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

import topomerge as tm
from tests.fusion.atlas.atlas_scenes import REGISTRATIONS, office_map
from tests.fusion.atlas.atlas_scenes import stranger as another
from tests.fusion.plans_of import MOVE, off, office, part
from tests.scenes import Scene, two_rooms
from topomerge.errors import InputError
from topomerge.fusion.atlas.solve import solve
from topomerge.fusion.fuse import find_joined_rooms
from topomerge.fusion.inputs import find_risk_threshold, resolve_threshold
from topomerge.fusion.result import MERGE_STEPS, MergeResult, serialise_merge
from topomerge.matching.consistency import compute_match_probability
from topomerge.types import Sim3, TopometricMap, is_mostly_unseen


def map_of(points: np.ndarray, name: str, frame: Sim3 | None = None) -> TopometricMap:
    return tm.extract((frame or Sim3()).apply(points).astype(np.float32), name=name)


@pytest.fixture(scope="module")
def points():
    return office().points()


@pytest.fixture(scope="module")
def halves(points):
    """The west and the east of the office, in two frames; T_ab = MOVE^-1."""
    return map_of(part(points, high=(16, 99)), "a.ply"), map_of(part(points, low=(5, -99)), "b.ply", MOVE)


@pytest.fixture(scope="module")
def merged(halves):
    return tm.merge(halves)


@pytest.fixture(scope="module")
def whole(points):
    return map_of(points, "whole")


@pytest.fixture(scope="module")
def stranger():
    return map_of(two_rooms().points(), "c.ply", MOVE)


@pytest.fixture(scope="module")
def refused(halves, stranger):
    return tm.merge([halves[0], stranger])


@pytest.mark.longer
def test_what_it_may_be_and_what_each_place_says_stand_in_the_listing(merged, refused):
    for result in (merged, refused):
        listing = serialise_merge(result)
        assert sum(listing["alternatives"].values()) == pytest.approx(1.0, abs=1e-4)
        assert listing["alternatives"]["here"] == pytest.approx(result.probability, abs=1e-5)
        assert listing["places"] and all(set(p) == {"at", "m2", "log_odds"} for p in listing["places"])
    at = np.array([p["at"] for p in serialise_merge(merged)["places"]])
    assert (at[:, :2] > (-1, -1)).all() and (at[:, :2] < (25, 15)).all()  # in the frame of the first map


@pytest.mark.longer
def test_what_the_maps_are_of_raises_what_is_believed_and_a_risk_sets_the_threshold(halves, stranger, refused):
    each = [tm.merge([halves[0], stranger], same=same).probability for same in ("building", "storey")]
    assert refused.probability <= each[0] <= each[1]
    assert 0.5 <= find_risk_threshold(1000) < resolve_threshold(None) < find_risk_threshold(5) < 1
    with pytest.raises(InputError, match="same must be nothing, building, storey"):
        tm.merge(halves, same="house")
    with pytest.raises(InputError, match=r"risk 1e-05: the lowest measured risk"):
        find_risk_threshold(1e-5)


def test_two_halves_are_merged(merged, halves):
    assert merged.merged and merged.probability > 0.9 and "merged" in merged.reason
    middle = tuple(MOVE.apply(np.array([[10.0, 7.0, 1.0]]))[0])
    metres, degrees = off(merged.transforms[1], MOVE.inverse(), middle)
    assert metres < 0.06 and degrees < 0.2
    assert set(merged.seconds) == set(MERGE_STEPS) and merged.seconds["fuse"] > 0
    assert merged.maps == halves


@pytest.fixture(scope="module")
def stricter(halves):
    """The halves where nothing is sure enough."""
    return tm.merge(halves, threshold=1.0)


@pytest.mark.longer
def test_rooms_are_matched_only_where_walls_are_not_believed(merged, refused, halves, stricter):
    assert merged.seconds["embed"] == merged.seconds["match"] == 0
    assert refused.seconds["embed"] > 0 and refused.seconds["match"] > 0
    assert not stricter.merged and stricter.seconds["embed"] > 0
    assert tm.merge(halves, threshold=0.0, poses="rooms").seconds["embed"] > 0  # there are no others
    by_rooms = tm.merge(halves, poses="rooms")
    assert by_rooms.merged and by_rooms.seconds["embed"] > 0
    with pytest.raises(InputError, match="nobody"):  # before anything is done
        tm.merge(halves, embedder="nobody")


def walled(map: TopometricMap) -> np.ndarray:
    """Areas of what doors and walls part, ascending: where corridors cross without a door, people see one room or two."""
    rooms = map.edges["rooms"][map.edges["kind"] == "opening"].reshape(-1, 2)
    links = coo_matrix((np.ones(len(rooms)), tuple(rooms.T)), (len(map.rooms),) * 2)
    return np.sort(np.bincount(connected_components(links, directed=False)[1], map.rooms["area"]))


@pytest.mark.longer
def test_the_joined_map_has_the_rooms_of_the_whole(merged, whole):
    assert len(walled(merged.map)) == len(walled(whole)) == 9
    assert walled(merged.map) == pytest.approx(walled(whole), rel=0.07)
    assert merged.map.rooms["area"].sum() == pytest.approx(whole.rooms["area"].sum(), rel=0.05)
    assert abs(len(merged.map.edges) - len(whole.edges)) <= 1
    assert merged.map.source == "a.ply + b.ply" and merged.map.free is not None


@pytest.mark.longer
def test_the_joined_map_has_as_many_rooms_as_the_whole(merged, whole):
    assert abs(len(merged.map.rooms) - len(whole.rooms)) <= 1  # corridors cross once in this office: one room or two


@pytest.mark.longer
def test_the_other_way_round_is_the_inverse(merged, halves):
    back = tm.merge(halves[::-1])
    assert np.allclose((merged.transforms[1] @ back.transforms[1]).matrix, np.eye(4), atol=1e-6)
    assert back.probability == pytest.approx(merged.probability)
    assert {m.rooms for m in merged.matches} == {m.rooms[::-1] for m in back.matches}


def test_rooms_match_where_both_saw_them(merged, halves):
    a, b = halves
    assert merged.matches
    for match in merged.matches:
        i, j = match.rooms
        there = MOVE.inverse().apply(b.rooms["centroid"][j][None])[0]
        both_whole = a.rooms["lo"][i][0] > 5 and a.rooms["hi"][i][0] < 16
        if both_whole:
            assert np.linalg.norm(a.rooms["centroid"][i] - there) < 0.5
        assert 0 < match.probability <= merged.probability and match.maps == (0, 1)
    within = find_joined_rooms(a, merged.map, Sim3()), find_joined_rooms(b, merged.map, merged.transforms[1])
    assert all(within[0][m.rooms[0]] == within[1][m.rooms[1]] for m in merged.matches)


def test_whole_rooms_are_surer_than_scraps(halves):
    a = halves[0]
    whole, scrap = (
        int(pick(np.where(is_mostly_unseen(a.rooms), np.nan, a.rooms["area"]))) for pick in (np.nanargmax, np.nanargmin)
    )
    tiny = replace(a, rooms=a.rooms.copy())
    tiny.rooms["area"][scrap] = 0.6
    assert compute_match_probability(tiny, tiny, np.array([[scrap, scrap]]), np.ones(1))[0] < 0.75
    rooms = np.array([[whole, whole]])
    one, half = compute_match_probability(a, a, rooms, np.ones(1)), compute_match_probability(a, a, rooms, np.full(1, 0.2))
    pieces = compute_match_probability(a, a, np.array([[whole, whole], [whole, whole + 1]]), np.ones(2))
    assert one[0] > 0.85 and half[0] < one[0] and pieces[0] < one[0] - 0.01
    assert compute_match_probability(a, a, np.zeros((0, 2), int), np.zeros(0)).shape == (0,)


def test_unrelated_maps_are_refused(refused):
    assert refused.status == "abstained" and not refused.merged
    assert not refused.transforms and refused.map is None and not refused.matches
    assert "not merged" in refused.reason and refused.probability < 0.9


@pytest.mark.longer
def test_force_joins_them_and_still_says_no(halves, stranger):
    forced = tm.merge([halves[0], stranger], force=True)
    assert forced.status == "abstained" and 1 in forced.transforms and forced.map is not None and "force" in forced.reason


@pytest.mark.longer
def test_a_threshold_is_kept_to(halves, stricter):
    assert stricter.status == "abstained"
    for wrong in (-0.1, 1.1, float("nan")):
        with pytest.raises(InputError, match="between 0 and 1"):
            tm.merge(halves, threshold=wrong)


@pytest.mark.longer
def test_cells_of_maps_that_were_joined_before_are_theirs(merged, halves):
    from topomerge.viz.merge_report import _compute_observers

    again = tm.merge([merged.map, halves[1]])
    seen = _compute_observers(again)
    assert np.array_equal(seen == 1, (again.map.provenance & 0b100) == 0) and np.bincount(seen)[3] > 1000


def test_json_has_the_schema(merged, refused):
    listing = serialise_merge(merged)
    assert list(listing)[:5] == ["format", "status", "probability", "reason", "descriptor"]
    assert list(listing)[5:] == [
        "maps",
        "transforms",
        "bend",
        "matches",
        "decided",
        "seconds",
        "points",
        "alternatives",
        "places",
        "contradictions",
        "evidence",
        "settle",
    ]
    assert listing["descriptor"] == "learned"
    assert listing["format"] == 1 and listing["status"] == "merged" and 0 <= listing["probability"] <= 1
    assert listing["maps"][0] == {"source": "a.ply", "rooms": len(merged.maps[0].rooms), "storeys": 1}
    assert list(listing["transforms"]) == ["1"]
    entry = listing["transforms"]["1"]
    assert set(entry) == {"into", "matrix", "scale", "yaw_deg", "rmse_m"} and entry["into"] == 0
    point = np.array([1.0, 2.0, 3.0, 1.0])
    assert np.allclose((np.array(entry["matrix"]) @ point)[:3], merged.transforms[1].apply(point[None, :3])[0])
    assert all(set(m) == {"maps", "rooms", "probability"} and m["maps"] == [0, 1] for m in listing["matches"])
    assert set(listing["seconds"]) == set(MERGE_STEPS)
    assert serialise_merge(refused)["transforms"] == {} and serialise_merge(refused)["matches"] == []
    json.dumps(listing, allow_nan=False)


@pytest.mark.longer
def test_save_writes_all_and_a_refusal_takes_back_the_rest(merged, refused, tmp_path):
    folder = tmp_path / "deep" / "merged"
    merged.save(folder)
    assert sorted(p.name for p in folder.iterdir()) == ["map.tmap", "merge.json", "merged.ply", "report.html"]
    back = tm.load_map(folder / "map.tmap")
    assert np.array_equal(back.provenance, merged.map.provenance) and len(back.rooms) == len(merged.map.rooms)
    assert json.loads((folder / "merge.json").read_text()) == serialise_merge(merged)
    (folder / "notes.txt").write_text("mine")
    refused.save(folder)
    assert sorted(p.name for p in folder.iterdir()) == ["merge.json", "notes.txt", "report.html"]


def test_saving_leaves_nothing_half_written(merged, tmp_path, monkeypatch):
    import topomerge.viz.merge_report as report

    def fail(*_: object) -> None:
        raise InputError("disk full")

    monkeypatch.setattr(report, "save_map", fail)
    with pytest.raises(InputError, match="disk full"):
        merged.save(tmp_path / "new")
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="can't be made"):
        merged.save(tmp_path / "file" / "merged")


@pytest.mark.longer
def test_the_report_says_it_all(merged, refused):
    from topomerge.viz.merge_report import render_merge_html

    text = render_merge_html(merged)
    for words in (
        "Merged · probability",
        "matching walls",
        "Why it is believed",
        "data-blend",
        'data-room="a0"',
        'data-room="b0"',
    ):
        assert words in text
    assert render_merge_html(merged) == text and "http" not in text.replace("http-equiv", "")
    no = render_merge_html(refused)
    assert "Not merged" in no and "Why it is not believed" in no and "data-scene=" not in no


def test_bad_maps_are_refused(halves, stranger):
    a, b = halves
    with pytest.raises(InputError, match="a.ply: is the same map as a.ply"):
        tm.merge([a, a])
    with pytest.raises(InputError, match="is the same map"):
        tm.merge([a, replace(a, source="copy.ply")])
    with pytest.raises(InputError, match="is the same map"):
        tm.merge([a, b, a])
    with pytest.raises(InputError, match="merge takes two"):
        tm.merge([a])
    with pytest.raises(InputError, match="fixed or free"):
        tm.merge([a, b], scale="any")
    large = replace(a, grid=replace(a.grid, edge=a.grid.edge * 100), source="cm.ply")
    with pytest.raises(InputError, match="cm.ply: spans .* --unit cm"):
        tm.merge([large, b])
    with pytest.raises(ValueError, match="merged or abstained"):
        MergeResult("perhaps", 0.5, "")


@pytest.mark.longer
def test_maps_with_one_room_or_none_are_tried(stranger):
    room = map_of(Scene().shell(0, 0, 5, 4).points(), "room.ply")
    assert any("room.ply: has one room" in w for w in tm.merge([room, stranger]).warnings)
    empty = replace(room, rooms=room.rooms[:0], edges=room.edges[:0], areas=room.areas[:0], narrows=room.narrows[:0],
                    room=np.full_like(room.room, -1), navigable_room=np.full_like(room.navigable_room, -1),
                    navigable_area=np.full_like(room.navigable_area, -1))  # fmt: skip
    result = tm.merge([empty, stranger], force=True)
    assert any("has no rooms" in w for w in result.warnings)
    assert not result.merged


@pytest.fixture
def remembered(monkeypatch):
    """Merging makes no registration twice."""
    monkeypatch.setattr("topomerge.fusion.pipeline.solve", lambda maps, settings, _: solve(maps, settings, REGISTRATIONS))


@pytest.mark.longer
def test_three_maps_are_merged_by_an_atlas(tmp_path, remembered):
    result = tm.merge([office_map(0), office_map(1), office_map(2)])
    assert result.merged and result.probability > 0.9 and set(result.transforms) == {1, 2}
    assert {m.maps for m in result.matches} == {(0, 1), (0, 2), (1, 2)}
    listing = serialise_merge(result)
    assert list(listing["transforms"]) == ["1", "2"] and listing["transforms"]["2"]["into"] == 0
    assert listing["transforms"]["2"]["rmse_m"] < 0.05
    json.dumps(listing, allow_nan=False)
    result.save(tmp_path / "merged")
    assert sorted(p.name for p in (tmp_path / "merged").iterdir()) == ["map.tmap", "merge.json", "merged.ply", "report.html"]
    page = (tmp_path / "merged" / "report.html").read_text(encoding="utf-8")
    assert "All maps are connected" in page and "south" in page and "data-scene=" in page


@pytest.mark.longer
def test_a_first_map_that_stands_apart_is_told(remembered):
    result = tm.merge([another(), office_map(0), office_map(2)])
    assert result.status == "abstained" and not result.transforms and result.map is None
    assert "stranger stands apart" in result.reason and "west, east" in result.reason
    forced = tm.merge([another(), office_map(0), office_map(2)], force=True)
    assert forced.status == "abstained" and set(forced.transforms) == {1, 2} and "force" in forced.reason
