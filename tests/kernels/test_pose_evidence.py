"""Evidence for poses, counted by the kernel and by plain Python.

Small symmetric systems have the solutions that they should.
"""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from topomerge.kernels import registration
from topomerge.kernels.registration import measure_pose_evidence


def test_kernel_is_its_slow_twin():
    rng = np.random.default_rng(2)
    distance, floor = rng.uniform(0, 1, (1, 9, 8)).astype(np.float32), rng.random((1, 9, 8)) < 0.5
    points, is_wall = rng.uniform(-0.2, 1.2, (50, 2)), rng.random(50) < 0.5
    poses = np.array([[1.0, 0.0, 0.0, 0.0], [0.6, 0.8, 0.3, -0.1]])
    found = measure_pose_evidence(
        poses, np.zeros((2, 1), np.int64), points, np.zeros(50, np.int64), is_wall, distance, floor, np.zeros(2), 0.1, 0.2
    )
    for h, (a, b, x, y) in enumerate(poses):
        at = np.floor((points @ np.array([(a, b), (-b, a)]) + (x, y)) / 0.1).astype(int)
        some = [(i, distance[0, u, v], floor[0, u, v]) for i, (u, v) in enumerate(at) if 0 <= u < 9 and 0 <= v < 8]
        agree = sum(np.exp(-0.5 * (d / 0.2) ** 2) for i, d, _ in some if is_wall[i] and d < 0.6)
        against = sum(f and d > 0.3 if is_wall[i] else (not f and d < 0.1) for i, d, f in some)
        common = sum(not is_wall[i] and f for i, _, f in some)
        assert np.allclose(found[h], (agree, against, common), rtol=1e-5)


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
