"""Bending by pieces: exact where all pieces move alike, continuous between them, undone, never folding."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.errors import InputError
from topomerge.types.placement import Deformation


def deformation(moves: np.ndarray, spacing: float = 5.0, storeys: int = 1) -> Deformation:
    """Pieces in a row, `spacing` m apart, on each storey."""
    n = len(moves) // storeys
    anchors = np.tile(np.column_stack([spacing * np.arange(n), np.zeros(n)]), (storeys, 1))
    floors = 3.0 * np.arange(storeys)
    nan = np.full((len(moves), 3, 3), np.nan)
    return Deformation(anchors, np.repeat(np.arange(storeys), n), floors, moves, nan, np.arange(len(moves), dtype=np.int32), 3.0)


def points(n: int = 400, seed: int = 0, high: float = 2.5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform((-4, -4, 0), (24, 4, high), (n, 3))


def test_pieces_that_move_alike_move_the_map_rigidly() -> None:
    moves = np.tile([0.3, -0.2, 0.0, 0.0], (5, 1))
    p = points()
    assert np.allclose(deformation(moves).apply(p) - p, [0.3, -0.2, 0.0])


def test_one_turning_piece_turns_about_its_anchor() -> None:
    turn = np.radians(2.0)
    bent = deformation(np.array([[0.0, 0.0, turn, 0.0]])).apply(np.array([[3.0, 0.0, 1.0]]))
    assert np.allclose(bent, [[3 * np.cos(turn), 3 * np.sin(turn), 1.0]], atol=1e-9)


def test_a_piece_that_grows_grows_about_its_anchor() -> None:
    bent = deformation(np.array([[0.0, 0.0, 0.0, np.log(1.02)]])).apply(np.array([[3.0, 1.0, 0.0]]))
    assert np.allclose(bent, [[3.06, 1.02, 0.0]], atol=1e-9)


def test_bending_is_undone() -> None:
    rng = np.random.default_rng(1)
    bent = deformation(rng.normal(0, (0.15, 0.15, 0.01, 0.005), (10, 4)), storeys=2)
    p = points(high=5.5)
    assert np.allclose(bent.undo(bent.apply(p)), p, atol=1e-7)


def test_walls_are_not_torn() -> None:
    rng = np.random.default_rng(2)
    bent = deformation(rng.normal(0, (0.2, 0.2, 0.02, 0.0), (5, 4)))
    wall = np.column_stack([np.linspace(-4, 24, 28_001), np.full(28_001, 1.3), np.ones(28_001)])
    steps = np.linalg.norm(np.diff(bent.apply(wall), axis=0), axis=1)
    assert steps.min() > 0.0008 and steps.max() < 0.0012  # 1 mm before: neither gaps nor heaps


def test_growth_is_that_of_small_squares() -> None:
    rng = np.random.default_rng(3)
    bent = deformation(rng.normal(0, (0.3, 0.3, 0.02, 0.01), (5, 4)))
    p, h = points(2000), 1e-6
    dx = (bent.apply(p + [h, 0, 0]) - bent.apply(p))[:, :2] / h
    dy = (bent.apply(p + [0, h, 0]) - bent.apply(p))[:, :2] / h
    areas = dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0]
    assert areas.min() >= bent.least_growth - 1e-4
    assert bent.least_growth > 0


def test_a_fold_is_seen() -> None:
    crossed = deformation(np.array([[6.0, 0, 0, 0], [-6.0, 0, 0, 0]]))
    assert crossed.least_growth < 0


def test_storeys_bend_by_themselves_and_pipes_hold() -> None:
    moves = np.zeros((4, 4))
    moves[2:, 0] = 0.4  # the upper storey
    bent = deformation(moves, storeys=2)
    pipe = np.column_stack([np.full(600, 2.0), np.zeros(600), np.linspace(0, 6, 600)])
    x = bent.apply(pipe)[:, 0] - 2.0
    assert np.allclose(x[pipe[:, 2] < 2.69], 0.0) and np.allclose(x[pipe[:, 2] >= 3.0], 0.4)
    assert np.abs(np.diff(x)).max() < 0.02


def test_written_and_read_again() -> None:
    rng = np.random.default_rng(4)
    bent = deformation(rng.normal(0, (0.2, 0.2, 0.02, 0.0), (6, 4)), storeys=2)
    again = Deformation.from_json(bent.to_json())
    assert np.array_equal(again.apply(points()), bent.apply(points()))
    assert np.isnan(again.covariance).all()


@pytest.mark.parametrize(
    "damage",
    [
        lambda j: j.pop("pieces"),
        lambda j: j["pieces"][0].update(shift_m=[float("nan"), 0.0]),
        lambda j: j["pieces"][0].update(storey=7),
        lambda j: j["pieces"][0].update(shift_m=[99.0, 0.0]),
        lambda j: j.update(reach_m=0.0),
        lambda j: j["pieces"][0].update(anchor="north"),
        lambda j: j["pieces"][0].update(anchor=[1e12, 0.0]),
    ],
)
def test_damaged_bendings_are_refused(damage) -> None:  # type: ignore[no-untyped-def]
    values = deformation(np.zeros((3, 4))).to_json()
    damage(values)
    with pytest.raises(InputError, match="damaged bending"):
        Deformation.from_json(values)


def test_nothing_to_bend() -> None:
    none = deformation(np.zeros((0, 4)))
    p = points(10)
    assert np.array_equal(none.apply(p), p) and none.least_growth == 1.0
