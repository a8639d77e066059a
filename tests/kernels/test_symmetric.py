"""Small symmetric matrices against LAPACK."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.kernels.symmetric import axes, solved


@pytest.mark.parametrize("count", [1, 3, 4])
def test_systems_are_solved_in_the_unknowns_that_count(count):
    rng = np.random.default_rng(count)
    for _ in range(50):
        m = rng.normal(size=(6, 4)) * 10.0 ** rng.integers(-3, 4, 4)
        h, g = m.T @ m + 1e-6 * np.eye(4), rng.normal(size=4)
        x = solved(np.triu(h), g, count)  # the lower half is not read
        assert not x[count:].any()
        assert h[:count, :count] @ x[:count] == pytest.approx(g[:count], abs=1e-7)


def matrices():
    rng = np.random.default_rng(0)
    for rank in (0, 1, 2, 3):
        for size in (1e-9, 1.0, 1e6):
            m = rng.normal(size=(3, rank))
            yield size * (m @ m.T)
    yield np.diag([2.0, 2.0, 1.0])
    yield np.eye(3)
    yield np.array([[1.0, 1e-18, 0.0], [1e-18, 1.0, 1e-9], [0.0, 1e-9, 1.0]])


@pytest.mark.parametrize("square", list(matrices()))
def test_axes_are_those_of_lapack(square):
    values, vectors = axes(square)
    size = max(np.abs(square).max(), 1e-300)
    assert values / size == pytest.approx(np.linalg.eigvalsh(square) / size, abs=1e-13)
    assert vectors.T @ vectors == pytest.approx(np.eye(3), abs=1e-13)
    assert square @ vectors / size == pytest.approx(vectors * values / size, abs=1e-13)
