"""A wall that two maps show a little apart stands there once; the two faces of a thick wall stay."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.fusion.resampling import find_wall_copies
from topomerge.types import Array

UP = range(0, 26)


def wall(y: int, low: int = 0, high: int = 60) -> Array:
    return np.array([(x, y, z) for x in range(low, high) for z in UP])


def free(low: int, high: int) -> Array:
    """Free cells, two cells long, between y = low and y = high."""
    return np.array([(x, y, z) for x in range(0, 30) for y in range(low // 2, high // 2) for z in range(1, 12)])


@pytest.mark.parametrize("off", [1, 2])
def test_a_copy_is_drawn_to_the_wall(off):
    first, second = wall(20), wall(20 + off)
    copy_of = find_wall_copies((first, free(0, 18)), (second, free(0, 18)), 0.1)  # both look from below
    assert (copy_of >= 0).mean() > 0.7  # but where nothing is known of the free space, at floor and ceiling
    drawn = copy_of >= 0
    assert (first[copy_of[drawn], 1] == 20).all() and (first[copy_of[drawn], 2] == second[drawn, 2]).all()
    back = find_wall_copies((second, free(0, 18)), (first, free(0, 18)), 0.1)
    assert (back >= 0).mean() > 0.7


def test_faces_of_a_thick_wall_stay():
    first, second = wall(20), wall(22)
    assert (find_wall_copies((first, free(0, 18)), (second, free(24, 44)), 0.1) == -1).all()


def test_what_is_far_from_a_wall_stays():
    assert (find_wall_copies((wall(20), free(0, 18)), (wall(24), free(0, 18)), 0.1) == -1).all()


def test_a_gap_that_one_map_has_is_filled_by_the_other():
    first = np.concatenate([wall(20, 0, 25), wall(20, 35, 60)])
    assert (find_wall_copies((first, free(0, 18)), (wall(20), free(0, 18)), 0.1) == -1).all()


def test_floors_are_no_walls():
    floor = np.array([(x, y, 0) for x in range(40) for y in range(40)])
    other = floor + (0, 1, 1)
    assert (find_wall_copies((floor, free(0, 40)), (other, free(0, 40)), 0.1) == -1).all()
