"""From the columns of plans back to cells: the floor of all storeys, cut into rooms (beyond the thesis)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from topomerge.extraction.completeness import measure_seen_outline
from topomerge.extraction.plans.passages import Pair
from topomerge.extraction.plans.plan import locate_columns
from topomerge.extraction.plans.storey_plan import Floor, Merge, StoreyPlan
from topomerge.extraction.segment import PartitionedStorey
from topomerge.kernels import run_side_by_side
from topomerge.types import Array, VoxelGrid, are_within, select_lowest_of_column

WALL_REACH = 0.5  # m: so far into walls and what stands before them the cells of a room go
OVER_CEILING = 0.4  # m
UNDER_FLOOR = 0.25  # m
FLOOR_PROPERTIES = ("standing", "storey", "room", "area")


def build_floor(
    grid: VoxelGrid, navigable: VoxelGrid, storey: Array, storeys: Array, cut: Sequence[PartitionedStorey], factor: int
) -> Floor:
    """Return the floor of all storeys, its rooms and areas numbered from storey to storey.

    Args:
        grid: occupied cells.
        navigable: the navigable volume.
        storey: (m,) storey of each of its cells.
        storeys: (S,) STOREY_DTYPE; gets the areas, and loses those without a room.
        cut: the storeys that were cut into rooms, lowest first.
        factor: how many times longer the columns of their plans are than the cells.
    """
    label = np.full(len(grid), -1, np.int32)
    cells, properties, room_of_area, seen = [], [], [], []
    probability: dict[Pair, float] = {}
    merges: list[Merge] = []
    rooms = areas = 0
    # Each storey by itself; what several claim is the last one's, whatever the number of threads.
    laid = run_side_by_side(
        lambda part: (
            *_select_floor_cells(part, navigable, storey == part.number, factor),
            *_find_labels(grid, part.plan, part.room, factor),
        ),
        cut,
    )
    for part, (places, at, standing, rows, own) in zip(cut, laid, strict=True):
        room = np.where(part.room >= 0, part.room + rooms, -1)
        area = np.where(part.area >= 0, part.area + areas, -1)
        label[rows] = own + rooms
        cells.append(places)
        properties.append((standing, np.full(len(places), part.number), room[tuple(at.T)], area[tuple(at.T)]))
        probability |= {(a + rooms, b + rooms): p for (a, b), p in part.door_probability.items()}
        merges += [(a + areas, b + areas, p) for a, b, p in part.merges]
        room_of_area.append(part.room_of_area + rooms)
        seen.append(measure_seen_outline(part.room, part.plan.inside, part.plan.wall, part.plan.edge))
        rooms, areas = rooms + int(part.room.max(initial=-1)) + 1, areas + len(part.room_of_area)
    if not cut:
        empty = np.zeros(0, np.int32)
        return Floor(grid.replace_cells(np.zeros((0, 3), np.int32)), storeys, empty, empty, empty, empty, label)
    tables = dict(zip(FLOOR_PROPERTIES, map(np.concatenate, zip(*properties, strict=True)), strict=True))
    floor, storeys, of_cell = join_floor(grid, storeys, np.concatenate(cells), tables)
    return Floor(
        floor,
        storeys,
        of_cell["storey"],
        of_cell["room"],
        of_cell["area"],
        np.concatenate(room_of_area).astype(np.int32),
        label,
        door_probability=probability,
        merges=tuple(merges),
        completeness=np.concatenate(seen),
        classified_storeys=tuple(part.classes for part in cut),
        plans=tuple(part.plan for part in cut),
    )


def _find_labels(grid: VoxelGrid, plan: StoreyPlan, room: Array, factor: int) -> tuple[Array, Array]:
    """Return the rows of the occupied cells of a storey that have a room, and (k,) that of their column; walls go to the nearest
    room."""
    far, nearest = ndimage.distance_transform_edt(room < 0, return_indices=True)
    room = np.where(far * plan.edge <= WALL_REACH, room[tuple(nearest)], -1)
    rows, column = find_cells_of_storey(grid, plan, room, factor)
    return rows, room[tuple(column.T)]


def find_cells_of_storey(grid: VoxelGrid, plan: StoreyPlan, room: Array, factor: int) -> tuple[Array, Array]:
    """Return the rows of the occupied cells between floor and ceiling of a storey, in columns that have a room (nx, ny), and (k,
    2) these.

    Args:
        factor: how many times longer the columns are than the cells.
    """
    low, base = locate_columns(plan, grid)
    at = (grid.cells // factor if factor > 1 else grid.cells)[:, :2].astype(np.int64) - low
    rows = np.flatnonzero(are_within(at, 0, room.shape))
    at = at[rows]
    ceiling, above = (np.broadcast_to(height, room.shape)[tuple(at.T)] for height in (plan.ceiling, plan.top))
    z = (grid.cells[rows, 2] // factor - base[tuple(at.T)]) * plan.edge
    top = np.minimum(np.where(np.isnan(ceiling), np.inf, ceiling + OVER_CEILING), above + 0.5 * plan.edge)
    in_storey = (z >= -UNDER_FLOOR) & (z <= top) & (room[tuple(at.T)] >= 0)
    return rows[in_storey], at[in_storey]


def _select_floor_cells(
    part: PartitionedStorey, navigable: VoxelGrid, in_storey: Array, factor: int
) -> tuple[Array, Array, Array]:
    """Return the cells of a storey's floor, the column of the plan in which each lies, and whether somebody can stand there.

    These are its navigable cells, and below furniture all cells of a column of the plan at the level of its floor.
    """
    room = part.room
    low, base = locate_columns(part.plan, navigable)
    cells = navigable.cells[in_storey]
    at = (cells // factor)[:, :2].astype(np.int64) - low
    in_plan = are_within(at, 0, room.shape)
    at, cells = at[in_plan], cells[in_plan]
    columns = np.argwhere(room >= 0)
    walked = np.zeros(room.shape, bool)
    walked[tuple(at.T)] = True
    hidden = columns[~walked[tuple(columns.T)]]
    corners = np.column_stack([hidden + low, base[tuple(hidden.T)]]) * factor
    steps = np.argwhere(np.ones((factor, factor, 1), bool))
    standing = np.repeat([True, False], [len(cells), len(corners) * len(steps)])
    cells = np.concatenate([cells, (corners[:, None] + steps).reshape(-1, 3)])
    return cells, np.concatenate([at, np.repeat(hidden, len(steps), axis=0)]), standing


def join_floor(
    grid: VoxelGrid, storeys: Array, cells: Array, tables: dict[str, Array]
) -> tuple[VoxelGrid, Array, dict[str, Array]]:
    """Return the floor cells of all rooms as one grid.

    Args:
        storeys: (S,) STOREY_DTYPE; the areas are written.
        cells: (m, 3) of all storeys' floors.
        tables: `FLOOR_PROPERTIES`, (m,) each.

    Returns:
        The cells with the property `standing`, the storeys that have a room, and storey, room and area of each cell.
    """
    in_grid = are_within(cells, 0, grid.shape)
    floor = grid.replace_cells(cells[in_grid], {name: values[in_grid] for name, values in tables.items()})
    of_cell = {name: values.astype(np.int32) for name, values in floor.properties.items()}
    of_rooms = of_cell["room"] >= 0
    of_cell = {name: values[of_rooms] for name, values in of_cell.items()}
    floor = grid.replace_cells(floor.cells[of_rooms], {"standing": of_cell["standing"].astype(bool)})
    storeys["area"] = np.bincount(of_cell["storey"][select_lowest_of_column(floor)], minlength=len(storeys)) * floor.edge**2
    used = np.bincount(of_cell["storey"], minlength=len(storeys)) > 0  # what has no room is no storey: a ceiling's upper side
    of_cell["storey"] = np.maximum(np.cumsum(used) - 1, 0)[of_cell["storey"]].astype(np.int32)
    return floor, storeys[used], of_cell
