"""Simulated radio: the law of loss, walls on the way, what phones miss, and that it is off unless asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.simulation.radio import (
    AT_ONE_METRE,
    HELD,
    HUNG,
    AccessPoints,
    RadioPlan,
    RadioSettings,
    build_radio_plans,
    place_access_points,
    simulate_readings,
)

from topomerge.errors import InputError

CLEAR = RadioSettings(density=1, shadow=0, noise=0, gain=0, missed=0, moved=0, sensitivity=-120)


def room(walls: tuple[float, ...] = (), level: int = 0) -> RadioPlan:
    """A hall of 40 m by 10 m with thin walls across."""
    wall = np.zeros((100, 400), bool)
    for x in walls:
        wall[:, int(x * 10) : int(x * 10) + 2] = True
    x, y = np.meshgrid(np.arange(0.5, 40), np.arange(0.5, 10))
    return RadioPlan(wall, np.column_stack([x.ravel(), y.ravel()]), np.zeros(2), 3.5 * level, level)


def point(x: float, level: int = 0) -> AccessPoints:
    return AccessPoints(np.array([[x, 5.0, 3.5 * level + HUNG]]), np.array([level]), 1)


def test_strength_falls_by_the_law():
    track = np.array([[6.0, 5.0], [15.0, 5.0], [35.0, 5.0]])
    heard = simulate_readings([room()], point(5.0), track, 0, CLEAR, 0).table["number"]
    distance = np.hypot(track[:, 0] - 5, HUNG - HELD)
    assert heard == pytest.approx(AT_ONE_METRE - 28 * np.log10(distance), abs=0.51)  # rounded to 1 dBm
    walled = simulate_readings([room((10, 20, 30))], point(5.0), track, 0, CLEAR, 0).table["number"]
    assert (heard - walled).tolist() == [0, 4, 12]
    above = simulate_readings([room(), room(level=1)], point(5.0, 1), track[2:], 0, CLEAR, 0).table["number"]
    assert above[0] == pytest.approx(AT_ONE_METRE - 28 * np.log10(np.hypot(30, 3.5 + HUNG - HELD)) - 16, abs=0.51)


def test_walls_are_counted_both_ways():
    plan, rng = room((10, 20, 30)), np.random.default_rng(0)
    a, b = rng.uniform((1, 1), (39, 9), (20, 2)), rng.uniform((1, 1), (39, 9), (15, 2))
    count = plan.count_walls(a, b)
    clear = [np.abs(p[:, None, 0] - np.array([10, 20, 30.0])).min(axis=1) > 0.5 for p in (a, b)]
    want = np.abs(np.digitize(a[:, 0], [10, 20, 30])[:, None] - np.digitize(b[:, 0], [10, 20, 30])[None])
    assert np.array_equal(count[clear[0]][:, clear[1]], want[clear[0]][:, clear[1]]) and want.max() == 3
    assert np.array_equal(count[clear[0]][:, clear[1]], plan.count_walls(b, a).T[clear[0]][:, clear[1]])


def test_phones_miss_readings_and_points_move():
    plans, track = [room()], room().free[::7]
    points = place_access_points(plans, replace(CLEAR, density=5), 1)
    whole = simulate_readings(plans, points, track, 0, CLEAR, 0)
    assert len(whole) == len(track) * len(points.level) == len(track) * 20
    half = simulate_readings(plans, points, track, 0, replace(CLEAR, missed=0.5), 0)
    assert 0.4 < len(half) / len(whole) < 0.6
    deaf = simulate_readings(plans, points, track, 0, replace(CLEAR, sensitivity=-60), 0)
    assert 0 < len(deaf) < len(whole)
    assert deaf.table["number"].min() >= -60
    moved = simulate_readings(plans, points, track, 0, replace(CLEAR, moved=1.0), 1)
    assert not np.array_equal(moved.table["number"], whole.table["number"])
    again = simulate_readings(plans, points, track, 0, CLEAR, 0)
    assert again.table.tobytes() == whole.table.tobytes()
    shadows = [simulate_readings(plans, points, track, 0, replace(CLEAR, shadow=6), s).table["number"] for s in (0, 1)]
    assert np.abs(shadows[0] - shadows[1]).max() <= 1  # the same at every visit
    assert 4 < (shadows[0] - whole.table["number"]).std() < 8


def test_each_storey_of_a_building_has_a_plan():
    plans = build_radio_plans(make_building("house", 3, 2))
    assert len(plans) == 2 and all(0.3 < plan.wall.mean() < 0.99 and len(plan.free) > 50 for plan in plans)


@pytest.mark.parametrize("wrong", [{"density": -1}, {"missed": 2}, {"wall": float("nan")}, {"sensitivity": 5}])
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(InputError, match=f"radio {next(iter(wrong))} must be"):
        RadioSettings(**wrong)
