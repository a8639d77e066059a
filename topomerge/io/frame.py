"""From a file's frame and unit into ours: z up, metres, float32 about a float64 shift."""

from __future__ import annotations

import numpy as np

from topomerge.types import Array, TrueRoom, VoxelGrid

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254}
FLOAT32_REACH = 1e4  # m from the origin from where float32 would lose millimetres
FLOAT_STEPS = 2.0**22  # of a 32-bit float lie between 0 and a value, at least
COARSE_STEP, FINER, FEWEST_STEPS = 0.1, 4.0, 8  # m; times as fine is another axis; so many are no walls along an axis
MOST_STEPS = 1e6  # between neighbouring values
ROUNDING_SAMPLE = 20_000  # points in which roundings are looked for

# Right-handed turns that bring the named axis of the file up. Rows are the new axes in terms of the old ones.
TURNS = {
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "x": ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-x": ((0, 1, 0), (0, 0, -1), (-1, 0, 0)),
}


def get_axis_rotation(up: str) -> Array:
    """Return (3, 3) float64 rotation that brings axis `up` of the file to +z."""
    return np.array(TURNS[up], np.float64)


def transform_points(points: Array, rotation: Array, factor: float) -> Array:
    """Return (n, 3) float64 points in metres, z up."""
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = np.asarray(points, np.float64) * factor
        if np.array_equal(rotation, np.eye(3)):
            return scaled
        # A product with the matrix would spread one axis's nan and inf to all; the turn only swaps axes and signs.
        axes = np.abs(rotation).argmax(axis=1)
        return scaled[:, axes] * rotation.sum(axis=1)


def transform_poses(poses: Array, rotation: Array, factor: float) -> Array:
    """Return (K, 4, 4) float64 sensor poses in the placed frame."""
    placed = np.array(poses, np.float64)
    placed[:, :3, :3] = rotation @ placed[:, :3, :3]
    placed[:, :3, 3] = factor * placed[:, :3, 3] @ rotation.T
    return placed


def transform_grid(grid: VoxelGrid, rotation: Array, factor: float) -> VoxelGrid:
    """Return the same cells in the placed frame; a turn by right angles keeps cells cells."""
    axes, signs = np.abs(rotation).argmax(axis=1), rotation.sum(axis=1)
    cells, shape = grid.cells[:, axes], np.asarray(grid.shape)[axes]
    low, high = grid.bounds
    origin = np.where(signs > 0, low[axes], -high[axes]) * factor
    cells = np.where(signs > 0, cells, shape - 1 - cells)
    nx, ny, nz = (int(s) for s in shape)
    return VoxelGrid.from_cells(cells, origin, grid.edge * factor, (nx, ny, nz), grid.properties)


def scale_rooms(rooms: tuple[TrueRoom, ...], factor: float) -> tuple[TrueRoom, ...]:
    """Return true rooms in metres. Formats that know rooms have z up, so nothing is turned."""
    if factor == 1.0:
        return rooms
    return tuple(TrueRoom(r.name, r.polygon * factor, r.floor * factor, r.ceiling * factor, r.storey, r.kind) for r in rooms)


def choose_shift(points: Array) -> Array:
    """Choose (3,) float64 shift for finite points (n, 3): zero near the origin, else their middle in whole 100 m.

    The median, not the first point: one stray first point must not cost all the others their precision.
    """
    if not len(points) or float(np.abs(points).max()) <= FLOAT32_REACH:
        return np.zeros(3)
    return np.round(np.median(points, axis=0) / 100.0) * 100.0


def describe_rounding(points: Array) -> list[str]:
    """Warn of an axis whose coordinates are rounded, as 32-bit floats are far from the origin: half a metre at 5,000 km.

    Their steps are powers of two. Voxels are as coarse along all axes; what is rounded along one alone has lost its digits.

    Args:
        points: (n, 3), m.
    """
    steps = [_measure_step(values) for values in points[:: len(points) // ROUNDING_SAMPLE + 1].T]
    worst = int(np.argmax(steps[:2]))
    if steps[worst] < COARSE_STEP or steps[worst] < FINER * min(steps) or abs(np.log2(steps[worst]) % 1 - 0.5) < 0.499:
        return []
    if np.abs(points[:, worst]).max() < FLOAT_STEPS * steps[worst]:  # a raster of the scanner's own
        return []
    return [
        f"{'xy'[worst]} is rounded to {steps[worst]:.3g} m, as 32-bit floats are far from the origin: export the points again as "
        "64-bit floats, as text with all digits, or nearer to the origin"
    ]


def _measure_step(values: Array) -> float:
    """Measure the step, m, of which all values are multiples apart; 0: there is none, or too few of them."""
    levels = np.unique(values)
    if len(levels) < FEWEST_STEPS:
        return 0.0
    gaps = np.diff(levels)
    if gaps.max() > MOST_STEPS * gaps.min():
        return 0.0
    counts = gaps / gaps.min()
    return float(gaps.min()) if np.abs(counts - np.round(counts)).max() < 0.01 else 0.0
