"""Rooms of plans: every storey seen from above is parted at its doors (beyond the thesis: docs/adr/0004)."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.floor import Floor
from topomerge.extraction.plans.storey_floor import floor_of_storeys
from topomerge.extraction.plans.storey_rooms import NO_SIGNS, OtherSigns, cut_storey, look_at
from topomerge.extraction.storeys import find_storeys, floor_to_ceiling
from topomerge.types import Array, VoxelGrid

PLAN_CELL = 0.1  # m: finer grids are looked at with about this
THINNEST_SLAB = 0.15  # m: a thinner one parts no storeys


def rooms_of_plans(
    grid: VoxelGrid, navigable: VoxelGrid, door: float, narrow: float, body_height: float, others: OtherSigns = NO_SIGNS
) -> Floor:
    """Cut every storey into rooms.

    Args:
        grid: occupied cells.
        navigable: the navigable volume.
        door: narrowings with at least this probability of a door part rooms.
        narrow: those with at least this one part areas of a room.
        body_height: m, whatever is lower than this above the floor is no ceiling.
        others: what else speaks for where rooms part.
    """
    storeys, storey = find_storeys(navigable, floor_to_ceiling(grid, navigable, body_height))
    factor = max(round(PLAN_CELL / grid.edge), 1)
    coarse_grid, coarse_floor, coarse_storey = _coarser(grid, navigable, storey, factor)
    numbers = [k for k in range(len(storeys)) if (coarse_storey == k).any() and not _is_upper_side(storeys[k], storeys[:k])]
    looks = others.looked_at or [look_at(coarse_grid, coarse_floor, coarse_storey, k, others) for k in numbers]
    cut = [cut_storey(coarse_grid, look, k, door, narrow, others) for look, k in zip(looks, numbers, strict=True)]
    return floor_of_storeys(grid, navigable, storey, storeys, cut, factor)


def _coarser(grid: VoxelGrid, navigable: VoxelGrid, storey: Array, factor: int) -> tuple[VoxelGrid, VoxelGrid, Array]:
    """Both grids with cells `factor` times as long, and the storey of each navigable one: the lowest of those in it."""
    if factor == 1:
        return grid, navigable, storey
    coarse = navigable.coarser(factor)
    coarse_storey = np.full(len(coarse), np.iinfo(np.int32).max, np.int32)
    np.minimum.at(coarse_storey, coarse.rows(navigable.cells // factor), storey)
    return grid.coarser(factor), coarse, coarse_storey


def _is_upper_side(top: Array, below: Array) -> bool:
    """Is a storey with nothing above it the ceiling of one below? A floor lies a slab above that."""
    return bool(np.isnan(top["ceiling"]) and (np.abs(below["ceiling"] - top["floor"]) < THINNEST_SLAB).any())
