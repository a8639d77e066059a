"""Time and memory of `register` against the size of the maps: 10, 100 and 1,000 rooms.

``python -m benchmarks.speed.merge_growth [rooms ...]``: a floor of corridors with rooms of many widths on both sides, drawn as
cells; two maps of three quarters of it each, one of them turned. Each size runs in a process of its own; its peak memory is
printed.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence

import numpy as np

from topomerge.registration.pipeline import register
from topomerge.types import Array, Sim3, VoxelGrid

CELL_EDGE, CEILING_CELLS = 0.1, 27  # m, cells from floor to ceiling
SIZES = (10, 100, 1000)  # rooms
ROW = 20  # rooms along one side of a corridor
TURNED_POSE = Sim3(0.7, (12.3, -4.1, 0.2))


def draw_floor_plan(rooms: int, seed: int = 0) -> tuple[Array, Array]:
    """Return (H, W) bool: walls, and where doors are cut into them."""
    rng = np.random.default_rng(seed)
    corridors = max(round(rooms / (2 * ROW)), 1)
    each = min(ROW, max(rooms // 2, 1))
    width = each * 42 + 60
    wall, door = np.zeros((width, corridors * 130 + 2), bool), np.zeros((width, corridors * 130 + 2), bool)
    for c in range(corridors):
        y = c * 130
        for line in (0, 55, 75, 130):
            wall[:, y + line : y + line + 2] = True
        for low, high, front in ((0, 55, 55), (75, 130, 75)):
            ends = np.cumsum(rng.integers(28, 56, each))
            ends = (ends * (width - 4) / ends[-1]).astype(int)
            for start, end in zip(np.append(0, ends[:-1]), ends, strict=True):
                wall[end : end + 2, y + low : y + high] = True
                at = int(rng.integers(start + 6, end - 14))
                door[at : at + 9, y + front : y + front + 2] = True
    wall[:2] = wall[-2:] = True
    return wall, door


def build_cells(wall: Array, door: Array) -> Array:
    """Return (n, 3) cells of floor, ceiling and walls with open doors under lintels."""
    x, y = np.indices(wall.shape).reshape(2, -1)
    level = [np.column_stack([x, y, np.full(x.size, z)]) for z in (0, CEILING_CELLS)]
    up = np.arange(CEILING_CELLS)
    at, over = np.argwhere(wall & ~door), np.argwhere(wall & door)
    walls = np.column_stack([np.repeat(at, CEILING_CELLS, axis=0), np.tile(up, len(at))])
    lintels = np.column_stack([np.repeat(over, 6, axis=0), np.tile(up[-6:], len(over))])
    return np.concatenate([*level, walls, lintels]).astype(np.int64)


def build_two_maps(rooms: int) -> tuple[VoxelGrid, VoxelGrid, Array]:
    """Build two maps of three quarters of a floor each, of which the second one is turned; and its points (n, 3), m."""
    wall, door = draw_floor_plan(rooms)
    cells = build_cells(wall, door)
    quarter = wall.shape[0] // 4
    a = VoxelGrid.from_cells(cells[cells[:, 0] < 3 * quarter], np.zeros(3), CELL_EDGE)
    points = TURNED_POSE.apply((cells[cells[:, 0] > quarter] + 0.5) * CELL_EDGE)
    base = np.floor(points.min(axis=0) / CELL_EDGE).astype(np.int64)
    b = VoxelGrid.from_cells(np.unique(np.floor(points / CELL_EDGE).astype(np.int64) - base, axis=0), base * CELL_EDGE, CELL_EDGE)
    return a, b, points


def measure(rooms: int) -> None:
    """Measure one size."""
    import resource

    a, b, points = build_two_maps(rooms)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    began = time.process_time()
    registration = register(a, b)
    seconds = time.process_time() - began
    middle = points.mean(axis=0)[None]
    off = float("nan")
    if registration.transform is not None:
        off = float(np.linalg.norm(registration.transform.apply(middle) - TURNED_POSE.inverse().apply(middle)))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    steps = ", ".join(f"{k} {v:.2f}" for k, v in registration.seconds.items())
    outcome = f"p {registration.probability:.2f} | off {off:.2f} m"
    size = f"{rooms} rooms | {(len(a) + len(b)) / 1e6:.1f} M cells"
    print(f"{size} | {seconds:.1f} s | {peak:.0f} MB ({before:.0f} before) | {outcome} | {steps}")


def main(rooms: Sequence[int] = SIZES) -> None:
    """Print a line for each size, measured in a process of its own."""
    for number in rooms:
        subprocess.run([sys.executable, "-m", "benchmarks.speed.merge_growth", "one", str(number)], check=True)


if __name__ == "__main__":
    if len(sys.argv) == 3 and sys.argv[1] == "one":
        measure(int(sys.argv[2]))
    else:
        main([int(number) for number in sys.argv[1:]] or SIZES)
