"""Known transforms are found again; what cannot be decided is not believed."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from tests.fusion.plans_of import MOVE, doubled, grid_of, off, office, part
from tests.scenes import HEIGHT, Scene
from topomerge.errors import InputError
from topomerge.fusion.judge import Judge
from topomerge.fusion.refine import refine_pose, surface
from topomerge.fusion.registration import register
from topomerge.fusion.storey_plan import plans
from topomerge.fusion.yaw_candidates import yaw_candidates
from topomerge.kernels import align
from topomerge.matching.plan_fields import PlanFields, direction_profile, distance_to
from topomerge.types import Sim3, VoxelGrid


@pytest.fixture(scope="module")
def points():
    return office().points()


@pytest.fixture(scope="module")
def halves(points):
    """The west and the east of the office, in two frames; T_ab = MOVE^-1."""
    return grid_of(part(points, high=(16, 99))), grid_of(part(points, low=(5, -99)), MOVE)


def middle_in_b(frame=MOVE):
    return tuple(frame.apply(np.array([[10.0, 7.0, 1.0]]))[0])


def test_two_halves_are_joined(halves):
    found = register(*halves)
    metres, degrees = off(found.transform, MOVE.inverse(), middle_in_b())
    assert metres < 0.03 and degrees < 0.1
    assert found.accepted and found.probability > 0.8 and found.features["rmse"] < 0.03
    assert found.transform.scale == 1.0 and "believed" in found.reason


def test_the_other_way_round_is_the_inverse(halves):
    there, back = register(*halves), register(*reversed(halves))
    assert np.allclose((there.transform @ back.transform).matrix, np.eye(4), atol=1e-9)
    assert there.probability == back.probability


def test_order_of_cells_changes_nothing(halves):
    a, b = halves
    rows = np.random.default_rng(0).permutation(len(a))
    shuffled = VoxelGrid.from_cells(a.cells[rows], a.origin, a.edge, a.shape, {"mean": a.properties["mean"][rows]})
    assert register(shuffled, b).transform == register(a, b).transform


def test_a_hypothesis_is_tried_and_refined(halves):
    near = Sim3(-MOVE.yaw + 0.03, MOVE.inverse().translation)
    found = register(*halves, proposed=[near], yaws=[0.3])
    assert off(found.transform, MOVE.inverse(), middle_in_b())[0] < 0.03


@pytest.mark.parametrize("scale", [0.8])
def test_an_unknown_scale_is_found(points, scale):
    frame = Sim3(MOVE.yaw, MOVE.translation, scale)
    a, b = grid_of(part(points, high=(17, 99))), grid_of(part(points, low=(4, -99)), frame, mean=False)
    found = register(a, b, scale="free")
    assert found.transform.scale * scale == pytest.approx(1.0, abs=0.01)
    assert off(found.transform, frame.inverse(), middle_in_b(frame))[0] < 0.15


def test_a_slice_finds_its_place_in_a_scan(points):
    cut = part(points, high=(17, 99))
    cut = cut[np.abs(cut[:, 2] - 0.3) < 0.04]
    found = register(grid_of(points), grid_of(cut, MOVE))
    x, y, _ = found.transform.apply(np.array([middle_in_b()]))[0]
    assert np.hypot(x - 10, y - 7) < 0.15


def test_maps_of_two_buildings_are_not_believed(points):
    other = Scene().shell(0, 0, 13, 9).wall((5, 0), (5, 9), doors=(2.0,)).wall((5, 5), (13, 5), doors=(4.0,)).points()
    found = register(grid_of(points), grid_of(other, MOVE))
    assert not found.accepted and "not believed" in found.reason


def test_a_repeated_room_is_not_believed():
    """Eight rooms alike along a corridor that neither map shows whole: nothing tells which of them is which."""
    scene = Scene().shell(0, 0, 32, 10)
    for y in (4, 6):
        scene.wall((0, y), (32, y), doors=tuple(2.0 + 4 * k for k in range(8)))
    for x in range(4, 32, 4):
        scene.wall((x, 0), (x, 4)).wall((x, 6), (x, 10))
    points = scene.points()
    found = register(grid_of(part(points, (3.8, -9), (16.2, 19))), grid_of(part(points, (11.8, -9), (24.2, 19)), MOVE))
    assert not found.accepted


def test_storeys_of_one_plan_are_told_apart_by_the_other_one():
    """The lower storey has another plan above it in one map: only at the right height do both storeys agree."""
    lower, upper = office(), Scene().shell(0, 0, 24, 14).wall((12, 0), (12, 14), doors=(3.0,)).wall((0, 9), (12, 9), doors=(5.0,))
    lift = np.array([0, 0, HEIGHT + 0.3], np.float32)
    both = np.concatenate([lower.points(), upper.points() + lift])
    found = register(grid_of(both), grid_of(part(both, low=(4, -99)), MOVE))
    assert off(found.transform, MOVE.inverse(), middle_in_b())[0] < 0.05


def test_a_storey_that_fits_two_is_not_believed(points):
    found = register(grid_of(doubled(office())), grid_of(points, MOVE))
    assert not found.accepted


def test_free_space_speaks_against_a_wall():
    hall, cut = Scene().shell(0, 0, 10, 8), Scene().shell(0, 0, 10, 8).wall((5, 0), (5, 8), doors=(3.0,))
    a, b = ([PlanFields(p) for p in plans(grid_of(s.points()))] for s in (hall, cut))
    judged = Judge(a, b)(Sim3())
    assert judged["conflict"] > 0.3 and judged["conflict_share"] > 0.1
    assert Judge(a, a)(Sim3())["conflict"] == 0 and Judge(a, a)(Sim3())["ratio"] > 0.95


def test_a_map_without_walls_has_no_pose():
    floor = grid_of(Scene().floor(0, 0, 5, 5).points())
    found = register(floor, floor)
    assert found.transform is None and found.probability == 0 and not found.accepted


def test_another_word_for_the_scale_is_refused(halves):
    with pytest.raises(InputError, match="fixed or free"):
        register(*halves, scale="any")


def test_yaw_candidates_of_a_pentagon():
    angles = 2 * np.pi * np.arange(6) / 5
    corners = 10 * np.column_stack([np.cos(angles), np.sin(angles)])
    walls = np.concatenate([p + (q - p) * np.linspace(0, 1, 120)[:, None] for p, q in pairwise(corners)])
    turn = np.radians(23.0)
    c, s = np.cos(turn), np.sin(turn)
    found = yaw_candidates(direction_profile(walls @ np.array([[c, s], [-s, c]]), 0.1), direction_profile(walls, 0.1))
    assert min(abs(np.degrees(y) - 23.0) for y in found) < 1.0


def test_point_to_plane_recovers_a_small_motion(points):
    grid = grid_of(points)
    true = Sim3(0.02, (0.12, -0.1, 0.08))
    found = refine_pose(surface(grid_of(points, true)), surface(grid), Sim3())
    metres, degrees = off(found.pose, true)
    assert metres < 0.02 and degrees < 0.05 and found.partners > 0.8


def test_poses_refined_on_a_distance_field():
    rng = np.random.default_rng(0)
    mask = np.zeros((120, 100), bool)
    mask[20:90, 30] = mask[20, 30:80] = mask[60, 30:60] = True

    field = distance_to(mask, 0.1)
    walls = (np.argwhere(mask) + 0.5) * 0.1
    middle = walls.mean(axis=0)
    start = np.array([[*(middle + rng.uniform(-0.2, 0.2, 2)), 0.04, 0.0] for _ in range(5)])
    poses, score = align.refine(walls - middle, field, np.zeros(2), 0.1, start, np.array([0.3, 0.1]), 6, False)
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
    found = align.tally(*here, *there, 0.1, pose, 0.15, 0.25)
    slow = slow_tally(*here, *there, pose)
    assert np.allclose(found, slow)


def slow_tally(points, kinds, facing, inner, filled, kind, to_wall, to_any, face, open_, bits, origin, pose):
    out = np.zeros(11)
    out[10] = (kinds == align.WALL).sum()
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[c, -s], [s, c]])
    cells = np.floor((np.exp(pose[3]) * points @ turn.T + pose[:2] - origin) / 0.1).astype(int)
    for (x, y), what, f, i, mine in zip(cells, kinds, facing, inner, filled, strict=True):
        mine = int(mine)
        if not (1 <= x < 29 and 1 <= y < 24):
            continue
        there = kind[x, y]
        if what == align.WALL:
            near = to_wall[x, y] <= 0.15
            out[0] += near or there != 0
            alike = (turn @ f) @ face[x, y] > -0.3
            out[1] += near and alike
            out[2] += near and not alike
            out[3] += not near and there == align.FREE and to_any[x, y] >= 0.25
            continue
        if there == 0:
            continue
        if what == align.FREE:
            out[4] += 1
            out[5] += there == align.FREE
        if i and open_[x, y] and what in (align.FREE, align.CLUTTER):
            there = bits[x - 1 : x + 2, y - 1 : y + 2][kind[x - 1 : x + 2, y - 1 : y + 2] == align.CLUTTER]
            alike = [(mine & t).bit_count() / max((mine | t).bit_count(), 1) for t in there.tolist()]
            close = max([1.0] * len(alike) if what == align.FREE else alike, default=0.0)
            first = 6 if what == align.CLUTTER else 8
            out[first] += 1
            out[first + 1] += close
    return out
