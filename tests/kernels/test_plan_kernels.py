"""The compiled loops of the plans beside slow, obvious twins."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.kernels.rasters import PROFILE_BELOW, compute_watershed, fill_profiles, find_contacts, find_lowest_bit
from topomerge.kernels.rays import carve, measure_cover, measure_run, measure_widths, sweep
from topomerge.types import Array, VoxelGrid


def flood(clearance: Array) -> Array:
    return np.argsort(-clearance, axis=None, kind="stable")[: int((clearance > 0).sum())]


def test_profiles_are_the_bits_of_the_column() -> None:
    rng = np.random.default_rng(0)
    cells = np.unique(rng.integers(0, (6, 5, 40), (300, 3)), axis=0).astype(np.int32)
    low, base = np.array([1, 1]), rng.integers(0, 10, (4, 3))
    base[0, 0] = -99  # no floor
    top = base + rng.integers(5, 40, base.shape)
    out = np.zeros(base.shape, np.uint64)
    fill_profiles(cells, low, base, top, out)
    for x in range(4):
        for y in range(3):
            column = cells[(cells[:, 0] == x + 1) & (cells[:, 1] == y + 1), 2]
            bits = [z - base[x, y] + PROFILE_BELOW for z in column if z <= top[x, y]]
            expected = sum(1 << int(b) for b in bits if 0 <= b < 64) if base[x, y] > -PROFILE_BELOW else 0
            assert int(out[x, y]) == expected
    flat = out.ravel()
    for begin in (0, 7, 30):
        bits_from = find_lowest_bit(flat, begin)
        for word, bit in zip(flat.tolist(), bits_from.tolist(), strict=True):
            above = [b for b in range(begin, 64) if word >> b & 1]
            assert bit == (above[0] if above else -1)


def test_two_basins_meet_at_the_pass() -> None:
    clearance = np.array([[1, 2, 3, 2, 1, 2, 4, 2.0]])
    label = compute_watershed(clearance, flood(clearance), 0.5)
    assert len(np.unique(label)) == 2 and label[0, 2] != label[0, 6]
    assert (label[0, :4] == label[0, 2]).all() and (label[0, 5:] == label[0, 6]).all()
    meet = find_contacts(label, clearance)
    assert len(meet) == 1 and meet[0, 2] == 4


@pytest.mark.parametrize("prominence", [0.0, 0.5, 1.0, 2.5])
def test_low_peaks_are_no_basins(prominence: float) -> None:
    """Against the definition: basins are as many as peaks that rise so far above every pass to a higher one."""
    heights = np.array([[2.0, 1.0, 3.0, 2.5, 4.0, 0.5, 1.2]])
    label = compute_watershed(heights, flood(heights), prominence)
    rises = [2.0 - 1.0, 3.0 - 2.5, np.inf, 1.2 - 0.5]
    assert len(np.unique(label)) == sum(r >= prominence for r in rises)


def test_watershed_labels_every_open_column_and_nothing_else() -> None:
    rng = np.random.default_rng(1)
    clearance = np.where(rng.random((30, 40)) < 0.7, rng.random((30, 40)), 0.0)
    label = compute_watershed(clearance, flood(clearance), 0.2)
    assert ((label >= 0) == (clearance > 0)).all()
    for a, b, place in find_contacts(label, clearance).tolist():
        x, y = divmod(place, 40)
        around = set(label[max(x - 1, 0) : x + 2, max(y - 1, 0) : y + 2].ravel().tolist())
        assert a < b and {a, b} <= around


def test_runs_and_widths_in_a_corridor() -> None:
    inside = np.zeros((40, 20), bool)
    inside[:, 5:12] = True  # 7 wide, along x
    inside[:18, 2:15] = True  # and 13 wide before x = 18
    assert measure_run(inside, 20, 8, 0.0, 1.0, 30) == 3.0 and measure_run(inside, 20, 8, 0.0, -1.0, 30) == 3.0
    wide = measure_widths(inside, 20.0, 8.0, 0.0, 1.0, 4, 30)
    assert wide[4] == 7 and {wide[0], wide[8]} <= {7, 13, 14} and wide[0] != wide[8]
    assert (measure_widths(inside, 39.0, 8.0, 0.0, 1.0, 4, 30) == -1).sum() == 4  # beyond the end


def test_cover_finds_the_strip() -> None:
    lintel = np.zeros((20, 20), bool)
    lintel[9, 5:15] = True
    assert measure_cover(lintel, 10.0, 10.0, 0.0, 1.0, 4.0, 4.0, 2) == 1.0
    assert measure_cover(lintel, 14.0, 10.0, 0.0, 1.0, 4.0, 4.0, 2) == 0.0
    lintel[9, 8:12] = False
    assert measure_cover(lintel, 10.0, 10.0, 0.0, 1.0, 4.0, 4.0, 2) == pytest.approx(5 / 9)


@pytest.mark.longer
def test_carved_cells_are_those_that_rays_cross() -> None:
    rng = np.random.default_rng(2)
    starts, ends = rng.uniform(1, 9, (2, 50, 3))
    crossed = np.zeros((10, 10, 10), bool)
    carve(starts, ends, 0.5, crossed)
    expected = np.zeros_like(crossed)
    for a, b in zip(starts, ends, strict=True):
        length = np.linalg.norm(b - a)
        if length > 0.5:
            places = a + np.linspace(0, (length - 0.5) / length, 20_000)[:, None] * (b - a)
            expected[tuple(np.unique(np.floor(places).astype(int), axis=0).T)] = True
    assert not (expected & ~crossed).any()
    assert (crossed & ~expected).sum() <= 3  # corners that the samples miss


def test_a_sweep_stops_at_the_first_wall_and_tells_nothing_where_it_meets_none() -> None:
    wall = np.array([(20, y, z) for y in range(40) for z in range(40)], np.int32)
    grid = VoxelGrid.from_cells(wall, shape=(40, 40, 40))
    crossed = np.zeros((20, 20, 20), bool)
    directions = np.array([(1.0, 0, 0), (-1.0, 0, 0)])
    sweep(*grid._bricks, np.array([(4.5, 20.5, 20.5)]), directions, 50.0, 2, crossed)
    assert np.flatnonzero(crossed.any(axis=(1, 2))).tolist() == [2, 3, 4, 5, 6, 7, 8, 9]
    sweep(*grid._bricks, np.array([(4.5, 20.5, 20.5)]), directions, 10.0, 2, np.zeros_like(crossed))
