"""Squares of two maps from above: where they are, what is in them, and that both maps lie on one another."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fusion.plans_of import MOVE, doubled, grid_of, office, part
from topomerge.matching.poses import PlanFields
from topomerge.registration.places import CROP_PIXEL, LEAST_SEEN, PARTS, SIDE, cut_crops
from topomerge.registration.storeys import build_plans
from topomerge.types import Sim3

WALL, FREE, CLUTTER = (1 << PARTS.index(n) for n in ("wall", "free", "clutter"))


def storeys(points, frame=None):
    return tuple(PlanFields(p) for p in build_plans(grid_of(points, frame)))


@pytest.fixture(scope="module")
def points():
    return office().points()


def test_a_map_on_itself_is_the_same_in_every_square(points):
    a = storeys(points)
    seen = cut_crops(a, a, Sim3())
    assert len(seen) > 8 and (seen.parts[:, 0] == seen.parts[:, 1]).all() and (seen.ceiling[:, 0] == seen.ceiling[:, 1]).all()
    assert seen.area.sum() == pytest.approx(24 * 14, rel=0.1) and (seen.area >= LEAST_SEEN).all()
    assert (seen.middle[:, 0] > 0).all() and (seen.middle[:, 0] < 24).all() and (seen.middle[:, 1] < 14).all()


def test_a_map_elsewhere_lies_on_itself_under_the_right_pose_only(points):
    a, b = storeys(points), storeys(points, MOVE)
    right, wrong = (cut_crops(a, b, pose) for pose in (MOVE.inverse(), Sim3(0.0, (1.5, 0.0, 0.0)) @ MOVE.inverse()))

    def clash(c):  # walls of the one where the other is empty
        return ((c.parts[:, 0] & WALL > 0) & (c.parts[:, 1] & FREE > 0)).mean() / (c.parts[:, 0] & WALL > 0).mean()

    assert clash(right) < 0.12 < 0.4 < clash(wrong)


def test_walls_furniture_and_ceilings_are_where_they_are(points):
    seen = cut_crops(storeys(points), storeys(points), Sim3())
    assert {int(v) for v in np.unique(seen.parts & (WALL | FREE | CLUTTER))} <= {0, WALL, FREE, CLUTTER}
    k = int(np.hypot(*(seen.middle[:, :2] - (6.7, 2.4)).T).argmin())  # a table of 1.4 x 0.8 m
    low = seen.parts[k, 0] >> PARTS.index("low") & 1
    table = (seen.parts[k, 0] & CLUTTER > 0) & (low > 0)
    assert table.sum() * CROP_PIXEL**2 == pytest.approx(1.4 * 0.8, rel=0.4)
    told = seen.ceiling[seen.ceiling > 0]
    assert 1.5 + (np.median(told) - 1) * 0.02 == pytest.approx(2.6, abs=0.15)
    assert seen.looked[:, :, 0].max() == 0 and seen.looked[:, :, 1:].min() == 1


@pytest.mark.longer
def test_maps_that_share_nothing_share_no_square(points):
    left, right = storeys(part(points, high=(9, 99))), storeys(part(points, low=(15, -99)))
    assert len(cut_crops(left, right, Sim3())) == 0
    assert len(cut_crops(storeys(points), storeys(points), Sim3(0.0, (0.0, 0.0, 9.0)))) == 0  # another level
    far = cut_crops(storeys(points), storeys(points), Sim3(0.0, (500.0, 0.0, 0.0)))
    assert far.parts.shape == (0, 2, SIDE, SIDE) and far.middle.shape == (0, 3)


def test_heights_of_a_map_of_another_scale_grow_with_it(points):
    small = storeys(points * 0.85)
    seen = cut_crops(storeys(points), small, Sim3(0.0, (0.0, 0.0, 0.0), 1 / 0.85))
    both = (seen.ceiling > 0).all(axis=1)
    assert len(seen) > 8 and np.abs(np.diff(seen.ceiling.astype(int), axis=1)[:, 0][both]).mean() < 6


@pytest.mark.longer
def test_the_floor_above_is_no_other_ceiling(points):
    """Below another storey the highest thing of a room is that one's floor: all of it higher, and no contradiction."""
    both = storeys(doubled(office()))
    for level, z in enumerate((0.0, 2.9)):
        seen = cut_crops(both[level : level + 1], storeys(points), Sim3(0.0, (0.0, 0.0, z)))
        told = (seen.ceiling > 0).all(axis=1)
        assert len(seen) > 8 and told.mean() > 0.3
        assert np.abs(np.diff(seen.ceiling.astype(int), axis=1)[:, 0][told]).mean() < 3
