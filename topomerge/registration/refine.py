"""Fine registration under gravity: point-to-plane with yaw and translation only (method 4; Chen and Medioni 1991)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from topomerge.extraction.cleaning import compute_cell_means
from topomerge.kernels import registration
from topomerge.types import Array, Sim3, VoxelGrid

SURFACE_BLOCK = 2  # cells
REFINE_STAGES = ((2, 0.2), (1, 0.1), (1, 0.06))  # blocks in which partners are looked for, and sigma of the robust weights, m
STAGE_ROUNDS = 8  # of each stage at most
MOVED_POINTS = 6_000  # points that are moved
LEAST_FLATNESS = 0.6  # points of less flat neighbourhoods have no plane
LEAST_PARTNERS = 50  # partners, below which nothing is refined
STILL_STEP = (1e-4, 1e-5)  # m, rad: a smaller step ends a stage


@dataclass(frozen=True)
class Refined:
    """A refined pose, the root mean square distance between planes, m, and the share of b's flat points that have a partner."""

    pose: Sim3
    rmse: float
    partners: float


@dataclass(frozen=True, eq=False)
class Surface:
    """Points, one a block of `SURFACE_BLOCK` cells a side, with the normals of their planes. Rows are those of the grid."""

    grid: VoxelGrid
    points: Array
    normals: Array
    flat: Array


def build_surface(grid: VoxelGrid) -> Surface:
    """Build blocks of cells, their mean points, and normals from the cells within two of the block's first one."""
    points = compute_cell_means(grid)
    coarse = grid.cells // SURFACE_BLOCK
    blocks = VoxelGrid.from_cells(coarse, grid.origin, grid.edge * SURFACE_BLOCK)
    owner = blocks.find_rows(coarse)
    sizes = np.bincount(owner, minlength=len(blocks))
    middle = np.column_stack([np.bincount(owner, points[:, k], len(blocks)) / sizes for k in range(3)])
    gap = ((points - middle[owner]) ** 2).sum(axis=1)
    nearest = np.full(len(blocks), np.inf)
    np.minimum.at(nearest, owner, gap)
    first = np.full(len(blocks), -1, np.int64)
    at = np.flatnonzero(gap <= nearest[owner])
    first[owner[at]] = at
    direction, flat = registration.estimate_normals(*grid._bricks, grid.cells, np.ascontiguousarray(points), first, 2, 6)
    return Surface(blocks, np.ascontiguousarray(middle), direction, flat)


def refine_pose(
    a: Surface, b: Surface, start: Sim3, scaled: bool = False, stages: Sequence[tuple[int, float]] = REFINE_STAGES
) -> Refined:
    """Return T_ab that brings b's surfaces onto a's, from a start that is right to a few decimetres.

    Slices have vertical planes only: what the planes do not fix (the height) stays as it was.
    """
    rows = np.flatnonzero(b.flat >= LEAST_FLATNESS)
    if len(rows) > MOVED_POINTS:
        rows = _sample_points(b, rows)
    middle = b.points[rows].mean(axis=0) if len(rows) else np.zeros(3)
    moving, direction = np.ascontiguousarray(b.points[rows] - middle), np.ascontiguousarray(b.normals[rows])
    pose = np.array([*start.apply(middle[None])[0], start.yaw, np.log(start.scale)])
    fixed = (*a.grid._bricks, a.grid.origin, a.grid.edge, a.points, a.normals, moving, direction)
    rmse, share = float("nan"), 0.0
    for reach, sigma in stages:
        for _ in range(STAGE_ROUNDS):
            h, g, partners, weight, square = registration.build_normal_equations(*fixed, pose, reach, sigma, scaled)
            if partners < LEAST_PARTNERS:
                return Refined(start, float("nan"), partners / max(len(rows), 1))
            rmse, share = float(np.sqrt(square / weight)), partners / len(rows)
            step = _solve_step(h, g, weight, scaled)
            pose = pose + step
            if np.abs(step[:3]).max() < STILL_STEP[0] and abs(step[3]) < STILL_STEP[1]:
                break
    turn = Sim3((pose[3] + np.pi) % (2 * np.pi) - np.pi, (0.0, 0.0, 0.0), float(np.exp(pose[4])))
    x, y, z = (pose[:3] - turn.apply(middle[None])[0]).tolist()
    return Refined(Sim3(float(turn.yaw), (x, y, z), turn.scale), rmse, share)


def _sample_points(b: Surface, rows: Array) -> Array:
    """Return a sample that has as many upright planes as level ones: floors fix the height only."""
    level = np.abs(b.normals[rows, 2]) > 0.7
    rng = np.random.default_rng(0)
    chosen = [rng.permutation(rows[mask])[: MOVED_POINTS * part // 4] for mask, part in ((level, 1), (~level, 3))]
    return np.sort(np.concatenate(chosen))


def _solve_step(h: Array, g: Array, weight: float, scaled: bool) -> Array:
    """Solve for the step; a weak pull to stay keeps what the planes do not fix."""
    free = 5 if scaled else 4
    step = np.zeros(5)
    hold = np.diag([1e-3, 1e-3, 1e-3, 1e-2, 1e-2][:free]) * weight
    step[:free] = np.linalg.solve(h[:free, :free] + hold, -g[:free])
    step[:3] = np.clip(step[:3], -0.15, 0.15)
    step[3:] = np.clip(step[3:], -0.02, 0.02)
    return step
