"""Bent maps in the joined frame: their points, how each room moved, and the joined map that remembers it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.scenes_map import building
from tests.types.test_deformation import deformation, points
from topomerge.errors import InputError
from topomerge.fusion.result import BEND_PARAMETER, MergeResult, fit_room_moves, read_bends, serialise_merge
from topomerge.io.maps import load_map, save_map
from topomerge.types import Deformation, Placement, Sim3
from topomerge.viz.report import render_report_html

POSE = Sim3(0.7, (480_000.0, 5_400_000.0, 12.0))  # into a national grid
MOVES = np.random.default_rng(4).normal(0, (0.2, 0.2, 0.01, 0.0), (6, 4))


def merged(bend: Deformation | None, pose: Sim3 = POSE) -> MergeResult:
    a, b = building(1, 1), replace(building(2, 1), source="b.ply")
    bends = {} if bend is None else {1: bend}
    return MergeResult("merged", 0.9, "", transforms={1: pose}, maps=(a, b), bends=bends, map=a)


def test_a_map_that_was_bent_and_saved_is_read_again(tmp_path) -> None:
    result = merged(deformation(MOVES, storeys=2))
    save_map(result.map, tmp_path / "map.tmap")
    joined = load_map(tmp_path / "map.tmap")
    ((number, read),) = read_bends(joined).items()
    assert (number, joined.parameters[BEND_PARAMETER][0]["source"]) == (1, "b.ply")
    p = points(high=5.5)
    there = result.placements[1].transform_points(p)
    assert np.allclose(there, POSE.apply(result.bends[1].apply(p)))
    assert np.abs(read.transform_points(p) - there).max() < 1e-6  # m, of coordinates of millions
    assert np.abs(read.invert_points(there) - p).max() < 1e-6


def test_rigid_maps_leave_no_trace() -> None:
    for bend in (None, deformation(np.zeros((0, 4)))):
        result = merged(bend)
        assert BEND_PARAMETER not in result.map.parameters and read_bends(result.map) == {}
        assert serialise_merge(result)["bend"] == {} and result.placements[1].bend is None
    assert np.allclose(result.placements[1].transform_points(points()), POSE.apply(points()))
    assert set(result.placements) == {0, 1} and MergeResult("abstained", 0.1, "").placements == {}


def test_each_room_has_a_transform_of_its_own() -> None:
    """All pieces turn the map alike, about one point: so does the transform of each room, exactly."""
    turn = Sim3(0.02, (0.3, -0.1, 0.0))
    low, high = building(2, 1).grid.bounds
    anchors = np.stack(np.meshgrid(*(np.arange(low[k], high[k] + 3, 3.0) for k in (0, 1))), axis=-1).reshape(-1, 2)
    n = len(anchors)
    shifts = turn.apply(np.column_stack([anchors, np.zeros(n)]))[:, :2] - anchors
    moves = np.column_stack([shifts, np.full(n, turn.yaw), np.zeros(n)])
    nan = np.full((n, 3, 3), np.nan)
    nan[1] = np.diag([0.04, 0.01, 1e-4])
    bend = Deformation(anchors, np.zeros(n, int), np.zeros(1), moves, nan, np.arange(n, dtype=np.int32), 2.0)
    result = merged(bend)
    listing = json.loads(json.dumps(serialise_merge(result), allow_nan=False))["bend"]["1"]
    assert len(listing["pieces"]) == n and listing["reach_m"] == 2.0
    rooms = result.maps[1].rooms
    assert [entry["room"] for entry in listing["rooms"]] == list(range(len(rooms)))
    whole = POSE @ turn
    for entry, centroid in zip(listing["rooms"], rooms["centroid"], strict=True):
        there = np.array(entry["transform"]) @ np.append(centroid, 1.0)
        assert np.allclose(there[:3], whole.apply(centroid[None])[0], atol=2e-3)  # the lattice of the bending is bilinear
        assert entry["turn_deg"] == pytest.approx(np.degrees(0.02), abs=1e-3)
        shift = whole.apply(centroid[None])[0] - POSE.apply(centroid[None])[0]
        assert np.allclose(entry["shift_m"], shift[:2], atol=2e-3)
        assert entry["length_m"] == pytest.approx(np.hypot(*entry["shift_m"]))
    assert [entry["covariance"] is None for entry in listing["rooms"]][:3] == [True, False, True]
    c, s = np.cos(POSE.yaw), np.sin(POSE.yaw)
    turned = np.array([[c, -s], [s, c]]) @ np.diag([0.04, 0.01]) @ np.array([[c, s], [-s, c]])
    assert np.allclose(np.array(listing["rooms"][1]["covariance"])[:2, :2], turned)


def test_a_room_without_a_floor_moves_with_its_middle() -> None:
    b = building(2, 1)
    bare = replace(b, navigable_room=np.where(b.navigable_room == 1, -1, b.navigable_room))
    moves = fit_room_moves(bare, deformation(np.tile([0.3, -0.2, 0.0, 0.0], (5, 1))))
    assert np.allclose(moves.shift, [0.3, -0.2]) and np.allclose(moves.turn, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    "damaged",
    [
        lambda e: 5,
        lambda e: [7],
        lambda e: [{**e, "map": -1}],
        lambda e: [{**e, "map": "1"}],
        lambda e: [{**e, "source": None}],
        lambda e: [{**e, "transform": [[1]]}],
        lambda e: [{**e, "transform": (2 * np.eye(4)[::-1]).tolist()}],
        lambda e: [{**e, "transform": [[float("nan")] * 4] * 4}],
        lambda e: [{**e, "deformation": {}}],
        lambda e: [{k: v for k, v in e.items() if k != "transform"}],
    ],
)
def test_damaged_bending_is_told_in_one_line(tmp_path, damaged) -> None:
    joined = merged(deformation(MOVES, storeys=2)).map
    (entry,) = joined.parameters[BEND_PARAMETER]
    odd = replace(joined, parameters={BEND_PARAMETER: damaged(entry)})
    with pytest.raises(InputError, match="damaged bending") as caught:
        read_bends(odd)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300
    assert "Parameters" in render_report_html(odd)


def test_the_report_of_a_joined_map_does_not_list_all_pieces() -> None:
    assert "of 1 of its maps" in render_report_html(merged(deformation(MOVES, storeys=2)).map)


def test_a_placement_without_bending_is_its_pose() -> None:
    rigid = Placement(POSE)
    assert np.allclose(rigid.invert_points(rigid.transform_points(points())), points(), atol=1e-6)
