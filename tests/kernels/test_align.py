"""Poses refined and judged by the kernels, and by plain Python."""

from __future__ import annotations

import numpy as np

from topomerge.kernels import registration
from topomerge.matching.poses import compute_distance


def test_poses_refined_on_a_distance_field():
    rng = np.random.default_rng(0)
    mask = np.zeros((120, 100), bool)
    mask[20:90, 30] = mask[20, 30:80] = mask[60, 30:60] = True
    field = compute_distance(mask, 0.1)
    walls = (np.argwhere(mask) + 0.5) * 0.1
    middle = walls.mean(axis=0)
    start = np.array([[*(middle + rng.uniform(-0.2, 0.2, 2)), 0.04, 0.0] for _ in range(5)])
    poses, score = registration.refine(walls - middle, field, np.zeros(2), 0.1, start, np.array([0.3, 0.1]), 6, False)
    assert np.allclose(poses[:, :2], middle, atol=0.02) and np.allclose(poses[:, 2], 0, atol=0.005)
    assert (score > 0.9 * len(walls)).all()


def test_tally_equals_a_slow_twin():
    rng = np.random.default_rng(1)
    kind = rng.integers(0, 5, (30, 25)).astype(np.uint8)
    to_wall, to_any = rng.uniform(0, 1, (2, 30, 25)).astype(np.float32)
    face = rng.normal(size=(30, 25, 2)).astype(np.float32)
    open_, bits = rng.random((30, 25)) < 0.6, rng.integers(0, 16, (30, 25)).astype(np.uint32)
    points, kinds = rng.uniform(-1, 4, (400, 2)), rng.integers(1, 5, 400).astype(np.uint8)
    facing, inner = rng.normal(size=(400, 2)).astype(np.float32), rng.random(400) < 0.7
    filled = rng.integers(0, 16, 400).astype(np.uint32)
    origin, pose = np.array([-0.5, -0.3]), np.array([0.2, 0.1, 0.4, 0.1])
    here, there = (points, kinds, facing, inner, filled), (kind, to_wall, to_any, face, open_, bits, origin)
    found = registration.tally(*here, *there, 0.1, pose, 0.15, 0.25)
    slow = slow_tally(*here, *there, pose)
    assert np.allclose(found, slow)


def slow_tally(points, kinds, facing, inner, filled, kind, to_wall, to_any, face, open_, bits, origin, pose):
    out = np.zeros(11)
    out[10] = (kinds == registration.WALL_STATE).sum()
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[c, -s], [s, c]])
    cells = np.floor((np.exp(pose[3]) * points @ turn.T + pose[:2] - origin) / 0.1).astype(int)
    for (x, y), what, f, i, mine in zip(cells, kinds, facing, inner, filled, strict=True):
        mine = int(mine)
        if not (1 <= x < 29 and 1 <= y < 24):
            continue
        there = kind[x, y]
        if what == registration.WALL_STATE:
            near = to_wall[x, y] <= 0.15
            out[0] += near or there != 0
            alike = (turn @ f) @ face[x, y] > -0.3
            out[1] += near and alike
            out[2] += near and not alike
            out[3] += not near and there == registration.FREE_STATE and to_any[x, y] >= 0.25
            continue
        if there == 0:
            continue
        if what == registration.FREE_STATE:
            out[4] += 1
            out[5] += there == registration.FREE_STATE
        if i and open_[x, y] and what in (registration.FREE_STATE, registration.CLUTTER_STATE):
            there = bits[x - 1 : x + 2, y - 1 : y + 2][kind[x - 1 : x + 2, y - 1 : y + 2] == registration.CLUTTER_STATE]
            alike = [(mine & t).bit_count() / max((mine | t).bit_count(), 1) for t in there.tolist()]
            close = max([1.0] * len(alike) if what == registration.FREE_STATE else alike, default=0.0)
            first = 6 if what == registration.CLUTTER_STATE else 8
            out[first] += 1
            out[first + 1] += close
    return out
