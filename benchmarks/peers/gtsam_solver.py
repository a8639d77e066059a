"""The solver that bends maps beside GTSAM, on the same factors: how far their solutions lie apart, and the ratio of their times.

``python -m benchmarks.peers.gtsam_solver [ROOMS ...]`` with ``pip install gtsam`` (4.3). Storeys of rooms
along corridors, bent by waves; the factors are those of the last round by plan. GTSAM gets a `Pose2` a piece,
`BetweenFactorPose2` for joints and measurements and a prior for each piece, graduated non-convexity (Geman-McClure) over
the measurements; its poses turn, ours are linear in the turn.
For both, each measurement names the one piece of the other map that has most to say there. Median of five runs each.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.progress import Stopwatch
from topomerge.registration.bend import alignment as alignments
from topomerge.registration.bend.alignment import Alignment
from topomerge.registration.bend.bend import WINDOWS, settle_all
from topomerge.registration.bend.graph import OUTLIER, Joints, Measurements, settle
from topomerge.registration.bend.pieces import get_sensor_drift
from topomerge.registration.prepared import prepare
from topomerge.types import Array, Sim3, VoxelGrid

EDGE = 0.1  # m
DEPTH, WALL, DOOR = 5.0, 2.5, 0.9  # m: depth of a room, height of walls, width of doors
WIDTHS = (2.6, 6.0)  # m, of rooms
BEND_LENGTH, BEND_SIZE = 25.0, 0.15  # m: of the waves that bend the second map
CORRIDOR = 2.0  # m
RUNS = 5
ROOMS = (10, 30, 100)
POSE = Sim3(0.4, (3.0, -2.0, 0.1))
Problem = tuple[Array, Joints, Measurements, Array]


def storey(rooms: int, seed: int = 0) -> tuple[Array, Array]:
    """Simulate points (n, 3) of the walls and of the floor of a storey: rows of rooms of random widths, each with a door to a
    corridor."""
    rng = np.random.default_rng(seed)
    long = max(round(np.sqrt(rooms * 1.5)), 2)
    walls: list[Array] = []
    width = 0.0
    for row, first in enumerate(range(0, rooms, long)):
        count = min(long, rooms - first)
        y = row // 2 * (2 * DEPTH + CORRIDOR) + (DEPTH + CORRIDOR) * (row % 2)
        ends = np.concatenate([[0.0], np.cumsum(rng.uniform(*WIDTHS, count))])
        width = max(width, float(ends[-1]))
        walls += [_line((x, y), (x, y + DEPTH)) for x in ends]
        inner, outer = (y + DEPTH, y) if row % 2 == 0 else (y, y + DEPTH)
        walls.append(_line((0.0, outer), (ends[-1], outer)))
        for left, right in pairwise(ends.tolist()):
            at = left + rng.uniform(0.3, right - left - DOOR - 0.3)
            walls += [_line((left, inner), (at, inner)), _line((at + DOOR, inner), (right, inner))]
    flat = np.concatenate(walls)
    high = float(flat[:, 1].max())
    floor = np.stack(np.meshgrid(np.arange(0, width, EDGE), np.arange(0, high, EDGE), indexing="ij"), axis=-1).reshape(-1, 2)
    levels = np.arange(EDGE / 2, WALL, EDGE)
    up = np.column_stack([np.repeat(flat, len(levels), axis=0), np.tile(levels, len(flat))])
    return up, np.column_stack([floor, np.full(len(floor), -EDGE / 2)])


def _line(start: tuple[float, float], end: tuple[float, float]) -> Array:
    """Return points (n, 2) on a wall, two a cell."""
    count = max(int(np.hypot(end[0] - start[0], end[1] - start[1]) / EDGE * 2), 2)
    return np.linspace(start, end, count)


def wave_points(points: Array) -> Array:
    """Return the points moved by waves that are long and low: drift without a jump."""
    out = points.copy()
    for k, turn in enumerate((1.0, 0.6)):
        phase = points[:, :2] @ (np.cos(turn + k), np.sin(turn + k)) * 2 * np.pi / (BEND_LENGTH * (1 + k))
        out[:, k] += BEND_SIZE * np.sin(phase)
    return out


def build_cells(points: Array) -> VoxelGrid:
    """Build the occupied cells of points."""
    low = points.min(axis=0) - EDGE
    return VoxelGrid.from_cells(np.unique(np.floor((points - low) / EDGE).astype(np.int32), axis=0), low, EDGE)


def build_problem(rooms: int) -> Problem:
    """Record the problem that bending solves when a storey of so many rooms meets a bent copy of itself."""
    points = np.concatenate(storey(rooms))
    maps = [prepare(g) for g in (build_cells(points), build_cells(POSE.inverse().apply(wave_points(points))))]
    problems: list[Problem] = []

    def noted(anchors: Array, joints: Joints, measured: Measurements, prior: Array) -> Any:
        problems.append((anchors, joints, measured, prior))
        return settle(anchors, joints, measured, prior)

    usual, original = get_sensor_drift("depth"), alignments.settle
    alignments.settle = noted  # type: ignore[attr-defined]
    try:
        settle_all(Alignment(maps, (Sim3(), POSE), [(0, 1)], False), [usual, usual])
    finally:
        alignments.settle = original  # type: ignore[attr-defined]
    anchors, joints, measured, prior = problems[len(WINDOWS) - 1]
    rows, most = np.arange(len(measured.piece)), measured.shares.argmax(axis=1)
    single = replace(measured, others=measured.others[rows, most][:, None], shares=np.ones((len(rows), 1)))
    return anchors, joints, single, prior


def compute_effect(place: Array) -> Array:
    """Return (3, 3) what a small motion of the plane is at a place: shift there and turn."""
    return np.array([[1.0, 0.0, -place[1]], [0.0, 1.0, place[0]], [0.0, 0.0, 1.0]])


def solve_with_gtsam(gtsam: Any, given: Problem) -> Array:
    """Return (n, 3) shift and turn of each piece at its anchor."""
    anchors, joints, measured, prior = given
    graph, start, sure = gtsam.NonlinearFactorGraph(), gtsam.Values(), []

    def add(factor: Callable[[Any], Any], place: Array, information: Array, certain: bool) -> None:
        effect = compute_effect(place)
        if certain:
            sure.append(graph.size())
        graph.add(factor(gtsam.noiseModel.Gaussian.Information(effect.T @ information @ effect)))

    for k, (anchor, sigma) in enumerate(zip(anchors, prior[:, :3], strict=True)):
        start.insert(k, gtsam.Pose2())
        certain = np.diag(1 / np.maximum(sigma, 1e-4) ** 2)
        add(lambda noise, k=k: gtsam.PriorFactorPose2(k, gtsam.Pose2(), noise), anchor, certain, True)  # type: ignore[misc]
    for (i, j), sigma in zip(joints.pieces.tolist(), joints.sigma[:, :3], strict=True):
        between = lambda noise, i=i, j=j: gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(), noise)  # noqa: E731
        add(between, anchors[[i, j]].mean(axis=0), np.diag(1 / sigma**2), True)
    for k, piece in enumerate(measured.piece.tolist()):
        place, move, other = measured.places[k], measured.moves[k], int(measured.others[k, 0])
        motion = gtsam.Pose2.Expmap(np.linalg.solve(compute_effect(place), move))
        link = lambda noise, o=other, p=piece, m=motion: gtsam.BetweenFactorPose2(o, p, m, noise)  # noqa: E731
        add(link, place, measured.information[k] + 1e-6 * np.eye(3), False)
    params = gtsam.GncGaussNewtonParams(gtsam.GaussNewtonParams())
    params.setLossType(gtsam.GncLossType.GM)
    params.setKnownInliers(sure)
    optimizer = gtsam.GncGaussNewtonOptimizer(graph, start, params)
    optimizer.setInlierCostThresholds(OUTLIER / 2)
    solved = optimizer.optimize()
    poses = [solved.atPose2(k) for k in range(len(anchors))]
    return np.array([[*(p.transformFrom(a) - a), p.theta()] for p, a in zip(poses, anchors, strict=True)])


def time_bending(solve: Callable[[], Array]) -> tuple[Array, float]:
    """Run a solver several times; return its moves and the median of its seconds."""
    seconds = []
    for _ in range(RUNS):
        watch = Stopwatch()
        moves = solve()
        seconds.append(watch.elapsed)
    return moves, float(np.median(seconds))


def main(*rooms: str) -> None:
    """Print a line for each number of rooms."""
    try:
        import gtsam
    except ImportError as error:
        raise InputError("this comparison needs GTSAM: pip install gtsam") from error
    print("rooms | pieces | measurements | apart: median, most mm | GTSAM's time over ours")
    for number in map(int, rooms or ROOMS):
        given = build_problem(number)
        ours, seconds = time_bending(lambda given=given: settle(*given).moves)  # type: ignore[misc]
        theirs, others = time_bending(lambda given=given: solve_with_gtsam(gtsam, given))  # type: ignore[misc]
        apart = 1000 * np.linalg.norm(ours[:, :2] - theirs[:, :2], axis=1)
        sizes = f"{number} | {len(ours)} | {len(given[2].piece)}"
        print(f"{sizes} | {np.median(apart):.1f}, {apart.max():.1f} | {others / seconds:.1f}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
