"""What a robot draws of a part of a building: the grid of a 2D laser's map, its cells raised as those of a file are."""

from __future__ import annotations

import numpy as np
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs.flat import from_masks, labelled, raise_flat, storey_of
from topomerge.datasets.simulation.scanner import scan
from topomerge.datasets.simulation.sensors import Sensor

from topomerge.types import Array, PointCloud, Sim3

GRID_CELL = 0.05  # m
GRID_RAYS = 120_000  # of the whole walk
LEAST_HITS = 0.25  # share of the rays in a cell that end there, from which on it is occupied
GRID_MARGIN = 1.0  # m about what was seen
SAMPLES_AT_ONCE = 2_000_000


def robot_grid(
    building: Building, laser: Sensor, rooms: Array, rng: np.random.Generator, frame: Sim3, cleared: float = np.inf
) -> PointCloud:
    """The map that a robot makes of the rooms that it drives through, in a frame, with the true rooms of its points.

    Args:
        laser: sees one line.
        cleared: m of each ray that the robot believes: what it met farther away is not drawn, what it crossed before is free.

    Raises:
        InputError: as `scan`.
    """
    cloud = scan(building, laser, rooms, rng, budget=GRID_RAYS, frame=frame)
    assert cloud.poses is not None and cloud.pose_of is not None
    starts, ends = cloud.poses[cloud.pose_of, :2, 3], cloud.points[:, :2].astype(np.float64)
    length = np.hypot(*(ends - starts).T)
    met = length <= cleared
    ends = np.where(met[:, None], ends, starts + (ends - starts) * np.minimum(cleared / np.maximum(length, 1e-9), 1)[:, None])
    occupied, free, corner = counted_rays(starts, ends, met)
    flat = from_masks(occupied[::-1], free[::-1], GRID_CELL, (*corner.tolist(), 0.0), source=f"{building.name}:grid")
    height = float(cloud.poses[0, 2, 3]) - frame.scale * laser.height
    return labelled(raise_flat(flat, height), cloud.rooms, storey_of(building, rooms))


def counted_rays(starts: Array, ends: Array, met: Array | None = None) -> tuple[Array, Array, Array]:
    """(rows, columns) bool of occupied and of free cells of `GRID_CELL`, and the corner (2,) m of the first: a cell is occupied
    where at least `LEAST_HITS` of the rays that come to it end (occupancy grids: Elfes 1989), else free where any crosses it.

    Args:
        starts, ends: (n, 2) m.
        met: (n,) bool, did the ray meet something at its end? None: all did.
    """
    corner = np.floor((np.minimum(starts.min(axis=0), ends.min(axis=0)) - GRID_MARGIN) / GRID_CELL) * GRID_CELL
    top = np.maximum(starts.max(axis=0), ends.max(axis=0)) + GRID_MARGIN
    columns, rows = np.ceil((top - corner) / GRID_CELL).astype(int).tolist()

    def cell(points: Array) -> Array:
        x, y = np.floor((points - corner) / GRID_CELL).astype(np.int64).T
        return np.asarray(y * columns + x)

    hits = np.bincount(cell(ends if met is None else ends[met]), minlength=rows * columns)
    crossed = np.zeros(rows * columns, np.int64)
    steps = np.ceil(np.hypot(*(ends - starts).T) / GRID_CELL).astype(int)
    limits = np.searchsorted(np.cumsum(steps), np.arange(SAMPLES_AT_ONCE, steps.sum() + SAMPLES_AT_ONCE, SAMPLES_AT_ONCE))
    first = 0
    for last in np.unique(np.minimum(limits + 1, len(steps))).tolist():
        count = steps[first:last]
        ray = np.repeat(np.arange(first, last), count)
        share = (np.arange(len(ray)) - np.repeat(np.cumsum(count) - count, count)) / steps[ray]
        crossed += np.bincount(cell(starts[ray] + share[:, None] * (ends - starts)[ray]), minlength=rows * columns)
        first = last
    occupied = hits >= np.maximum(LEAST_HITS * (hits + crossed), 1)
    return occupied.reshape(rows, columns), ((crossed > 0) & ~occupied).reshape(rows, columns), corner
