"""The plans of a map's storeys with its rooms on them, on one raster of the map's cells."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from topomerge.extraction.plans import storey_plan
from topomerge.extraction.plans.storey_plan import HEIGHT_BANDS, WALL_RULE, StoreyPlan
from topomerge.kernels.rasters import compute_column_bits
from topomerge.matching.poses import PlanFields
from topomerge.types import Array, TopometricMap

DIRECTION_BLUR = 1.5  # cells, before the direction of walls is measured


@dataclass(frozen=True, eq=False)
class RoomPlans:
    """The S storeys of a map, lowest first, on one raster (nx, ny).

    Args:
        plans: one a storey, all of the same columns.
        label: (S, nx, ny) int32 room whose navigable floor it is, -1 none.
        footprint: (S, nx, ny) int32 room that anything in the column belongs to, -1 none.
    """

    plans: tuple[StoreyPlan, ...]
    label: Array
    footprint: Array

    @property
    def origin(self) -> Array:
        """(2,) m, corner of the raster."""
        return self.plans[0].origin

    @property
    def edge(self) -> float:
        """m, of a column."""
        return self.plans[0].edge

    @cached_property
    def floors(self) -> Array:
        """(S,) m, height of each storey's floor."""
        return np.array([plan.levels[0] for plan in self.plans])

    @cached_property
    def walls(self) -> Array:
        """(S, nx, ny) bool."""
        return np.stack([plan.wall for plan in self.plans])

    @cached_property
    def fields(self) -> tuple[PlanFields, ...]:
        """Return the fields of each storey by which poses are refined."""
        return tuple(PlanFields(plan) for plan in self.plans)

    @cached_property
    def distance(self) -> Array:
        """(S, nx, ny) float32, m to the nearest wall column of the storey; 1,000 where it has none."""
        distance = np.full(self.walls.shape, np.float32(1e3))
        for s, walls in enumerate(self.walls):
            if walls.any():
                distance[s] = ndimage.distance_transform_edt(~walls) * self.edge
        return distance

    @cached_property
    def floor(self) -> Array:
        """(S, nx, ny) bool: known to be free."""
        return self.label >= 0

    @cached_property
    def areas(self) -> Array:
        """(R,) m2 of each room's footprint; rooms after the last one that has any are left out."""
        return np.bincount(self.footprint[self.footprint >= 0]) * self.edge**2

    @cached_property
    def middle(self) -> Array:
        """(3,) m, of the columns of which anything is known, on the lowest floor."""
        explored = np.argwhere((self.walls | self.floor).any(axis=0))
        middle = explored.mean(axis=0) + 0.5 if len(explored) else np.array(self.walls.shape[1:]) / 2
        return np.append(self.origin + middle * self.edge, self.floors[0])

    @cached_property
    def direction(self) -> tuple[float, float]:
        """Direction of the walls in [0, pi/2) and how much they keep to it and its normal: 0 all ways, 1 none other."""
        total, weight = 0j, 0.0
        for walls in self.walls:
            image = ndimage.gaussian_filter(walls.astype(np.float32), DIRECTION_BLUR)
            slope = ndimage.sobel(image, 0) + 1j * ndimage.sobel(image, 1)
            size = np.abs(slope)
            total += complex((size * np.exp(4j * np.angle(slope)))[size > 0].sum())
            weight += float(size.sum())
        return float(np.angle(total) / 4 % (np.pi / 2)), abs(total) / max(weight, 1e-9)

    def sample_columns(self, number: int) -> tuple[Array, Array, Array, Array]:
        """Sample up to `number` wall columns and as many of the floor, evenly spread: places (n, 2), storey, whether it is a
        wall, and (2,) how many columns of walls and of floor each sample stands for."""
        parts, each = [], np.zeros(2)
        for k, raster in enumerate((self.walls, self.floor)):
            columns = np.flatnonzero(raster)
            chosen = columns[np.linspace(0, len(columns) - 1, min(number, len(columns))).astype(int)] if len(columns) else columns
            each[k] = len(columns) / max(len(chosen), 1)
            storey, x, y = np.unravel_index(chosen, raster.shape)
            parts.append((self.origin + (np.stack([x, y], axis=1) + 0.5) * self.edge, storey, np.full(len(x), k == 0)))
        places, storey, is_wall = (np.concatenate(p) for p in zip(*parts, strict=True))
        return places, storey.astype(np.int64), is_wall, each


def build_room_plans(map: TopometricMap) -> RoomPlans:
    """Return the plans of a map's storeys, with its rooms."""
    grid, nav = map.grid, map.navigable
    shape = (len(map.storeys), *grid.shape[:2])
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
    plans = tuple(_build_storey_plan(map, s, label[s] >= 0) for s in range(shape[0]))
    return RoomPlans(plans, label, np.where(label >= 0, label, footprint))


def _build_storey_plan(map: TopometricMap, storey: int, navigable: Array) -> StoreyPlan:
    """Return the plan of a storey; its inside is its navigable floor (nx, ny)."""
    grid, levels = map.grid, (float(map.storeys["floor"][storey]), float(map.storeys["ceiling"][storey]))
    floor = np.full(navigable.shape, levels[0])
    ix, iy = np.ascontiguousarray(grid.cells[:, :2].T.astype(np.int64))
    z = grid.origin[2] + (grid.cells[:, 2] + 0.5) * grid.edge
    profile = compute_column_bits(ix, iy, z, floor, -HEIGHT_BANDS.below * HEIGHT_BANDS.step, HEIGHT_BANDS.step)
    filled = storey_plan.build_band_stack(profile, HEIGHT_BANDS, storey_plan.WALL_HEIGHTS)
    wall = storey_plan.detect_wall_columns(filled[storey_plan.is_observed_band(filled)], WALL_RULE)
    ceiling = np.full(navigable.shape, levels[1] - levels[0])
    return StoreyPlan(grid.origin[:2], grid.edge, wall, navigable & ~wall, profile, HEIGHT_BANDS, floor, ceiling, levels=levels)
