"""A map seen from above, storey by storey: walls, floor and rooms on a raster of the map's cells."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from topomerge.types import Array, TopometricMap

BANDS = np.linspace(0.5, 2.0, 7)  # m above the floor
WALL_BANDS = 4  # of six that must hold something: tables and cupboards reach fewer
FEWEST = 30  # wall columns; below, whatever stands in a band is taken (slices of a laser)
BLUR = 1.5  # cells, before the direction of walls is measured


@dataclass(frozen=True, eq=False)
class TopDown:
    """Args:
    origin: (2,) m, corner of the raster; edge: m of a cell.
    floors: (S,) m, height of each storey's floor.
    walls: (S, nx, ny) bool.
    label: (S, nx, ny) int32 room whose navigable floor it is, -1 none.
    footprint: (S, nx, ny) int32 room that anything in the column belongs to, -1 none.
    """

    origin: Array
    edge: float
    floors: Array
    walls: Array
    label: Array
    footprint: Array

    @cached_property
    def distance(self) -> Array:
        """(S, nx, ny) float32, m to the nearest wall column of the storey."""
        return self._nearest[0]

    @cached_property
    def _nearest(self) -> tuple[Array, Array]:
        distance = np.full(self.walls.shape, np.float32(1e3))
        index = np.zeros((2, *self.walls.shape), np.int32)
        for s, walls in enumerate(self.walls):
            if walls.any():
                d, index[:, s] = ndimage.distance_transform_edt(~walls, return_indices=True)
                distance[s] = d * self.edge
        return distance, index

    def nearest_wall(self, places: Array, storey: Array) -> tuple[Array, Array]:
        """(n, 2) middle of the wall column nearest to each place (n, 2) on its storey (n,), and (n,) the distance of the place's
        cell from it, m: 1,000 outside the raster or on storey -1."""
        cell = np.floor((places - self.origin) / self.edge).astype(np.int64)
        inside = (cell >= 0).all(axis=1) & (cell < self.walls.shape[1:]).all(axis=1) & (storey >= 0)
        at = (storey[inside], *cell[inside].T)
        distance, index = self._nearest
        target, away = np.zeros(places.shape), np.full(len(places), 1e3)
        target[inside] = self.origin + (index[(slice(None), *at)].T + 0.5) * self.edge
        away[inside] = distance[at]
        return target, away

    @cached_property
    def floor(self) -> Array:
        """(S, nx, ny) bool: known to be free."""
        return self.label >= 0

    @cached_property
    def areas(self) -> Array:
        """(R,) m2 of each room's footprint; rooms after the last one that has any are left out."""
        return np.bincount(self.footprint[self.footprint >= 0]) * self.edge**2

    @cached_property
    def direction(self) -> tuple[float, float]:
        """Direction of the walls in [0, pi/2) and how much they keep to it and its normal: 0 all ways, 1 none other."""
        total, weight = 0j, 0.0
        for walls in self.walls:
            image = ndimage.gaussian_filter(walls.astype(np.float32), BLUR)
            slope = ndimage.sobel(image, 0) + 1j * ndimage.sobel(image, 1)
            size = np.abs(slope)
            total += complex((size * np.exp(4j * np.angle(slope)))[size > 0].sum())
            weight += float(size.sum())
        return float(np.angle(total) / 4 % (np.pi / 2)), abs(total) / max(weight, 1e-9)

    def samples(self, number: int) -> tuple[Array, Array, Array, Array]:
        """Up to `number` wall columns and as many of the floor, evenly spread: places (n, 2), storey, is it a wall?, and (2,) how
        many columns of walls and of floor each sample stands for."""
        parts, each = [], np.zeros(2)
        for k, raster in enumerate((self.walls, self.floor)):
            found = np.flatnonzero(raster)
            chosen = found[np.linspace(0, len(found) - 1, min(number, len(found))).astype(int)] if len(found) else found
            each[k] = len(found) / max(len(chosen), 1)
            storey, x, y = np.unravel_index(chosen, raster.shape)
            parts.append((self.origin + (np.stack([x, y], axis=1) + 0.5) * self.edge, storey, np.full(len(x), k == 0)))
        places, storey, is_wall = (np.concatenate(p) for p in zip(*parts, strict=True))
        return places, storey.astype(np.int64), is_wall, each


def top_down(map: TopometricMap) -> TopDown:
    """The rasters of a map."""
    grid, nav = map.grid, map.navigable
    floors = map.storeys["floor"].astype(float)
    shape = (len(floors), *grid.shape[:2])
    walls = np.zeros(shape, bool)
    z = grid.origin[2] + (grid.cells[:, 2] + 0.5) * grid.edge
    for s, floor in enumerate(floors):
        band = np.digitize(z - floor, BANDS) - 1
        rows = np.flatnonzero((band >= 0) & (band < len(BANDS) - 1))
        held = np.zeros((*shape[1:], len(BANDS) - 1), bool)
        held[grid.cells[rows, 0], grid.cells[rows, 1], band[rows]] = True
        number = held.sum(axis=2)
        walls[s] = number >= WALL_BANDS
        if walls[s].sum() < FEWEST:
            walls[s] = number > 0
    label = np.full(shape, -1, np.int32)
    shift = np.round((nav.origin - grid.origin) / grid.edge).astype(int)[:2]
    rows = np.flatnonzero(map.navigable_room >= 0)
    room = map.navigable_room[rows]
    x, y = (nav.cells[rows, :2] + shift).T
    fits = (x >= 0) & (y >= 0) & (x < shape[1]) & (y < shape[2])
    label[map.rooms["storey"][room[fits]], x[fits], y[fits]] = room[fits]
    footprint = np.full(shape, -1, np.int32)
    rows = np.flatnonzero(map.room >= 0)
    room = map.room[rows]
    footprint[map.rooms["storey"][room], grid.cells[rows, 0], grid.cells[rows, 1]] = room
    return TopDown(grid.origin[:2], grid.edge, floors, walls, label, np.where(label >= 0, label, footprint))
