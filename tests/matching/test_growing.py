"""Hypotheses that grow from a pair of rooms to its neighbours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.scenes_map import building
from topomerge.matching.growing import align, grow
from topomerge.types import Sim3


def test_growing_on_a_graph_by_hand():
    a = building(2)
    cost = np.full((5, 5), 1.0)
    np.fill_diagonal(cost, 0.1)
    cost[0, 0] = 0.01
    b = replace(a)
    grown = grow(a, b, cost, c_max=0.5)
    assert grown[0] == ((0, 0), (1, 1), (2, 2), (3, 3), (4, 4))
    assert all(len(pairs) == 1 for pairs in grow(a, b, cost, c_max=0.005))
    far = replace(a, rooms=a.rooms.copy())
    far.rooms["centroid"][3] += 40  # its match makes the alignment worse by more than 2.5 m
    assert (3, 3) not in grow(a, far, cost, c_max=0.5)[0]


def test_align_is_exact():
    rng = np.random.default_rng(1)
    points = rng.standard_normal((7, 3))
    true = Sim3(2.5, (3.0, -1.0, 0.5), 1.4)
    found, error = align(true.apply(points), points, scale=True)
    assert np.allclose(found.matrix, true.matrix) and error < 1e-9
