"""Similarities: inverse, composition, and what is none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.grids import COMPILED
from topomerge.types import Sim3

LENGTH = st.floats(-50, 50)
SIMS = st.builds(Sim3, st.floats(-10, 10), st.tuples(LENGTH, LENGTH, LENGTH), st.floats(0.2, 5))
TRIED_POINTS = np.random.default_rng(0).uniform(-20, 20, (40, 3))


@COMPILED
@given(SIMS)
def test_sim3_inverse(sim):
    assert np.allclose(sim.inverse().apply(sim.apply(TRIED_POINTS)), TRIED_POINTS, atol=1e-8)
    assert np.allclose((sim @ sim.inverse()).matrix, np.eye(4), atol=1e-8)
    assert np.allclose(sim.inverse().matrix, np.linalg.inv(sim.matrix), atol=1e-7)


@COMPILED
@given(SIMS, SIMS, SIMS)
def test_sim3_composition(a, b, c):
    assert np.allclose((a @ b).apply(TRIED_POINTS), a.apply(b.apply(TRIED_POINTS)), atol=1e-7)
    assert np.allclose((a @ b).matrix, a.matrix @ b.matrix, atol=1e-7)
    assert np.allclose(((a @ b) @ c).matrix, (a @ (b @ c)).matrix, atol=1e-6)
    assert -np.pi <= (a @ b).yaw < np.pi


def test_sim3_keeps_gravity_and_refuses():
    turned = Sim3(np.pi / 2, (1.0, 2.0, 3.0), 2.0)
    assert np.allclose(turned.apply([[1, 0, 0], [0, 0, 1]]), [[1, 4, 3], [1, 2, 5]])
    assert Sim3().matrix.tolist() == np.eye(4).tolist()
    for wrong in ({"scale": 0.0}, {"scale": -1.0}, {"yaw": np.nan}, {"translation": (0.0, np.inf, 0.0)}):
        with pytest.raises(ValueError, match="similarity"):
            Sim3(**wrong)
