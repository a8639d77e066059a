"""Steps from pixel to pixel."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from topomerge.kernels.rasters import count_steps


def test_steps_lead_around_what_is_no_way():
    way = np.ones((3, 5), bool)
    way[:2, 2] = False
    start = np.zeros((3, 5), bool)
    start[0, 0] = True
    assert count_steps(start, way).tolist() == [[0, 1, -1, 4, 4], [1, 1, -1, 3, 4], [2, 2, 2, 3, 4]]


def test_steps_are_those_of_growing_masks():
    rng = np.random.default_rng(0)
    way = rng.random((40, 30)) < 0.6
    start = np.zeros(way.shape, bool)
    start[5:8, 5:8] = True
    expected, reached = np.where(start, 0, -1), start.copy()
    for n in range(1, way.size):
        grown = ndimage.binary_dilation(reached, np.ones((3, 3)), mask=way) & ~reached
        expected[grown] = n
        reached |= grown
    assert np.array_equal(count_steps(start, way), expected)
