"""Small symmetric systems have the solutions that they should."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from topomerge.kernels import registration


@njit
def solved(h, g, count):
    """As kernels call it: numba fails where one from its cache is called from Python after another one that contains it."""
    return registration.solve_cholesky(h, g, count)


@pytest.mark.parametrize("count", [1, 3, 4])
def test_systems_are_solved_in_the_unknowns_that_count(count):
    rng = np.random.default_rng(count)
    for _ in range(50):
        m = rng.normal(size=(6, 4)) * 10.0 ** rng.integers(-3, 4, 4)
        h, g = m.T @ m + 1e-6 * np.eye(4), rng.normal(size=4)
        x = solved(np.triu(h), g, count)  # the lower half is not read
        assert not x[count:].any()
        assert h[:count, :count] @ x[:count] == pytest.approx(g[:count], abs=1e-7)
