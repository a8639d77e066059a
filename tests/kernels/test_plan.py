"""Columns of a plan, by the kernels and by plain Python.

Steps from pixel to pixel.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from topomerge.kernels.rasters import compute_column_bits, count_steps, find_line_columns


def test_column_bits_equal_a_slow_twin():
    rng = np.random.default_rng(0)
    ix, iy, z = rng.integers(-1, 7, 300), rng.integers(-1, 6, 300), rng.uniform(-1, 9, 300)
    z[::17] = np.nan
    base = rng.uniform(0, 1, (6, 5))
    slow = np.zeros((6, 5), np.uint32)
    for x, y, h in zip(ix, iy, z, strict=True):
        if 0 <= x < 6 and 0 <= y < 5 and not np.isnan(h):
            k = int(np.floor((h - base[x, y] + 0.5) / 0.25))
            slow[x, y] |= np.uint32(1 << k) if 0 <= k < 32 else np.uint32(0)
    assert np.array_equal(compute_column_bits(ix, iy, z, base, -0.5, 0.25), slow)


def test_on_lines_keeps_straight_runs_only():
    mask = np.zeros((40, 40), bool)
    mask[5, 3:30] = True
    mask[np.arange(10, 35), np.arange(10, 35)] = True
    legs = [(20, 5), (22, 7), (33, 3), (35, 6), (30, 9)]
    for leg in legs:
        mask[leg] = True
    angles = np.pi * np.arange(24) / 24
    kept = find_line_columns(mask, np.cos(angles), np.sin(angles), 12, 11, 3)
    assert kept[5, 3:30].all() and kept[np.arange(10, 35), np.arange(10, 35)].all()
    assert not any(kept[leg] for leg in legs)


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
