"""Strips along lines and the voting for lines, against the plainest way to reckon them."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.kernels.images import fill_strips
from topomerge.kernels.rasters import find_strongest_line, weigh_by_distance

STEP = np.array([0.05, 0.025, 0.2])


def plainly(points, frames, sizes, shape, step):
    """As `fill_strips`, point by point and line by line."""
    out = [np.zeros((size, *shape)) for size in sizes]
    for strip, frame in zip(out, frames, strict=True):
        for point in points:
            away = point[:2] - frame[:2]
            u, w = int(np.floor(away @ frame[2:4] / step[0])), int(np.floor((point[2] - frame[6]) / step[2]))
            v = away @ frame[4:6] / step[1] - 0.5
            if 0 <= u < len(strip) and 0 <= w < shape[1]:
                for near, share in ((int(np.floor(v)), 1 - v % 1), (int(np.floor(v)) + 1, v % 1)):
                    if 0 <= near < shape[0]:
                        strip[u, near, w] += share
    return np.concatenate(out)


def frames(rng, count):
    yaw = rng.uniform(-np.pi, np.pi, count)
    along = np.column_stack([np.cos(yaw), np.sin(yaw)])
    across = np.column_stack([-along[:, 1], along[:, 0]]) * rng.choice([-1, 1], (count, 1))
    return np.column_stack([rng.uniform(-3, 3, (count, 2)), along, across, rng.uniform(-0.5, 0.5, count)])


@pytest.mark.longer
@pytest.mark.parametrize("seed", range(4))
def test_every_point_counts_where_it_lies(seed):
    rng = np.random.default_rng(seed)
    lines, sizes = frames(rng, 7), rng.integers(2, 60, 7)
    points = rng.uniform((-4, -4, -1), (4, 4, 3), (3000, 3))
    strips = fill_strips(points, lines, sizes, (12, 9), STEP, 1.0)
    assert strips == pytest.approx(plainly(points, lines, sizes, (12, 9), STEP), abs=1e-4) and strips.sum() > 20


def test_a_point_between_two_elements_counts_for_both():
    line = np.array([[1.0, 2.0, 0.0, 1.0, 1.0, 0.0, 0.0]])  # along y, across along x
    strips = fill_strips(np.array([[1.0 + 0.0625, 2.12, 0.5]]), line, np.array([4]), (4, 3), STEP, 1.0)
    assert strips[2, :, 2].tolist() == pytest.approx([0, 0, 1, 0]) and strips.sum() == pytest.approx(1)
    strips = fill_strips(np.array([[1.05, 2.12, 0.5]]), line, np.array([4]), (4, 3), STEP, 1.0)
    assert strips[2, :, 2].tolist() == pytest.approx([0, 0.5, 0.5, 0])


def test_nothing_gives_nothing():
    assert fill_strips(np.zeros((0, 3)), np.zeros((0, 7)), np.zeros(0, np.int64), (4, 3), STEP, 1.0).shape == (0, 4, 3)
    one = np.array([[0.0, 0, 1, 0, 0, 1, 0]])
    assert not fill_strips(np.array([[50.0, 50, 0]]), one, np.array([4]), (4, 3), STEP, 1.0).any()


def test_the_line_with_most_weight_is_voted_for():
    rng = np.random.default_rng(0)
    t = np.linspace(-2, 2, 80)
    wall = np.column_stack([t * np.cos(0.3), t * np.sin(0.3)]) + 0.7 * np.array([-np.sin(0.3), np.cos(0.3)])
    points = np.concatenate([wall, rng.uniform(-3, 3, (60, 2))])
    angles = np.linspace(0, np.pi, 60, endpoint=False)
    angle, offset = find_strongest_line(points, np.ones(len(points)), angles, 0.04)
    assert angle == pytest.approx(0.3, abs=0.06) and offset == pytest.approx(0.7, abs=0.06)


@pytest.mark.parametrize("given", [False, True])
def test_points_far_from_the_line_weigh_less(given):
    def weigh_slowly(points, weights, along, scales):
        weight = weights
        for scale in scales:
            middle = np.average(points, axis=0, weights=weight)
            scatter = (points - middle).T @ ((points - middle) * weight[:, None])
            unit = along if along.any() else np.linalg.eigh(scatter)[1][:, 1]
            off = (points - middle) @ (-unit[1], unit[0])
            weight = weights / (1 + (off / scale) ** 2)
        return weight

    for seed in range(20):
        rng = np.random.default_rng(seed)
        angle, t = rng.uniform(0, np.pi), rng.uniform(0, 4, 50)
        unit = np.array([np.cos(angle), np.sin(angle)])
        points = t[:, None] * unit + rng.normal(0, 0.02, (50, 2))
        points[:3] += 0.3 * np.array([-unit[1], unit[0]])
        weights, scales = rng.uniform(0.01, 0.1, 50), np.array([0.05, 0.03, 0.015])
        along = unit if given else np.zeros(2)
        weight = weigh_by_distance(points, weights, along, scales)
        np.testing.assert_allclose(weight, weigh_slowly(points, weights, along, scales), rtol=1e-9)
        assert (weight[:3] < 0.05 * weights[:3]).all()
