"""Pieces settle where measurements and joints balance; wrong measurements are voted out."""

from __future__ import annotations

import numpy as np

from topomerge.registration.bend.graph import Joints, Measurements, settle
from topomerge.types.placement import Deformation

COUNT, SPACING = 12, 4.0


def corridor() -> np.ndarray:
    return np.column_stack([SPACING * np.arange(COUNT), np.zeros(COUNT)])


def joints(shift: float = 0.1, turn: float = 0.02) -> Joints:
    ends = np.column_stack([np.arange(COUNT - 1), np.arange(1, COUNT)])
    return Joints(ends, np.tile([shift, shift, turn, 1e-4], (COUNT - 1, 1)))


def measured(moves: np.ndarray, sigma: float = 1e-4) -> Measurements:
    nobody = np.zeros((COUNT, 0))
    information = np.tile(np.eye(3) / sigma**2, (COUNT, 1, 1))
    return Measurements(np.arange(COUNT), corridor(), nobody.astype(np.int64), nobody, moves, information)


def arc(radius: float = 2000.0) -> np.ndarray:
    """(n, 3) moves that straighten a corridor bent to an arc."""
    x = corridor()[:, 0]
    return np.column_stack([np.zeros(COUNT), -(x**2) / (2 * radius), -x / radius])


PRIOR = np.tile([1.0, 1.0, 0.1, 0.0], (COUNT, 1))


def test_a_bent_corridor_is_straightened_to_a_millimetre():
    """Without noise, cells included: the blended moves of the pieces leave nothing of an arc of half a metre over 44 m."""
    settled = settle(corridor(), joints(), measured(arc()), PRIOR)
    assert np.abs(settled.moves[:, :3] - arc()).max() < 1e-3
    nan = np.full((COUNT, 3, 3), np.nan)
    bend = Deformation(corridor(), np.zeros(COUNT, int), np.zeros(1), settled.moves, nan, np.full(COUNT, -1, np.int32), 1.5)
    x = np.linspace(4, 40, 500)
    wall = np.column_stack([x, x**2 / 4000, np.ones(500)])
    assert np.abs(bend.apply(wall)[:, 1]).max() < 0.0015  # between the pieces an arc is chords: 4 m have a rise of 1 mm


def test_without_measurements_nothing_moves():
    none = Measurements(
        np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 1), int), np.zeros((0, 1)), np.zeros((0, 3)), np.zeros((0, 3, 3))
    )
    settled = settle(corridor(), joints(), none, PRIOR)
    assert np.abs(settled.moves).max() < 1e-9
    assert settled.expected_strain[:, :3].mean() > 0.8  # of one: joints are as uncertain as before


def test_a_wrong_piece_is_voted_out():
    moves = arc()
    moves[5] += (0.0, 1.5, 0.0)
    settled = settle(corridor(), joints(), measured(moves, 0.02), PRIOR)
    assert settled.weights[5] < 0.05 and np.delete(settled.weights, 5).min() > 0.5
    assert np.abs(settled.moves[:, :2] - arc()[:, :2]).max() < 0.05


def test_a_corridor_slides_where_nothing_holds_it():
    """Pieces held across only: along the corridor those that are held at the ends say where the others are."""
    aim = np.tile([0.5, 0.2, 0.0], (COUNT, 1))
    m = measured(aim, 0.01)
    m.information[1:-1, 0, :] = 0.0
    m.information[1:-1, :, 0] = 0.0
    settled = settle(corridor(), joints(), m, PRIOR)
    assert np.abs(settled.moves[:, :2] - (0.5, 0.2)).max() < 0.08  # the prior draws what is not held a little back
    assert settled.covariance[6, 0, 0] > 5 * settled.covariance[6, 1, 1]


def test_what_may_not_move_stays():
    prior = PRIOR.copy()
    prior[3] = 0.0
    settled = settle(corridor(), joints(), measured(arc(), 0.02), prior)
    assert not settled.moves[3].any() and np.abs(settled.moves[8]).max() > 0.01


def test_pieces_against_pieces_share_the_move():
    """Two chains, one measured against the other by 0.4 m: alike ones give way by 0.2 m each, a stiff one less."""
    anchors = np.concatenate([corridor(), corridor()])
    ends = joints().pieces
    both = Joints(np.concatenate([ends, ends + COUNT]), np.concatenate([joints().sigma] * 2))
    m = measured(np.tile([0.4, 0.0, 0.0], (COUNT, 1)), 0.005)
    against = Measurements(m.piece + COUNT, m.places, np.arange(COUNT)[:, None], np.ones((COUNT, 1)), m.moves, m.information)
    settled = settle(anchors, both, against, np.concatenate([PRIOR, PRIOR]))
    assert np.allclose(settled.moves[:COUNT, 0], -0.2, atol=0.01) and np.allclose(settled.moves[COUNT:, 0], 0.2, atol=0.01)


def test_growth_is_sparse():
    """A thousand pieces settle with a few million numbers, not with a billion."""
    many = 1000
    side = np.column_stack([a.ravel() for a in np.meshgrid(np.arange(40), np.arange(25), indexing="ij")]) * 5.0
    right = [(k, k + 25) for k in range(many - 25)] + [(k, k + 1) for k in range(many) if k % 25 < 24]
    pieces = np.array(right)
    rng = np.random.default_rng(0)
    nobody = np.zeros((many, 0))
    aims = np.column_stack([rng.normal(0, 0.02, (many, 2)), np.zeros(many)])
    m = Measurements(np.arange(many), side, nobody.astype(int), nobody, aims, np.tile(np.eye(3) * 1e3, (many, 1, 1)))
    settled = settle(side, Joints(pieces, np.tile([0.1, 0.1, 0.02, 1e-4], (len(pieces), 1))), m, np.tile(PRIOR[:1], (many, 1)))
    assert settled.moves.shape == (many, 4) and np.abs(settled.moves[:, :2]).max() < 0.08
