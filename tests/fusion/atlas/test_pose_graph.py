"""Poses of many maps from poses of pairs: exact where the measurements are, robust where one of them is wrong."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.fusion.pose_graph import Measured, compute_residual, optimise
from topomerge.matching.poses import pose_difference
from topomerge.types import Sim3

PLACE = np.array([[4.0, 3.0, 0.5], [8.0, 3.0, 0.5], [0.0, 3.0, 0.5], [4.0, 6.0, 0.5], [4.0, 0.0, 0.5]])


def ring(count: int = 6, scaled: bool = False) -> dict[int, Sim3]:
    """Poses all round, so that yaws cross 180 degrees; the first is the identity."""
    rng = np.random.default_rng(3)
    poses = {0: Sim3()}
    for k in range(1, count):
        x, y, z = rng.uniform(-20, 20, 3).tolist()
        yaw = float((2.5 * k + np.pi) % (2 * np.pi) - np.pi)
        poses[k] = Sim3(yaw, (x, y, z / 10), float(np.exp(rng.uniform(-0.5, 0.5))) if scaled else 1.0)
    return poses


def measured(poses: dict[int, Sim3], pairs: list[tuple[int, int]], noise: float = 0.0) -> list[Measured]:
    rng = np.random.default_rng(1)
    edges = []
    for i, j in pairs:
        pose = poses[i].inverse() @ poses[j]
        off = Sim3(float(rng.normal(0, noise / 5)), tuple(rng.normal(0, noise, 3).tolist()))  # type: ignore[arg-type]
        edges.append(Measured((i, j), off @ pose, PLACE))
    return edges


def started(poses: dict[int, Sim3], rng: np.random.Generator) -> dict[int, Sim3]:
    def near(p: Sim3) -> Sim3:
        x, y, z = (np.array(p.translation) + rng.normal(0, 0.3, 3)).tolist()
        return Sim3(p.yaw + float(rng.normal(0, 0.05)), (x, y, z), p.scale * float(np.exp(rng.normal(0, 0.02))))

    return {k: near(p) if k else p for k, p in poses.items()}


def worst(solved: dict[int, Sim3], true: dict[int, Sim3]) -> tuple[float, float, float]:
    gaps = np.array([pose_difference(solved[k], true[k], PLACE[0]) for k in true])
    return tuple(gaps.max(axis=0).tolist())  # type: ignore[return-value]


CYCLE = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (0, 5), (1, 4)]


@pytest.mark.parametrize("scaled", [False, True])
def test_true_measurements_give_the_true_poses(scaled):
    true = ring(scaled=scaled)
    start = started(true, np.random.default_rng(0))
    if not scaled:
        start = {k: Sim3(p.yaw, p.translation) for k, p in start.items()}
    solved = optimise(start, measured(true, CYCLE), scaled)
    assert max(worst(solved, true)) < 1e-5
    assert solved[0] == true[0] and all(-np.pi <= pose.yaw < np.pi for pose in solved.values())
    assert all(compute_residual(e, solved) < 1e-5 for e in measured(true, CYCLE))


def test_one_wrong_measurement_hardly_counts():
    true = ring()
    edges = measured(true, CYCLE, noise=0.01)
    wrong = Sim3(0.3, (2.0, -1.0, 0.0)) @ edges[-1].pose
    edges[-1] = Measured(edges[-1].maps, wrong, PLACE)
    solved = optimise(true, edges)
    metres, radians, _ = worst(solved, true)
    assert metres < 0.1 and radians < 0.02
    assert compute_residual(edges[-1], solved) > 1.0 > 0.1 > max(compute_residual(e, solved) for e in edges[:-1])


def test_errors_are_shared_around_a_cycle():
    """Four equal steps of 90 degrees that miss the start by 4 cm: each takes the same share."""
    step = Sim3(np.pi / 2, (10.0, 0.0, 0.0))
    poses = {0: Sim3(), 1: step, 2: step @ step, 3: step @ step @ step}
    points = np.array([[0.0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    closing = Sim3(0.0, (0.04, 0.0, 0.0)) @ (poses[3].inverse() @ poses[0])
    edges = [Measured((k, k + 1), step, points) for k in range(3)] + [Measured((3, 0), closing, points)]
    solved = optimise(poses, edges)
    off = [compute_residual(e, solved) for e in edges]
    assert max(off) < 0.01 and max(off) - min(off) < 1e-6 and min(off) > 1e-4


def test_the_anchor_stays_and_nothing_is_needed():
    poses = ring(3)
    assert optimise(poses, [])[2] == poses[2]
    solved = optimise(poses, measured(poses, [(0, 1), (1, 2)], 0.05), anchor=2)
    assert solved[2] == poses[2]


def test_measurements_count_less_the_farther_they_are_off():
    """Two say 0, a third says 30 cm: it pulls with the Cauchy weight of its residual, by half at 15 cm."""
    edges = [Measured((0, 1), Sim3(0.0, (x, 0.0, 0.0)), PLACE) for x in (0.0, 0.0, 0.3)]
    x = optimise({0: Sim3(), 1: Sim3()}, edges)[1].translation[0]
    pull = [(at - x) / (1 + ((at - x) / 0.15) ** 2) for at in (0.0, 0.0, 0.3)]
    assert sum(pull) == pytest.approx(0.0, abs=1e-5) and 0.0 < x < 0.1


def test_weights_of_measurements():
    """Small residuals: the solution is the weighted mean."""
    edges = [Measured((0, 1), Sim3(0.0, (x, 0.0, 0.0)), PLACE, weight) for x, weight in ((0.0, 3.0), (0.004, 1.0))]
    assert optimise({0: Sim3(), 1: Sim3()}, edges)[1].translation[0] == pytest.approx(0.001, abs=1e-5)
    assert compute_residual(edges[1], {0: Sim3(), 1: Sim3()}) == pytest.approx(0.004)


def test_the_frame_and_the_number_of_points_change_nothing():
    """Measurements that contradict each other a little are settled alike far from the origin, however many points they have."""
    true, frame = ring(4), Sim3(1.0, (300.0, -200.0, 5.0))
    edges = measured(true, [(0, 1), (1, 2), (2, 3), (0, 3)], noise=0.05)
    solved = optimise(true, edges)
    moved = optimise({k: frame @ pose for k, pose in true.items()}, edges)
    many = optimise(true, [*edges[:-1], Measured(edges[-1].maps, edges[-1].pose, np.tile(PLACE, (5, 1)))])
    for k, pose in solved.items():
        assert pose_difference(frame @ pose, moved[k], PLACE[0])[0] < 1e-5 and pose_difference(pose, many[k], PLACE[0])[0] < 1e-5
    assert max(compute_residual(e, solved) for e in edges) > 0.01
