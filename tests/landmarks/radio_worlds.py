"""A simulated floor of offices with access points, and maps of walks on it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from topomerge.datasets.real.wifi_malls import build_walk_map
from topomerge.datasets.simulation.radio import (
    HELD,
    RADIO_CELL,
    RadioPlan,
    RadioSettings,
    place_access_points,
    simulate_readings,
)

from topomerge.types import Array, Landmarks, Sim3, TopometricMap, build_landmarks, move_landmarks

SIZE = (70.0, 28.0)  # m
ROOM = 7.0  # m
SETTINGS = RadioSettings(density=1.5, moved=0.0)


def build_office(level: int = 0) -> RadioPlan:
    """Rooms of 7 m by 7 m on both sides of corridors."""
    wall = np.zeros((int(SIZE[1] / RADIO_CELL), int(SIZE[0] / RADIO_CELL)), bool)
    for at in np.arange(0, max(SIZE), ROOM):
        k = int(at / RADIO_CELL)
        wall[:, k : k + 2] = True
        wall[k : k + 2] = True
    x, y = np.meshgrid(np.arange(0.6, SIZE[0]), np.arange(0.6, SIZE[1]))
    return RadioPlan(wall, np.column_stack([x.ravel(), y.ravel()]), np.zeros(2), 3.5 * level, level)


PLANS = [build_office(0), build_office(1)]


def walk(low: float, high: float, seed: int = 0) -> Array:
    """(n, 2) places of a walk in a band along x."""
    x, y = np.meshgrid(np.arange(low, high, 2.5), np.arange(2.0, SIZE[1], 4.0))
    at = np.column_stack([x.ravel(), y.ravel()])
    return at + np.random.default_rng(seed).uniform(-0.8, 0.8, at.shape)


@cache
def _simulate(low: float, high: float, session: int, level: int, seed: int, settings: RadioSettings) -> Landmarks:
    points = place_access_points(PLANS, settings, seed)
    return simulate_readings(PLANS, points, walk(low, high, session), level, settings, session)


def hear(
    low: float = 2.0, high: float = 68.0, session: int = 0, level: int = 0, seed: int = 3, settings: RadioSettings = SETTINGS
) -> Landmarks:
    """What a phone hears on a walk; heights are those of its own storey."""
    heard = _simulate(low, high, session, level, seed, settings)
    heard = replace(heard, table=heard.table.copy())
    heard.table["position"][:, 2] = HELD
    return heard


def build(landmarks: Landmarks, frame: Sim3 | None = None) -> TopometricMap:
    """Build a map of readings, in a frame."""
    return build_walk_map(move_landmarks(landmarks, frame) if frame else landmarks)


def spoof(landmarks: Landmarks, address: str, number: float) -> Landmarks:
    """Readings of one more address in every scan."""
    from topomerge.types import join_landmarks

    table = landmarks.table[np.unique(landmarks.table["group"], return_index=True)[1]]
    more = build_landmarks("radio", [address] * len(table), "simulated", table["position"], number=number, group=table["group"])
    return join_landmarks([landmarks, more])
