"""A storey as a robot sees it: which pixels are free to drive over, which are occupied, which nobody knows; and its walls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from topomerge.errors import InputError
from topomerge.types import Array, TopometricMap

OBSTACLE_BAND = (0.2, 1.8)  # m above the floor beside it: what is occupied there is in the way; lintels and thresholds are not
CUT = (1.0, 1.9)  # m above the floor: what fills most of this band is a wall
BAND_SHARE = 0.5  # share of the band that must be occupied
STEEP = (0.5, 0.2)  # m across, m up: a floor that rises so much is stairs, or the edge of a platform
NEVER = np.iinfo(np.int32).max
LARGEST_OCCUPANCY = 50_000_000  # pixels of a storey: 700 m by 700 m of 10 cm, 2 GB while it is made


@dataclass(frozen=True, eq=False)
class Occupancy:
    """Pixels over a storey: pixel (i, j) covers x from low[0] + i * size, y from low[1] + j * size."""

    low: Array  # (2,) m, in the input's frame
    size: float  # m
    free: Array  # (nx, ny) bool
    occupied: Array  # (nx, ny) bool
    wall: Array  # (nx, ny) bool
    room: Array  # (nx, ny) int32 room whose floor it is, -1 none

    def centre(self, pixel: Array) -> Array:
        """(..., 2) middle of pixels, m."""
        middle: Array = self.low + (np.asarray(pixel) + 0.5) * self.size
        return middle

    def window(self, box: tuple[slice, ...]) -> Occupancy:
        """A part of it."""
        low = self.low + self.size * np.array([side.start for side in box])
        return Occupancy(low, self.size, self.free[box], self.occupied[box], self.wall[box], self.room[box])


def storey_occupancy(map: TopometricMap, storey: int) -> Occupancy:
    """The pixels of one storey; each is as large as a cell of the map.

    Raises:
        InputError: the storey spans more than `LARGEST_OCCUPANCY` pixels.

    Free is the floor one walks on (also floor of no room) without anything above it at the height of a robot; stairs count as
    occupied.
    """
    edge = map.navigable.edge
    rows = _floor_rows(map, storey)
    cells = _cells_near(map, rows)
    both = np.concatenate([map.navigable.cells[rows], cells])[:, :2]
    first = both.min(axis=0, initial=NEVER) - 1 if len(both) else np.zeros(2, np.int64)
    nx, ny = (both.max(axis=0, initial=0) - first + 2).tolist()
    if nx * ny > LARGEST_OCCUPANCY:
        size = f"{nx * edge:,.0f} by {ny * edge:,.0f} m"
        raise InputError(f"storey {storey} spans {size} in cells of {edge:g} m: too much for a grid; extract with larger cells")
    level, room = _levels(map, rows, first, (nx, ny))
    walked = level < NEVER
    if walked.any():  # beside the floor, heights are told from the nearest piece of it
        level = level[tuple(ndimage.distance_transform_edt(~walked, return_distances=False, return_indices=True))]
    i, j = (cells[:, :2] - first).T
    above = cells[:, 2] - level[i, j]
    filled = [_count((i, j), above, band, edge, (nx, ny)) for band in (OBSTACLE_BAND, CUT)]
    occupied = (filled[0] > 0) | (walked & _steep(level, walked, edge))
    wall = filled[1] >= max(BAND_SHARE * (CUT[1] - CUT[0]) / edge, 1)
    return Occupancy(map.navigable.origin[:2] + first * edge, edge, walked & ~occupied, occupied, wall, room)


def _floor_rows(map: TopometricMap, storey: int) -> Array:
    """Rows of the navigable cells of a storey: of its rooms, and those of no room that are nearest to its floor."""
    label = map.navigable_room
    of = np.full(len(label), -1)
    inside = label >= 0
    of[inside] = map.rooms["storey"][label[inside]]
    if len(map.storeys) and not inside.all():
        z = map.navigable.centroids()[~inside, 2]
        of[~inside] = np.abs(z[:, None] - map.storeys["floor"]).argmin(axis=1)
    return np.flatnonzero(of == storey)


def _cells_near(map: TopometricMap, rows: Array) -> Array:
    """(n, 3) int64 occupied cells from the lowest floor to a person's height over the highest, in the floor's lattice."""
    if not len(rows):
        return np.empty((0, 3), np.int64)
    points, z = map.grid.centroids(), map.navigable.centroids()[rows, 2]
    near = (points[:, 2] > z.min() - map.navigable.edge) & (points[:, 2] < z.max() + CUT[1] + map.navigable.edge)
    return map.navigable.locate(points[near])


def _levels(map: TopometricMap, rows: Array, first: Array, shape: tuple[int, int]) -> tuple[Array, Array]:
    """(nx, ny) int32 lowest navigable cell of each column, NEVER where there is none; and its room."""
    level, room = np.full(shape, NEVER, np.int32), np.full(shape, -1, np.int32)
    order = rows[np.argsort(-map.navigable.cells[rows, 2], kind="stable")]  # the lowest one is written last
    i, j = (map.navigable.cells[order, :2] - first).T
    level[i, j] = map.navigable.cells[order, 2]
    room[i, j] = map.navigable_room[order]
    return level, room


def _count(at: tuple[Array, Array], above: Array, band: tuple[float, float], edge: float, shape: tuple[int, int]) -> Array:
    """(nx, ny) number of cells in a band of heights above the floor."""
    low, high = max(round(band[0] / edge), 1), max(round(band[1] / edge), 2)
    there = (above >= low) & (above < high)
    count = np.zeros(shape, np.int32)
    np.add.at(count, (at[0][there], at[1][there]), 1)
    return count


def _steep(level: Array, walked: Array, edge: float) -> Array:
    """(nx, ny) bool: floor that rises like stairs. `level` is known everywhere."""
    if not walked.any():
        return walked
    wide = 2 * max(round(STEEP[0] / edge) // 2, 1) + 1
    level = ndimage.median_filter(level, 3)  # a cell too high is noise
    rise = ndimage.maximum_filter(level, wide) - ndimage.minimum_filter(level, wide)
    steep = np.pad(rise * edge >= STEEP[1] - 1e-6, wide)
    return np.asarray(ndimage.binary_closing(steep, np.ones((wide, wide)))[wide:-wide, wide:-wide])  # treads, too
