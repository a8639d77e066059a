"""How far two poses are apart, in numbers by hand."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.matching.poses import pose_difference
from topomerge.types import Sim3


def test_metres_at_the_anchor_radians_and_the_logarithm_of_the_scale():
    p, q = Sim3(0.0, (1.0, 2.0, 2.0)), Sim3(np.pi / 2, (1.0, 2.0, 0.0), 2.0)
    assert pose_difference(p, q, np.zeros(3)) == pytest.approx((2.0, np.pi / 2, np.log(2)))
    at = np.array([3.0, 0.0, 1.0])  # p puts it at (4, 2, 3), q at (1, 8, 2)
    assert pose_difference(p, q, at)[0] == pytest.approx(np.sqrt(9 + 36 + 1))
    assert pose_difference(q, p, at) == pytest.approx(pose_difference(p, q, at))


def test_turns_across_half_a_turn_are_small():
    assert pose_difference(Sim3(3.1), Sim3(-3.1), np.zeros(3))[1] == pytest.approx(2 * np.pi - 6.2)
