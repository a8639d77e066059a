"""Is this cloud in metres with z up? Warnings for people; nothing is ever changed here."""

from __future__ import annotations

import numpy as np

from topomerge.io.frame import turn
from topomerge.types import Array

LARGE, HIGH = 2000.0, 100.0  # m, extents beyond what is scanned as one building
SLAB_THICKNESS = 0.1  # m
STOREY_HEIGHT = 4.5  # m
LOWEST_ROOM, HIGHEST_ROOM = 2.0, 3.6  # m, usual heights of a room
DEGREES_ACROSS = 0.1  # degrees, 11 km: no scan of a building is as wide
DEGREES_TALLER = 20.0  # times as tall (m) as across (degrees): no building in metres is
DEGREES_AWAY = 1.0  # degrees from 0, 0, which lies in the sea
JUDGED_POINTS = 200  # points below which nothing is judged


class Sample:
    """A thinned copy of all points seen so far, of bounded size."""

    def __init__(self, limit: int = 400_000) -> None:
        self.limit = limit
        self.step = 1
        self.parts: list[Array] = []

    def add(self, points: Array) -> None:
        """Take every `step`-th of the (n, 3) points."""
        self.parts.append(np.array(points[:: self.step], np.float64))
        while sum(len(p) for p in self.parts) > self.limit:
            self.step *= 2
            self.parts = [p[::2] for p in self.parts]

    @property
    def points(self) -> Array:
        """(n, 3) float64."""
        return np.concatenate(self.parts) if self.parts else np.empty((0, 3))


def warn_about(points: Array, up: str | None) -> list[str]:
    """What looks wrong with a sample of placed points (n, 3).

    Args:
        points: (n, 3), metres, z up.
        up: the axis of the file that was taken as up; None where the format states its own unit and up axis.
    """
    if len(points) < JUDGED_POINTS:
        return []
    low, high = np.percentile(points, (1, 99), axis=0)
    if up is None:
        return _unit_warning(high - low, ())
    units = (("mm", 0.001), ("cm", 0.01))
    return _degrees_warning(low, high) or _unit_warning(high - low, units) or _up_warning(points, low, high, up)


def _degrees_warning(low: Array, high: Array) -> list[str]:
    """Are x and y longitude and latitude, and only z a length?"""
    across, tall = float((high - low)[:2].max()), float(high[2] - low[2])
    on_earth = bool((np.abs((low, high))[:, :2] <= 180.0).all() and (np.abs((low, high))[:, :2].min(axis=1) <= 90.0).all())
    if not (0 < across <= DEGREES_ACROSS and tall >= DEGREES_TALLER * across and on_earth):
        return []
    if np.hypot(*low[:2]) < DEGREES_AWAY:
        return []
    x, y = (f"{axis} {low[k]:.5f} to {high[k]:.5f}" for k, axis in enumerate("xy"))
    return [f"coordinates look like degrees of longitude and latitude ({x}, {y}): project them to metres first, as to UTM"]


def _unit_warning(extent: Array, units: tuple[tuple[str, float], ...]) -> list[str]:
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


def _up_warning(points: Array, low: Array, high: Array, up: str) -> list[str]:
    scores = flatness(points, low, high)
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
    axis = "xyz"[int(np.abs(turn(up)[best]).argmax())]
    return [
        f"floors and ceilings seem to lie across {axis}, not {up} ({scores[best]:.0%} of the surface lies flat in "
        f"{axis}, {scores[2]:.0%} in {up}): if {axis} is up in this file, give --up {axis}"
    ]


def flatness(points: Array, low: Array, high: Array) -> list[float]:
    """Share of the surface that lies in the strongest slab across x, y and z; the surface is counted in occupied cells."""
    inside = points[((points >= low - SLAB_THICKNESS) & (points <= high + SLAB_THICKNESS)).all(axis=1)]
    cells = np.floor((inside - inside.min(axis=0)) / SLAB_THICKNESS).astype(np.int64)
    ny, nz = (int(n) for n in cells.max(axis=0)[1:] + 1)
    codes = np.unique((cells[:, 0] * ny + cells[:, 1]) * nz + cells[:, 2])
    slabs = (codes // (ny * nz), codes // nz % ny, codes % nz)
    return [float(np.convolve(np.bincount(s), (1, 1)).max() / len(codes)) for s in slabs]
