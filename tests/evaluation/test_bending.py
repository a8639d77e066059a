"""How drift and bending are measured: against maps whose bending is written down."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from topomerge.datasets.buildings.procedural import make_building

from topomerge.types import Sim3


@pytest.fixture
def measures():
    return importlib.import_module("topomerge.evaluation.bending")


def two_rooms(shift):
    """A pair in frames of their own, of two rooms of 4 m; in map b the second one has drifted by `shift`."""
    pairs = importlib.import_module("topomerge.datasets.pairs.drifted_pairs")
    frames = Sim3(0.4, (3.0, -1.0, 0.5)), Sim3(-2.0, (-8.0, 4.0, -0.3))
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0.25, 8, 0.5), np.arange(0.25, 4, 0.5), indexing="ij"))
    true = np.column_stack([x, y, np.zeros(len(x))])
    room = np.where(x < 4, 0, 1).astype(np.int32)
    moved = frames[1].apply(true)
    off = np.where(room[:, None] == 1, np.array([*shift, 0.0]), 0.0)
    undrift = pairs.DriftCorrection(frames[0].apply(true), 0 * true, room), pairs.DriftCorrection(moved + off, -off, room)
    return pairs.DriftedPair(None, undrift, frames, np.array([0, 1]), 1.0)


class Moved:
    """What undoes the drift exactly."""

    def __init__(self, undrift) -> None:
        self.undrift = undrift

    def apply(self, points):
        return self.undrift.correct(points)


def test_a_room_that_drifted_is_off_by_its_drift_and_put_right_by_what_undoes_it(measures) -> None:
    bent = two_rooms((0.3, -0.4))
    truth = bent.frames[0] @ bent.frames[1].inverse()
    rigid = measures.measure_room_errors(bent, truth)
    assert [r["room"] for r in rigid] == [0, 1]
    assert [r["shift"] for r in rigid] == pytest.approx([0.0, 0.5], abs=1e-9)
    assert [r["turn"] for r in rigid] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert not measures.within(rigid) and measures.within(rigid[:1])
    undone = measures.measure_room_errors(bent, truth, (None, Moved(bent.undrift[1])))
    assert max(r["shift"] for r in undone) < 1e-9


def test_a_pose_that_is_turned_turns_every_room(measures) -> None:
    bent = two_rooms((0.0, 0.0))
    truth = bent.frames[0] @ bent.frames[1].inverse()
    turned = Sim3(np.radians(2.0)) @ truth
    assert [r["turn"] for r in measures.measure_room_errors(bent, turned)] == pytest.approx([2.0, 2.0], abs=1e-6)


@pytest.mark.longer
def test_drift_of_a_scan_is_undone_and_grows_with_the_factor() -> None:
    pairs = importlib.import_module("topomerge.datasets.pairs.drifted_pairs")
    building = make_building("apartment", 900_003, 1)
    rooms = [i for i, r in enumerate(building.rooms) if r.kind != "lift"][:4]
    sizes = []
    for factor in (0.0, 4.0):
        frame = Sim3(1.0, (2.0, 3.0, 0.0))
        cloud, undrift = pairs.simulate_drifted_scan(building, "depth", factor, rooms, [1, 0], frame, 20_000)
        sizes.append(np.hypot(*undrift.shifts[:, :2].T).mean())
        corners = np.concatenate([r.polygon for r in building.rooms])
        inside = frame.inverse().apply(undrift.places + undrift.shifts)[undrift.rooms >= 0, :2]
        assert (inside > corners.min(axis=0) - 0.4).all() and (inside < corners.max(axis=0) + 0.4).all()
        assert np.isin(undrift.rooms[undrift.rooms >= 0], np.arange(len(building.rooms))).all() and len(cloud) > 1000
    assert sizes[0] < 0.03 < sizes[1]


def test_the_interval_of_a_statistic_is_over_buildings(measures) -> None:
    values = np.repeat(np.arange(10.0), 50)
    text = measures.format_with_interval(lambda k: float(values[k].mean()), [f"b{v:.0f}" for v in values], 1)
    mean, low, high = (float(v) for v in text.replace("[", "").replace("]", "").replace(",", "").split())
    assert mean == 4.5 and 2.3 < low < 3.4 and 5.6 < high < 6.7
    assert measures.format_with_interval(lambda k: float(len(k)), ["one", "two"], 0) == "2"
