"""Rooms from the plans of the storeys: regions between doors, carried back to the cells (beyond the thesis)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from topomerge.extraction.completeness import outline_seen
from topomerge.extraction.components import spread_labels
from topomerge.extraction.plans.door_classifier import door_probability
from topomerge.extraction.plans.partition import Pair, merge_regions
from topomerge.extraction.plans.passages import clearance_of, find_passages, regions_of
from topomerge.extraction.plans.plan import columns_of, storey_plan
from topomerge.extraction.plans.plan_network import Told, segment, without_furniture
from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.extraction.rooms import Floor
from topomerge.extraction.storeys import find_storeys, floor_to_ceiling, lowest_of_column
from topomerge.kernels.columns import hollow_below
from topomerge.types import Array, VoxelGrid

PLAN_CELL = 0.1  # m: finer grids are looked at with about this
WALL_REACH = 0.5  # m: so far into walls and what stands before them the cells of a room go
OVER_CEILING = 0.4  # m
UNDER_FLOOR = 0.25  # m
LEAST_ROOM = 0.8  # m2
LEAST_HALF_WIDTH = 0.35  # m: what is nowhere wider is the edge of a facade or of a slab
DOORWAY = 0.5  # m: so far the navigable volume goes on into what looks like wall: the openings of noisy scans
SHEET = 0.2  # m: thinner than a floor that carries somebody
HEADROOM, HIGHEST = 1.2, 8.0  # m of empty space under a ceiling: at least, at most
SLAB = 0.15  # m: a thinner one parts no storeys
OPEN_ALL_AROUND = 0.25  # share of the outline with walls, and of the floor with a ceiling: less, and a floor may be a ceiling


def rooms_of_plans(grid: VoxelGrid, navigable: VoxelGrid, door: float, narrow: float, body_height: float) -> Floor:
    """Cut every storey into rooms.

    Args:
        grid: occupied cells.
        navigable: the navigable volume.
        door: narrowings with at least this probability of a door part rooms.
        narrow: those with at least this one part areas of a room.
        body_height: m, whatever is lower than this above the floor is no ceiling.
    """
    storeys, storey = find_storeys(navigable, floor_to_ceiling(grid, navigable, body_height))
    factor = max(round(PLAN_CELL / grid.edge), 1)
    coarse, walk, level = grid, navigable, storey
    if factor > 1:
        coarse = grid.coarser(factor)
        walk = navigable.coarser(factor)
        row = walk.rows(navigable.cells // factor)
        level = np.full(len(walk), np.iinfo(np.int32).max, np.int32)
        np.minimum.at(level, row, storey)
    label = np.full(len(grid), -1, np.int32)
    parts: list[tuple[Array, ...]] = []
    owners: list[Array] = []
    seen: list[Array] = []
    told: list[Told] = []
    probability: dict[Pair, float] = {}
    rooms = areas = 0
    for k in range(int(storey.max(initial=-1)) + 1):
        if not (level == k).any() or _upper_side(storeys[k], storeys[:k]):
            continue
        plan = storey_plan(coarse, walk, level, k)
        chance = segment(plan)
        plan = without_furniture(plan, chance)
        low, base = columns_of(plan, coarse)
        corner = coarse.origin + np.append(low, np.median(base)) * plan.edge
        told.append(Told(chance, corner[:2], plan.edge, float(corner[2])))
        room, area, owner, doors = _partition(coarse, plan, chance, door, narrow, k > 0)
        _label_cells(label, grid, plan, np.where(room >= 0, room + rooms, -1), factor)
        parts.append(_cells_of(plan, navigable, storey == k, room, area, factor, k, rooms, areas))
        probability |= {(a + rooms, b + rooms): p for (a, b), p in doors.items()}
        owners.append(owner + rooms)
        seen.append(outline_seen(room, plan.inside, plan.wall, plan.edge))
        rooms, areas = rooms + int(room.max(initial=-1)) + 1, areas + len(owner)
    floor = _floor(grid, storeys, parts, owners, label, probability)
    return replace(floor, completeness=np.concatenate(seen), told=tuple(told)) if seen else floor


def _partition(
    grid: VoxelGrid, plan: StoreyPlan, chance: Array, door: float, narrow: float, above_another: bool
) -> tuple[Array, Array, Array, dict[Pair, float]]:
    """Room and area of each column (numbered from 0), room of each area, and how likely doors part two rooms."""
    clearance = clearance_of(plan)
    region = regions_of(plan, chance)
    if above_another:
        region = _without_ceilings(grid, plan, region)
    found = merge_regions(
        region, clearance, find_passages(plan, clearance, region, chance), plan.edge, door_probability, door, narrow, LEAST_ROOM
    )
    size = np.bincount(found.room[region[region >= 0]], minlength=len(found.room)) * plan.edge**2
    widest = np.zeros(len(size))
    np.maximum.at(widest, found.room[region[region >= 0]], clearance[region >= 0])
    large = np.flatnonzero((size >= LEAST_ROOM) & (widest >= LEAST_HALF_WIDTH))
    number = np.full(len(size) + 1, -1)
    number[large] = np.arange(len(large))
    room_of = np.append(number[found.room], -1)
    kept_areas, area_of = np.unique(np.where(room_of[:-1] >= 0, found.area, -1), return_inverse=True)
    if len(kept_areas) and kept_areas[0] < 0:
        kept_areas, area_of = kept_areas[1:], area_of - 1
    doors = {(int(number[a]), int(number[b])): p for (a, b), p in found.probability.items() if number[a] >= 0 and number[b] >= 0}
    return room_of[region], np.append(area_of, -1)[region], room_of[kept_areas], {(min(k), max(k)): p for k, p in doors.items()}


def _upper_side(top: Array, below: Array) -> bool:
    """Is a storey with nothing above it the ceiling of one below? A floor lies a slab above that."""
    return bool(np.isnan(top["ceiling"]) and (np.abs(below["ceiling"] - top["floor"]) < SLAB).any())


def _without_ceilings(grid: VoxelGrid, plan: StoreyPlan, region: Array) -> Array:
    """The regions of an upper storey less those that are the upper side of a ceiling: nothing above, and either no walls around
    or so thin that nobody is carried, with a storey right below."""
    count = int(region.max(initial=-1)) + 1
    known = region >= 0
    total = np.maximum(np.bincount(region[known], minlength=count), 1)
    covered = np.bincount(region[known], ~np.isnan(plan.clear[known]), minlength=count) / total
    walled = ndimage.binary_dilation(plan.wall, np.ones((5, 5)))
    outline = known & ndimage.binary_dilation(~plan.inside, np.ones((3, 3)))
    length = np.maximum(np.bincount(region[outline], minlength=count), 1)
    beside = np.bincount(region[outline], walled[outline], minlength=count) / length
    suspect = covered < OPEN_ALL_AROUND
    if not suspect.any():
        return region
    at = np.argwhere(known & suspect[np.where(known, region, 0)])
    low, base = columns_of(plan, grid)
    cells = np.column_stack([at + low, base[tuple(at.T)]])
    hollow = hollow_below(*grid._bricks, cells, 1, *(round(height / grid.edge) for height in (SHEET, HEADROOM, HIGHEST)))
    thin = np.bincount(region[tuple(at.T)], hollow, minlength=count) > 0.5 * total
    ceiling = suspect & (thin | (beside < OPEN_ALL_AROUND))
    return np.where(known & ceiling[np.where(known, region, 0)], -1, region)


def _label_cells(label: Array, grid: VoxelGrid, plan: StoreyPlan, room: Array, factor: int) -> None:
    """Give the occupied cells of a storey the room of their column; walls go to the nearest room."""
    far, nearest = ndimage.distance_transform_edt(room < 0, return_indices=True)
    room = np.where(far * plan.edge <= WALL_REACH, room[tuple(nearest)], -1)
    low, base = columns_of(plan, grid)
    at = (grid.cells // factor if factor > 1 else grid.cells)[:, :2].astype(np.int64) - low
    rows = np.flatnonzero(((at >= 0) & (at < room.shape)).all(axis=1))
    at = at[rows]
    ceiling, above = (np.broadcast_to(height, room.shape)[tuple(at.T)] for height in (plan.ceiling, plan.top))
    z = (grid.cells[rows, 2] // factor - base[tuple(at.T)]) * plan.edge
    top = np.minimum(np.where(np.isnan(ceiling), np.inf, ceiling + OVER_CEILING), above + 0.5 * plan.edge)
    mine = (z >= -UNDER_FLOOR) & (z <= top) & (room[tuple(at.T)] >= 0)
    label[rows[mine]] = room[tuple(at[mine].T)]


def _cells_of(
    plan: StoreyPlan, navigable: VoxelGrid, mine: Array, room: Array, area: Array, factor: int, k: int, rooms: int, areas: int
) -> tuple[Array, ...]:
    """Cells, standing, storey, room and area of a storey's floor."""
    corner, base = columns_of(plan, navigable)
    at = (navigable.cells[mine] // factor)[:, :2].astype(np.int64) - corner
    inside = ((at >= 0) & (at < room.shape)).all(axis=1)
    at = at[inside]
    walk = navigable.cells[mine][inside]
    columns = np.argwhere(room >= 0)
    seen = np.zeros(room.shape, bool)
    seen[tuple(at.T)] = True
    under = columns[~seen[tuple(columns.T)]]
    low = np.column_stack([under + corner, base[tuple(under.T)]]) * factor
    steps = np.argwhere(np.ones((factor, factor, 1), bool))
    low = (low[:, None] + steps).reshape(-1, 3)
    cells = np.concatenate([walk, low])
    at = np.concatenate([at, np.repeat(under, len(steps), axis=0)])
    r, a = room[tuple(at.T)], area[tuple(at.T)]
    standing = np.arange(len(cells)) < len(walk)
    return cells, standing, np.full(len(cells), k), np.where(r >= 0, r + rooms, -1), np.where(a >= 0, a + areas, -1)


def _floor(
    grid: VoxelGrid,
    storeys: Array,
    parts: list[tuple[Array, ...]],
    owners: list[Array],
    label: Array,
    probability: dict[Pair, float],
) -> Floor:
    if not parts:
        empty = np.zeros(0, np.int32)
        return Floor(grid.with_cells(np.zeros((0, 3), np.int32)), storeys, empty, empty, empty, empty, label)
    cells, standing, storey, room, area = (np.concatenate(c) for c in zip(*parts, strict=True))
    ok = ((cells >= 0) & (cells < grid.shape)).all(axis=1)
    tables = {"standing": standing[ok], "storey": storey[ok], "room": room[ok], "area": area[ok]}
    whole = grid.with_cells(cells[ok], tables)
    of = {name: values.astype(np.int32) for name, values in whole.properties.items()}
    in_a_room = of["room"] >= 0
    of["room"] = spread_labels(whole, of["room"], round(DOORWAY / grid.edge)).astype(np.int32)
    of["area"] = spread_labels(whole, of["area"], round(DOORWAY / grid.edge)).astype(np.int32)
    kept = (of["room"] >= 0) & (in_a_room | of["standing"].astype(bool))
    of = {name: values[kept] for name, values in of.items()}
    floor = grid.with_cells(whole.cells[kept], {"standing": of["standing"].astype(bool)})
    storeys["area"] = np.bincount(of["storey"][lowest_of_column(floor)], minlength=len(storeys)) * floor.edge**2
    # What has no room of its own is no storey: the upper side of a ceiling, or stray cells that a room below reaches.
    used = np.bincount(of["storey"][in_a_room[kept]], minlength=len(storeys)) > 0
    storeys, of["storey"] = storeys[used], np.maximum(np.cumsum(used) - 1, 0)[of["storey"]].astype(np.int32)
    return Floor(
        floor, storeys, of["storey"], of["room"], of["area"], np.concatenate(owners).astype(np.int32), label, 0.0, probability
    )
