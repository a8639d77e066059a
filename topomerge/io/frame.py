"""From a file's frame and unit into ours: z up, metres, float32 about a float64 shift; and warnings where points look wrong:
another unit, another axis that is up, degrees for metres."""

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
        scaled = np.asarray(points, np.float64)
        scaled = scaled if factor == 1 else scaled * factor
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


LARGE, HIGH = 2000.0, 100.0  # m, extents beyond what is scanned as one building
SLAB_THICKNESS, STOREY_HEIGHT, MOST_SLAB_CELLS = 0.1, 4.5, 1 << 26  # m; m; cells that are marked, 64 MB: more are sorted
LOWEST_ROOM, HIGHEST_ROOM = 2.0, 3.6  # m, usual heights of a room
DEGREES_ACROSS, DEGREES_AWAY = 0.1, 1.0  # degrees: 11 km, no building is as wide; from 0, 0, which lies in the sea
DEGREES_TALLER = 20.0  # times as tall (m) as across (degrees): no building in metres is
JUDGED_POINTS = 200  # points below which nothing is judged


def warn_about(points: Array, up: str | None) -> list[str]:
    """Warn about a sample of placed points (n, 3) that look wrong.

    Args:
        points: (n, 3), metres, z up.
        up: the axis of the file that was taken as up; None where the format states its own unit and up axis.
    """
    if len(points) < JUDGED_POINTS:
        return []
    low, high = np.percentile(points, (1, 99), axis=0)
    if up is None:
        return _check_unit(high - low, ())
    units = (("mm", 0.001), ("cm", 0.01))
    rounded = describe_rounding(points)
    return rounded or _check_degrees(low, high) or _check_unit(high - low, units) or _check_up_axis(points, low, high, up)


def _check_degrees(low: Array, high: Array) -> list[str]:
    """Return a warning where x and y are longitude and latitude, and only z is a length."""
    across, tall = float((high - low)[:2].max()), float(high[2] - low[2])
    on_earth = bool((np.abs((low, high))[:, :2] <= 180.0).all() and (np.abs((low, high))[:, :2].min(axis=1) <= 90.0).all())
    if not (0 < across <= DEGREES_ACROSS and tall >= DEGREES_TALLER * across and on_earth):
        return []
    if np.hypot(*low[:2]) < DEGREES_AWAY:
        return []
    x, y = (f"{axis} {low[k]:.5f} to {high[k]:.5f}" for k, axis in enumerate("xy"))
    return [f"coordinates look like degrees of longitude and latitude ({x}, {y}): project them to metres first, as to UTM"]


def _check_unit(extent: Array, units: tuple[tuple[str, float], ...]) -> list[str]:
    size = " x ".join(f"{e:.4g}" for e in extent)
    check = "check --unit and --scale" if units else "check --scale and --resolution"
    across, tall = float(extent[:2].max()), float(extent[2])
    if across > LARGE or tall > HIGH:
        for unit, factor in units:
            if 1.5 <= tall * factor <= 400 and 1.5 <= across * factor <= LARGE:
                name = {"mm": "millimetres", "cm": "centimetres"}[unit]
                return [f"coordinates look like {name} (extent {size}): give --unit {unit}"]
        return [f"extent of {size} m is beyond any building: {check}"]
    if max(across, tall) < 0.5:
        return [f"extent of {size} m is smaller than any room: {check}"]
    return []


def _check_up_axis(points: Array, low: Array, high: Array, up: str) -> list[str]:
    scores = compute_flatness(points, low, high)
    best = int(np.argmax(scores))
    tall, narrow = high[2] - low[2], float((high - low)[:2].min())
    # A corridor seen without floor and ceiling is flat across its walls too, but it is not taller than a storey; a shaft or
    # a tower is, but flat across both pairs of its walls.
    second = sorted(scores)[1]
    clear = scores[best] >= max(0.12, 1.8 * second) or scores[best] >= max(0.08, 2.5 * second)
    if STOREY_HEIGHT <= tall <= 2 * STOREY_HEIGHT and not clear and LOWEST_ROOM <= narrow <= HIGHEST_ROOM:
        return [f"{tall:.1f} m tall, but only {narrow:.1f} m wide: if another axis than {up} is up in this file, give --up"]
    if best == 2 or not clear or tall < STOREY_HEIGHT:
        return []
    axis = "xyz"[int(np.abs(get_axis_rotation(up)[best]).argmax())]
    return [
        f"floors and ceilings seem to lie across {axis}, not {up} ({scores[best]:.0%} of the surface lies flat in "
        f"{axis}, {scores[2]:.0%} in {up}): if {axis} is up in this file, give --up {axis}"
    ]


def compute_flatness(points: Array, low: Array, high: Array) -> list[float]:
    """Return share of the surface that lies in the strongest slab across x, y and z; the surface is counted in occupied cells."""
    inside = points[((points >= low - SLAB_THICKNESS) & (points <= high + SLAB_THICKNESS)).all(axis=1)]
    cells = np.floor((inside - inside.min(axis=0)) / SLAB_THICKNESS).astype(np.int64)
    nx, ny, nz = (int(n) for n in cells.max(axis=0) + 1)
    codes = (cells[:, 0] * ny + cells[:, 1]) * nz + cells[:, 2]
    if few := nx * ny * nz <= MOST_SLAB_CELLS:
        occupied = np.zeros(nx * ny * nz, bool)
        occupied[codes] = True
    codes = np.flatnonzero(occupied) if few else np.unique(codes)
    slabs = (codes // (ny * nz), codes // nz % ny, codes % nz)
    return [float(np.convolve(np.bincount(s), (1, 1)).max() / len(codes)) for s in slabs]
