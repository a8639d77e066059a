"""The measure of a merge in rooms against distances worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes_map import building
from topomerge.evaluation.score import collect_room_floors, measure_displacements
from topomerge.types import Sim3

SQUARE = np.array([(x, y, 0.0) for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
TRUTH = Sim3(0.7, (3.0, -2.0, 0.5))


def after(error: Sim3) -> Sim3:
    """A pose that is wrong by a transform in the frame of a, about the place where b's origin lies there."""
    back = Sim3(0.0, (-3.0, 2.0, -0.5))
    return back.inverse() @ error @ back @ TRUTH


def test_a_shift_moves_every_room_alike() -> None:
    shift = Sim3(TRUTH.yaw, (3.3, -1.6, 0.5))
    assert measure_displacements(shift, TRUTH, [SQUARE, SQUARE + 50]) == pytest.approx([0.5, 0.5])
    assert measure_displacements(TRUTH, TRUTH, [SQUARE]) == pytest.approx([0.0], abs=1e-12)


@pytest.mark.parametrize("degrees", [0.5, 30.0, 180.0])
def test_a_turn_moves_the_farthest_corner_most(degrees: float) -> None:
    turn = after(Sim3(np.radians(degrees), (0.0, 0.0, 0.0)))
    chord = 2 * np.sin(np.radians(degrees) / 2)
    expected = [np.sqrt(2) * chord, np.hypot(11, 1) * chord]
    assert measure_displacements(turn, TRUTH, [SQUARE, SQUARE + [10, 0, 0]]) == pytest.approx(expected)


def test_a_scale_moves_what_is_far() -> None:
    grown = after(Sim3(0.0, (0.0, 0.0, 0.0), 1.01))
    assert measure_displacements(grown, TRUTH, [SQUARE + [9.0, -1.0, 0.0]]) == pytest.approx([0.01 * np.hypot(10, 2)])


def test_the_outline_is_enough() -> None:
    """No point within a room is farther off than the worst of its outline."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = Sim3(rng.uniform(-3, 3), tuple(rng.uniform(-5, 5, 3)), rng.uniform(0.8, 1.2))
        inside = rng.uniform(-1, 1, (50, 3)) * [1, 1, 0]
        whole, outline = measure_displacements(pose, TRUTH, [np.concatenate([SQUARE, inside]), SQUARE])
        assert whole == pytest.approx(outline)


def test_heights_count_only_where_both_maps_have_them() -> None:
    raised = Sim3(TRUTH.yaw, (3.0, -2.0, 0.9))
    assert measure_displacements(raised, TRUTH, [SQUARE]) == pytest.approx([0.4])
    assert measure_displacements(raised, TRUTH, [SQUARE], flat=True) == pytest.approx([0.0], abs=1e-12)
    assert np.isinf(measure_displacements(TRUTH, TRUTH, [np.zeros((0, 3))])).all()


def test_the_floor_of_a_room_is_that_of_all_its_pieces() -> None:
    map = building()
    each = [np.flatnonzero(map.navigable_room == j) for j in range(len(map.rooms))]
    whole = collect_room_floors(map, [[(0, 0), (4, 1)], [(1, 1)]])
    assert [len(points) for points in whole] == [len(each[0]) + len(each[1]), len(each[1])]
    assert (whole[1] == map.navigable.compute_centroids()[each[1]]).all()
