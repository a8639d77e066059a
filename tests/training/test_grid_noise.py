"""Noise of robots' grids: what stands where may change, what is true does not, and floor is never wall."""

from __future__ import annotations

import numpy as np
import pytest

from tests.training.tiny import two_rooms
from topomerge.extraction.plans.plan_network import compute_evidence
from topomerge.training.plan_segmentation import add_grid_noise

EXAMPLE = two_rooms(10)


@pytest.mark.parametrize("seed", range(12))
def test_noise_leaves_evidence_of_a_grid(seed):
    x, room = compute_evidence(EXAMPLE.plan), EXAMPLE.room >= 0
    before = x.copy()
    out = add_grid_noise(x, room, np.random.default_rng(seed))
    known, wall = out[..., 0] > 0, out[..., 1] > 0
    assert (x == before).all() and out.shape == x.shape and not (known & wall).any()
    assert (out[..., 2:6] == wall[..., None]).all() and (out[..., 6] == (known | wall)).all()
    assert (out[..., 10] == x[..., 10]).all() and known.sum() > 0.4 * (x[..., 0] > 0).sum()
    assert (add_grid_noise(x, room, np.random.default_rng(seed)) == out).all()


def test_some_of_it_changes_walls_and_floor():
    x, room = compute_evidence(EXAMPLE.plan), EXAMPLE.room >= 0
    made = [add_grid_noise(x, room, np.random.default_rng(seed)) for seed in range(12)]
    assert sum((m[..., 1] != x[..., 1]).any() for m in made) >= 8 and sum((m[..., 0] != x[..., 0]).any() for m in made) >= 8
