"""How drift and bending are measured: against maps whose bending is written down."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from topomerge.datasets.buildings.procedural import make_building

from topomerge.types import Sim3


@pytest.fixture
def drift():
    return importlib.import_module("benchmarks.merging.drift")


def turned(points, angle, about, shift):
    """The shifts of points by a turn about a place, and a shift."""
    c, s = np.cos(angle), np.sin(angle)
    rel = points - about
    return rel @ np.array([[c, s], [-s, c]]) - rel + shift


def test_a_map_that_is_moved_as_a_whole_is_not_bent(drift) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 12, (600, 2))
    owner = np.floor(points[:, 0] / 3).astype(int)
    middles, moves = drift.rigid_moves(points, turned(points, 0.3, np.array([50.0, -7.0]), [3.0, 1.0]), owner)
    assert moves[:, 2] == pytest.approx(np.full(4, 0.3))
    pairs = drift.relative(middles, moves)
    assert len(pairs.distance) == 6
    assert np.abs(pairs.shift).max() < 1e-12 and np.abs(pairs.turn).max() < 1e-12


def test_a_hinge_turns_and_does_not_shift_and_a_slip_shifts(drift) -> None:
    middles = np.array([[0.0, 0.0], [4.0, 0.0]])
    hinge = np.array([2.0, 0.0])  # the second piece is turned about the middle between both
    moves = np.array([[0.0, 0.0, 0.0], [*turned(middles[1:], 0.1, hinge, [0.0, 0.0])[0], 0.1]])
    pairs = drift.relative(middles, moves)
    assert pairs.turn == pytest.approx([0.1]) and np.abs(pairs.shift).max() < 1e-12
    pairs = drift.relative(middles, np.array([[0.0, 0.0, 0.0], [0.0, 0.05, 0.0]]))
    assert pairs.shift == pytest.approx(np.array([[0.0, 0.05]])) and pairs.turn == pytest.approx([0.0])


def test_stiffness_of_a_walk_that_goes_astray_at_random(drift) -> None:
    rng = np.random.default_rng(1)
    maps = []
    for _ in range(200):
        place = np.arange(0.0, 30.0, 3.0)
        sides = np.cumsum(rng.normal(0, 0.02 * np.sqrt(3.0), (len(place), 2)), axis=0)
        turns = np.cumsum(rng.normal(0, 0.01 * np.sqrt(3.0), len(place)))
        i, j = np.triu_indices(len(place), 1)
        maps.append(drift.Relative(place[j] - place[i], sides[j] - sides[i], turns[j] - turns[i]))
    fit = drift.stiffness(drift.classes(maps))
    assert fit == pytest.approx({"shift": 0.02, "turn": 0.01}, rel=0.1)


def test_few_points_make_no_piece(drift) -> None:
    points = np.random.default_rng(0).uniform(0, 1, (drift.FEWEST_PLACES + 3, 2))
    owner = np.repeat([0, 1], [drift.FEWEST_PLACES, 3])
    assert len(drift.rigid_moves(points, 0 * points, owner)[0]) == 1


@pytest.fixture
def measures():
    return importlib.import_module("benchmarks.merging.bending_measures")


def two_rooms(shift):
    """A pair in frames of their own, of two rooms of 4 m; in map b the second one has drifted by `shift`."""
    pairs = importlib.import_module("topomerge.datasets.pairs.bent_pairs")
    frames = Sim3(0.4, (3.0, -1.0, 0.5)), Sim3(-2.0, (-8.0, 4.0, -0.3))
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0.25, 8, 0.5), np.arange(0.25, 4, 0.5), indexing="ij"))
    true = np.column_stack([x, y, np.zeros(len(x))])
    room = np.where(x < 4, 0, 1).astype(np.int32)
    moved = frames[1].apply(true)
    off = np.where(room[:, None] == 1, np.array([*shift, 0.0]), 0.0)
    undrift = pairs.Undrift(frames[0].apply(true), 0 * true, room), pairs.Undrift(moved + off, -off, room)
    return pairs.BentPair(None, undrift, frames, np.array([0, 1]), 1.0)


class Moved:
    """What undoes the drift exactly."""

    def __init__(self, undrift) -> None:
        self.undrift = undrift

    def apply(self, points):
        return self.undrift.at(points)


def test_a_room_that_drifted_is_off_by_its_drift_and_put_right_by_what_undoes_it(measures) -> None:
    bent = two_rooms((0.3, -0.4))
    truth = bent.frames[0] @ bent.frames[1].inverse()
    rigid = measures.room_errors(bent, truth)
    assert [r["room"] for r in rigid] == [0, 1]
    assert [r["shift"] for r in rigid] == pytest.approx([0.0, 0.5], abs=1e-9)
    assert [r["turn"] for r in rigid] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert not measures.within(rigid) and measures.within(rigid[:1])
    undone = measures.room_errors(bent, truth, (None, Moved(bent.undrift[1])))
    assert max(r["shift"] for r in undone) < 1e-9


def test_a_pose_that_is_turned_turns_every_room(measures) -> None:
    bent = two_rooms((0.0, 0.0))
    truth = bent.frames[0] @ bent.frames[1].inverse()
    turned = Sim3(np.radians(2.0)) @ truth
    assert [r["turn"] for r in measures.room_errors(bent, turned)] == pytest.approx([2.0, 2.0], abs=1e-6)


def test_how_well_scores_tell_right_from_wrong(measures) -> None:
    assert measures.area_under_curve([3, 4], [1, 2]) == 1
    assert measures.area_under_curve([1, 1], [1, 1]) == 0.5
    assert measures.area_under_curve([2.0], [1.0, 3.0]) == 0.5
    wrong = list(range(100))
    assert measures.recall_at([98.5, 50.0], wrong, 0.01) == 0.5
    assert measures.recall_at([98.5, 50.0], wrong, 0.0) == 0.0
    assert measures.recall_at([98.5, 50.0], wrong, 0.5) == 1.0


def test_few_walls_say_little(measures) -> None:
    few, many = ({"walls": w, "conflict": w, "conflict_share": 0.5} for w in (0.1, 100.0))
    assert measures.conflict(few) == pytest.approx(0.15 + 0.35 * 0.2 / 1.2)
    assert measures.conflict(many) == pytest.approx(0.5, abs=0.01)


def test_a_storey_has_as_many_rooms_and_walls_as_asked_for() -> None:
    growth = importlib.import_module("benchmarks.merging.bending_growth")
    walls = [len(np.unique(np.floor(growth.storey(n)[0][:, :2] / 0.1), axis=0)) for n in (10, 20, 40)]
    assert 1.7 < walls[1] / walls[0] < 2.3 and 1.7 < walls[2] / walls[1] < 2.3
    points = growth.storey(10)[0]
    assert 0.05 < np.abs(growth.waved(points) - points).max() <= growth.BEND_SIZE


@pytest.mark.longer
def test_drift_of_a_scan_is_undone_and_grows_with_the_factor() -> None:
    pairs = importlib.import_module("topomerge.datasets.pairs.bent_pairs")
    building = make_building("apartment", 900_003, 1)
    rooms = [i for i, r in enumerate(building.rooms) if r.kind != "lift"][:4]
    sizes = []
    for factor in (0.0, 4.0):
        frame = Sim3(1.0, (2.0, 3.0, 0.0))
        cloud, undrift = pairs.drifted_scan(building, "depth", factor, rooms, [1, 0], frame, 20_000)
        sizes.append(np.hypot(*undrift.shifts[:, :2].T).mean())
        corners = np.concatenate([r.polygon for r in building.rooms])
        inside = frame.inverse().apply(undrift.places + undrift.shifts)[undrift.rooms >= 0, :2]
        assert (inside > corners.min(axis=0) - 0.4).all() and (inside < corners.max(axis=0) + 0.4).all()
        assert np.isin(undrift.rooms[undrift.rooms >= 0], np.arange(len(building.rooms))).all() and len(cloud) > 1000
    assert sizes[0] < 0.03 < sizes[1]


def test_the_interval_of_a_statistic_is_over_buildings(measures) -> None:
    values = np.repeat(np.arange(10.0), 50)
    text = measures.with_interval(lambda k: float(values[k].mean()), [f"b{v:.0f}" for v in values], 1)
    mean, low, high = (float(v) for v in text.replace("[", "").replace("]", "").replace(",", "").split())
    assert mean == 4.5 and 2.3 < low < 3.4 and 5.6 < high < 6.7
    assert measures.with_interval(lambda k: float(len(k)), ["one", "two"], 0) == "2"
