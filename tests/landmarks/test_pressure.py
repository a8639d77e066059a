"""Air pressure tells storeys apart where sessions are near each other in time, and levels within a session."""

from __future__ import annotations

import numpy as np
import pytest
from topomerge.datasets.real.wifi_malls import build_walk_map

from topomerge.landmarks.evidence import FALL, score_pressure
from topomerge.landmarks.radio import MOST_RATIO
from topomerge.types import Landmarks, Sim3, TopometricMap, build_landmarks

FLAT = np.column_stack([np.arange(0, 60.0, 1), np.zeros(60), np.full(60, 1.2)])


def session(height: object = 0.0, start: float = 0.0, drift: float = 0.0, at: np.ndarray = FLAT, seed: int = 0) -> TopometricMap:
    """A session whose storey lies at a height, m, that its map does not know."""
    noise = np.random.default_rng(seed).normal(0, 0.02, len(at))
    number = 1000 - FALL * (at[:, 2] + height) + drift + noise
    return build_walk_map(build_landmarks("pressure", [""] * len(at), "x", at, number=number, time=start + np.arange(len(at))))


def test_storeys_are_told_apart_within_minutes():
    a = session()
    assert score_pressure(a, session(seed=1, start=60), Sim3())["storey"] < -1
    assert score_pressure(a, session(3.5, seed=1, start=60), Sim3())["storey"] > 1
    assert score_pressure(a, session(-3.5, seed=1, start=60), Sim3())["storey"] > 1


def test_hours_later_the_drift_hides_the_storey():
    for height in (0.0, 3.5):
        assert abs(score_pressure(session(), session(height, start=40_000, seed=1), Sim3())["storey"]) < 0.5
    unknown = session(3.5, start=np.nan, seed=1)
    assert score_pressure(session(), unknown, Sim3())["storey"] == 0


def test_levels_that_change_elsewhere_speak_against_a_pose():
    """Both walked up a flight half-way, on maps that are flat; shifted by 15 m, one is up where the other is not."""
    up = np.where(FLAT[:, 0] > 30, 3.5, 0.0)
    a, b = session(up), session(up, start=90_000, drift=1.3, seed=1)
    assert score_pressure(a, b, Sim3())["elsewhere"] < 0 < score_pressure(a, b, Sim3(0.0, (15.0, 0, 0)))["elsewhere"]


def test_a_pose_with_heights_is_judged_by_them():
    raised = FLAT + (0, 0, 3.5)
    a, b = session(), session(at=raised, start=10, seed=1)
    assert score_pressure(a, b, Sim3(0.0, (0.0, 0.0, -3.5)))["storey"] > 1  # it was above, and is laid on the lower storey
    assert all(v == 0 for v in score_pressure(a, b, Sim3()).values())  # storeys above each other meet nowhere


def test_hardly_anything_says_nothing():
    none, a = build_walk_map(Landmarks()), session()
    assert all(v == 0 for p in ((a, none), (none, a)) for v in score_pressure(*p, Sim3()).values())
    wrong = session()
    wrong.landmarks.table["number"] = [np.nan, np.inf, -5, 1e9] * 15
    assert all(v == 0 for v in score_pressure(a, wrong, Sim3()).values())
    assert all(abs(v) <= MOST_RATIO for v in score_pressure(a, session(80.0, start=1), Sim3()).values())
    pose = Sim3(1.0, (5.0, 6.0, 0.0))
    other = session(3.5, seed=1, start=60)
    assert score_pressure(a, other, Sim3())["storey"] == pytest.approx(
        score_pressure(other, a, Sim3())["storey"], abs=0.3
    ) and all(np.isfinite(v) for v in score_pressure(a, other, pose).values())
