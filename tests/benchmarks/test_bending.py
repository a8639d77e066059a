"""How drift and bending are measured: against maps whose bending is written down."""

from __future__ import annotations

import importlib

import numpy as np
import pytest


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
