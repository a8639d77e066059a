"""Warnings about points that look wrong: another unit, another axis that is up, degrees for metres."""

from __future__ import annotations

import numpy as np

from topomerge.io.frame import describe_rounding, get_axis_rotation
from topomerge.types import Array

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
    """Are x and y longitude and latitude, and only z a length?"""
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
