"""The comparison with GTSAM: the factors that both get, and what it says without GTSAM."""

from __future__ import annotations

import importlib
import sys
from functools import cache

import numpy as np
import pytest

from benchmarks.peers import gtsam_solver
from topomerge.errors import InputError
from topomerge.registration.bend import alignment
from topomerge.registration.bend.graph import settle


@cache
def of_six_rooms():
    return gtsam_solver.build_problem(6)


@pytest.mark.longer
def test_both_get_the_factors_of_the_last_round_by_plan():
    before = alignment.settle
    anchors, joints, measured, prior = of_six_rooms()
    assert alignment.settle is before
    assert len(measured.piece) and measured.others.shape[1] == 1 and (measured.shares == 1).all()
    assert joints.pieces.max() < len(anchors) == len(prior)
    moved = np.linalg.norm(settle(anchors, joints, measured, prior).moves[:, :2], axis=1)
    assert 0.01 < moved.max() < 0.5  # waves of 0.15 m, shared by both maps


def test_a_motion_at_a_place_is_shift_there_and_turn():
    turn, place = 1e-4, np.array([3.0, -2.0])
    shifted = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ place - place
    assert np.allclose(gtsam_solver.compute_effect(place) @ (0.0, 0.0, turn), [*shifted, turn], atol=1e-7)


def test_without_gtsam_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(InputError, match="pip install gtsam"):
        gtsam_solver.main("3")


def test_gtsam_moves_the_pieces_to_where_ours_does():
    gtsam = pytest.importorskip("gtsam")
    given = of_six_rooms()
    ours = settle(*given).moves
    assert np.abs(gtsam_solver.solve_with_gtsam(gtsam, given)[:, :2] - ours[:, :2]).max() < 0.003


def test_a_storey_has_as_many_rooms_and_walls_as_asked_for() -> None:
    growth = importlib.import_module("benchmarks.peers.gtsam_solver")
    walls = [len(np.unique(np.floor(growth.storey(n)[0][:, :2] / 0.1), axis=0)) for n in (10, 20, 40)]
    assert 1.7 < walls[1] / walls[0] < 2.3 and 1.7 < walls[2] / walls[1] < 2.3
    points = growth.storey(10)[0]
    assert 0.05 < np.abs(growth.wave_points(points) - points).max() <= growth.BEND_SIZE
