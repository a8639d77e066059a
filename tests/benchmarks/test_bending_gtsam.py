"""The comparison with GTSAM: the factors that both get, and what it says without GTSAM."""

from __future__ import annotations

import sys
from functools import cache

import numpy as np
import pytest

from benchmarks.merging import bending_gtsam
from topomerge.errors import InputError
from topomerge.registration.bend import alignment
from topomerge.registration.bend.graph import settle


@cache
def of_six_rooms():
    return bending_gtsam.problem(6)


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
    assert np.allclose(bending_gtsam.about(place) @ (0.0, 0.0, turn), [*shifted, turn], atol=1e-7)


def test_without_gtsam_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(InputError, match="pip install gtsam"):
        bending_gtsam.main("3")


def test_gtsam_moves_the_pieces_to_where_ours_does():
    gtsam = pytest.importorskip("gtsam")
    given = of_six_rooms()
    ours = settle(*given).moves
    assert np.abs(bending_gtsam.gtsam_moves(gtsam, given)[:, :2] - ours[:, :2]).max() < 0.003
