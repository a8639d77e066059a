"""Walls that stand there twice are counted; faces of a thick wall, doorways and walls across are not."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fusion.atlas.atlas_scenes import office_map, truth
from topomerge.evaluation.score import find_doubled_columns, measure_doubled_walls
from topomerge.fusion.fuse import fuse
from topomerge.types import Sim3

EDGE = 0.1


def line(y: int, low: int = 10, high: int = 90) -> np.ndarray:
    walls = np.zeros((100, 60), bool)
    walls[low:high, y] = True
    return walls


FLOOR = np.ones((100, 60), bool)


@pytest.mark.parametrize(("cells", "share"), [(0, 0.0), (1, 0.0), (2, 1.0), (4, 1.0), (6, 1.0), (7, 0.0)])
def test_a_copy_is_counted_from_a_gap_to_six_tenths_of_a_metre(cells, share):
    first, second = line(30), line(30 + cells)
    doubled = find_doubled_columns(first, second, FLOOR, EDGE)
    assert not (doubled & ~first).any() and doubled.sum() == pytest.approx(share * first.sum(), abs=6)


def test_faces_of_a_thick_wall_are_two():
    seen = FLOOR.copy()
    seen[:, 31:33] = False  # nobody looked between them
    assert not find_doubled_columns(line(30), line(33), seen, EDGE).any()


def test_what_one_map_shows_twice_is_there_twice():
    both = line(30) | line(34)
    assert not find_doubled_columns(both, line(34), FLOOR, EDGE).any()
    assert not find_doubled_columns(line(34), both, FLOOR, EDGE).any()


def test_a_wall_that_goes_on_or_stands_across_is_no_copy():
    assert not find_doubled_columns(line(30, 10, 50), line(30, 54, 90), FLOOR, EDGE).any()
    across = np.zeros((100, 60), bool)
    across[50, 33:55] = True
    assert find_doubled_columns(line(30), across, FLOOR, EDGE).sum() <= 1


def test_half_a_wall_twice_is_half():
    doubled = find_doubled_columns(line(30), line(33, 50), FLOOR, EDGE)
    assert doubled.sum() == pytest.approx(0.5 * line(30).sum(), abs=8)


@pytest.mark.longer
def test_a_joined_map_of_maps_that_agree_has_no_wall_twice():
    halves = office_map(0), office_map(2)
    joined = fuse(halves, [(0, Sim3()), (1, truth(0, 2))])
    assert measure_doubled_walls(joined) < 0.02
    off = Sim3(0.0, (0.5, 0.5, 0.0)) @ truth(0, 2)
    assert measure_doubled_walls(fuse(halves, [(0, Sim3()), (1, off)])) > 0.1
    assert np.isnan(measure_doubled_walls(halves[0]))  # of one source
