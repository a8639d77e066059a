"""What registration and bending need of a map, made when it is first needed and once only."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from topomerge.fusion.bend.drift import Drift, map_drift
from topomerge.fusion.bend.local import samples
from topomerge.fusion.bend.pieces import Pieces, pieces_of
from topomerge.fusion.bend.surfaces import PieceSurfaces
from topomerge.fusion.cell_means import cell_middles
from topomerge.fusion.refine import Surface, surface
from topomerge.fusion.storey_plan import plans
from topomerge.matching.plan_fields import PlanFields
from topomerge.types import Array, TopometricMap, VoxelGrid

Map = TopometricMap | VoxelGrid


@dataclass(frozen=True, eq=False)
class Prepared:
    """A map with what is drawn from it.

    Args:
        map: topometric, or occupied cells.
        storeys: their plans, lowest first.
        order: larger maps come first; among equal ones the order is arbitrary, but always the same.
    """

    map: Map
    storeys: tuple[PlanFields, ...]
    order: tuple[int, str]

    @property
    def grid(self) -> VoxelGrid:
        """Its occupied cells."""
        return grid_of(self.map)

    @cached_property
    def middle(self) -> Array:
        """(3,) of its cells, m."""
        middle: Array = cell_middles(self.grid).mean(axis=0)
        return middle

    @cached_property
    def surface(self) -> Surface:
        """Its points and normals, for the fine registration."""
        return surface(self.grid)

    @cached_property
    def drift(self) -> Drift:
        """How much its sensor goes astray."""
        return map_drift(self.map)

    @cached_property
    def pieces(self) -> Pieces:
        """The pieces that it is bent by."""
        return pieces_of(self.storeys, self.map if isinstance(self.map, TopometricMap) else None)

    @cached_property
    def samples(self) -> tuple[Array, Array]:
        """The walls by which each piece is registered."""
        return samples(self.pieces)

    @cached_property
    def piece_surfaces(self) -> PieceSurfaces:
        """The surface points of each piece."""
        floors = np.array([s.plan.floor_guess for s in self.storeys])
        storey = np.searchsorted(floors + 0.3, self.surface.points[:, 2]) - 1
        return PieceSurfaces(self.pieces, self.surface, storey)


def prepare(map: Map, free: VoxelGrid | None = None) -> Prepared:
    """Plans of a map, with what is drawn from them when it is first needed.

    Args:
        free: cells known to be empty; a topometric map brings its own.

    Raises:
        InputError: an empty map.
    """
    return Prepared(map, tuple(PlanFields(p) for p in plans(map, free)), registration_order(map))


def grid_of(map: Map) -> VoxelGrid:
    """The occupied cells of a map."""
    return map.grid if isinstance(map, TopometricMap) else map


def registration_order(map: Map) -> tuple[int, str]:
    """Larger maps come first; among equal ones the order is arbitrary, but always the same."""
    grid = grid_of(map)
    digest = hashlib.sha256(np.ascontiguousarray(grid.cells).tobytes() + grid.origin.tobytes()).hexdigest()
    return -len(grid), digest
