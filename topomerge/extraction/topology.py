"""The topometric map of floors cut into rooms (seeds 2.7), and its doors, openings and stairs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import edt
import numpy as np
from scipy import ndimage

from topomerge.extraction.completeness import measure_completeness
from topomerge.extraction.convolution import build_sphere
from topomerge.extraction.morphology import label_components
from topomerge.extraction.plans.storey_plan import Floor
from topomerge.extraction.storeys import estimate_ceiling_height, measure_floor_to_ceiling
from topomerge.extraction.zones import compute_merge_levels
from topomerge.kernels.rasters import count_steps
from topomerge.types import (
    AREA_DTYPE,
    EDGE_DTYPE,
    ROOM_DTYPE,
    Array,
    TopometricMap,
    VoxelGrid,
    compute_extent,
    select_lowest_of_column,
)

# Where two rooms meet: doors, openings and stairs (seeds 2.7).

LEVEL_KINDS = ("door", "opening")  # of edges that lead to the same storey
DOOR_MOST_WIDTH = 1.6  # m: what is wider is an opening
SAME_DOOR_DISTANCE = 0.8  # m: passages between the same rooms that are this close are one
LEVEL_HEIGHT = 0.6  # m: what is higher or lower is another level
LANDING_HEIGHT = 0.35  # m: what is nearer to the level of a storey is no stair
RAMP_CLIMB = 0.25  # climb below which it is a ramp
DOOR_SEARCH = 1.5  # m: how far from the border of two rooms their door may lie
HALF_NEIGHBOURS = np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1)])


Asked = Callable[[Array, Array], Array]  # two rooms (k,) each -> (k,) bool: are edges between them asked for?


def find_edges(floor: Floor, room: Array, storey_of_room: Array, floor_to_ceiling: Array, asked: Asked | None = None) -> Array:
    """Return edges between rooms that have adjacent navigable cells (seeds 2.7), one for each place where they meet.

    Args:
        floor: of all storeys.
        room: (m,) room (or area) of each of its cells, -1 none.
        storey_of_room: (R,) storey of each room.
        floor_to_ceiling: (m,) m of empty space above each cell, 0 where nothing was seen.
        asked: between which rooms edges are asked for; None: between all.

    Returns:
        (E,) EDGE_DTYPE, sorted by rooms and place.
    """
    navigable, body = floor.cells, floor.body_width
    cells = navigable.cells.astype(np.int64)
    first, second = [], []
    for step in HALF_NEIGHBOURS:
        other = navigable.find_rows(cells + step)
        row = np.flatnonzero((other >= 0) & (room >= 0))
        neighbour = other[row]
        meet = (room[neighbour] >= 0) & (room[neighbour] != room[row])
        if asked is not None:
            meet &= asked(room[row], room[neighbour])
        first.append(row[meet])
        second.append(neighbour[meet])
    a, b = np.concatenate(first), np.concatenate(second)
    swap = room[a] > room[b]
    a[swap], b[swap] = b[swap], a[swap]
    edges: list[tuple[Any, ...]] = []
    pair = room[a].astype(np.int64) * (int(room.max(initial=0)) + 1) + room[b]
    order, near = np.argsort(pair, kind="stable"), build_sphere(2.5 * navigable.edge, navigable.edge)
    for contacts in np.split(order, np.flatnonzero(np.diff(pair[order])) + 1) if len(order) else []:
        rows = np.unique(np.concatenate([a[contacts], b[contacts]]))
        meeting = navigable.select_cells(rows)
        contact = label_components(meeting, near)
        parts = [rows[contact == c] for c in range(int(contact.max()) + 1)]
        passages = [_edge(navigable, room, part, storey_of_room, floor_to_ceiling, body) for part in parts]
        edges += _select_distinct_doors(passages)
    table = np.array(edges, EDGE_DTYPE) if edges else np.zeros(0, EDGE_DTYPE)
    _add_stairs(table, floor)
    return table


def _add_stairs(edges: Array, floor: Floor) -> None:
    """Add where the stairs of the given edges begin and end, and which of them are ramps.

    A stair is the connected part of the floor that lies on no storey's level and at which the two rooms meet.
    """
    stairs = np.flatnonzero(edges["kind"] == "stairs")
    if not len(stairs):
        return
    z = floor.cells.compute_centroids()[:, 2]
    nearest = np.abs(z[:, None] - floor.storeys["floor"]).min(axis=1)
    rows = select_lowest_of_column(floor.cells)
    rows = rows[nearest[rows] > LANDING_HEIGHT]
    if not len(rows):
        return
    steps = floor.cells.select_cells(np.sort(rows))
    part = label_components(steps, build_sphere(2.5 * steps.edge, steps.edge))
    places = steps.compute_centroids()
    for i in stairs:
        distance = np.linalg.norm(places - edges["centre"][i], axis=1)
        if distance.min() > DOOR_SEARCH:
            continue
        stair = places[part == part[distance.argmin()]]
        low, high = stair[:, 2].min(), stair[:, 2].max()
        edges["lower"][i] = stair[stair[:, 2] <= low + LANDING_HEIGHT].mean(axis=0)
        edges["upper"][i] = stair[stair[:, 2] >= high - LANDING_HEIGHT].mean(axis=0)
        if _measure_steepness(stair) < RAMP_CLIMB:
            edges["kind"][i] = "ramp"


def _measure_steepness(places: Array) -> float:
    """Measure the climb of a floor, m per m: the median over tiles of 0.6 m."""
    tile = np.floor(places[:, :2] / 0.6).astype(np.int64)
    _, of = np.unique(tile, axis=0, return_inverse=True)
    of = of.ravel()
    low, high = np.full(of.max() + 1, np.inf), np.full(of.max() + 1, -np.inf)
    np.minimum.at(low, of, places[:, 2])
    np.maximum.at(high, of, places[:, 2])
    return float(np.median(high - low)) / 0.6


def _select_distinct_doors(edges: list[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
    """Return the edges of one pair of rooms, without those that lead through the same door as a wider one."""
    distinct: list[tuple[Any, ...]] = []
    for edge in sorted(edges, key=lambda e: (-e[2], e[1])):
        if all(np.linalg.norm(np.subtract(edge[1], other[1])) > max(SAME_DOOR_DISTANCE, other[2] / 2) for other in distinct):
            distinct.append(edge)
    return sorted(distinct)


def _edge(
    navigable: VoxelGrid, room: Array, rows: Array, storey_of_room: Array, floor_to_ceiling: Array, body: float
) -> tuple[Any, ...]:
    """Build one row of EDGE_DTYPE from the cells (`rows`) of two rooms that touch."""
    pair = np.unique(room[rows])
    cells = navigable.cells[rows]
    middle, along, span = _extent(_find_columns(cells))
    narrow = _find_narrowest_place(navigable, room, pair, cells)
    if narrow is not None and narrow[2] <= span:
        middle, along, span = narrow
    under = _find_rows_under(navigable, middle, cells)
    rows = under if len(under) else rows
    above = floor_to_ceiling[rows]
    height = float(np.quantile(above[above > 0], 0.1, method="nearest")) if (above > 0).any() else 0.0
    levels = np.sort(navigable.cells[rows, 2])
    floor = float(levels[: max(len(levels) // 4, 1)].mean())
    centre = navigable.origin + (np.array([*middle, floor]) + 0.5) * navigable.edge
    width = span * navigable.edge + 2 * (int(np.ceil(body / navigable.edge - 1e-6)) // 2) * navigable.edge
    if storey_of_room[pair[0]] != storey_of_room[pair[1]]:
        kind = "stairs"
    else:
        kind = "door" if width <= DOOR_MOST_WIDTH else "opening"
    across = float(np.arctan2(along[0], -along[1]) % np.pi)  # the wall's normal
    place = tuple(centre.tolist())
    standing = navigable.properties.get("standing")
    passable = standing is None or bool(standing[rows].any())
    return (tuple(int(p) for p in pair), place, width, height, across, kind, passable, False, 1.0, place, place)


def _find_rows_under(navigable: VoxelGrid, middle: Array, contact: Array) -> Array:
    """Return the rows of the navigable cells in the middle of a passage, at the height of the contact."""
    reach, rise = int(0.25 / navigable.edge), int(LEVEL_HEIGHT / navigable.edge)
    low = np.rint([*middle, contact[:, 2].mean()]).astype(np.int64) - (reach, reach, rise)
    window = np.argwhere(np.ones((2 * reach + 1, 2 * reach + 1, 2 * rise + 1), bool)) + low
    rows = navigable.find_rows(window)
    rows = rows[rows >= 0]
    return rows[~navigable.contains(navigable.cells[rows].astype(np.int64) - (0, 0, 1))]  # the floor, not what was dilated


def _find_columns(cells: Array) -> Array:
    """Return (k, 2) columns of cells, each once, ascending."""
    size = int(cells[:, 1].max()) + 1
    codes = np.unique(cells[:, 0].astype(np.int64) * size + cells[:, 1])
    return np.column_stack([codes // size, codes % size]).astype(cells.dtype)


def _extent(plan: Array) -> tuple[Array, Array, float]:
    """Return the middle, direction and length (cells) of a strip of columns."""
    middle = plan.mean(axis=0)
    along = np.array([1.0, 0.0])
    if len(plan) > 2:
        along = np.linalg.svd(plan - middle, full_matrices=False)[2][0]
    return middle, along, float(np.ptp(plan @ along)) + 1


def _find_narrowest_place(navigable: VoxelGrid, room: Array, pair: Array, contact: Array) -> tuple[Array, Array, float] | None:
    """Return the middle, direction and width (cells) of the narrowest place on the widest way between two rooms, near their
    contact.

    Borders between clusters of views lie somewhere near a door, not in it; the floor itself is narrowest in the door.
    """
    reach = int(np.ceil(DOOR_SEARCH / navigable.edge))
    low, high = compute_extent(contact[:, :2])
    low -= reach
    size = high + reach + 1 - low
    owner = _rasterise_rooms(navigable, room, low, size, contact)
    free = np.pad(owner >= 0, 1)
    clearance = np.sqrt(edt.edtsq(free.view(np.uint8), parallel=1))[1:-1, 1:-1]
    # Each room is represented by its widest place away from the border, which may lie on the wrong side of the door.
    far = np.ones(size, bool)
    far[tuple((contact[:, :2] - low).T)] = False
    away = np.sqrt(edt.edtsq(far.view(np.uint8), parallel=1))
    sides = []
    for p in pair:
        side = owner == p
        if not side.any():
            return None
        away_enough = side & (away >= min(0.6 * reach, away[side].max()))
        sides.append(np.argmax(np.where(away_enough, clearance, -1.0)))
    if clearance.flat[sides[0]] <= 1 or clearance.flat[sides[1]] <= 1:
        return None
    pass_parts = _split_at_pass(clearance, int(sides[0]), int(sides[1]))
    if pass_parts is None:
        return None
    saddle = _find_middle_cell(*pass_parts)
    return None if saddle is None else _across(owner >= 0, clearance, saddle, low)


def _split_at_pass(clearance: Array, first: int, second: int) -> tuple[Array, Array, Array] | None:
    """Return the parts of the first and of the second of two columns where the widest body passes that does not get from the one
    to the other, and the part of both where the next smaller one does; None where none or all do."""
    levels = np.unique(clearance[clearance > 0])[::-1]

    def parts_at(k: int) -> tuple[Array, int, int]:
        parts, _ = ndimage.label(clearance >= levels[k], np.ones((3, 3)))
        return parts, int(parts.flat[first]), int(parts.flat[second])

    shared = min(float(clearance.flat[first]), float(clearance.flat[second]))  # above it, one of them is not there
    low, high = int((levels > shared).sum()), len(levels)  # the first level at which they are joined is one of low..high
    while low < high:
        middle = (low + high) // 2
        _, a, b = parts_at(middle)
        low, high = (low, middle) if a and a == b else (middle + 1, high)
    if low in (0, len(levels)):
        return None
    parts, a, b = parts_at(low - 1)
    if not a or not b:
        return None
    joined, both, _ = parts_at(low)
    return parts == a, parts == b, joined == both


def _rasterise_rooms(navigable: VoxelGrid, room: Array, low: Array, size: Array, contact: Array) -> Array:
    """Return (size) room of each column of a window at `low`, at the height of the contact; -1 where nobody can stand."""
    reach = int(LEVEL_HEIGHT / navigable.edge)
    middle = round(float(contact[:, 2].mean()))
    levels = np.arange(middle - reach, middle + reach + 1)
    cells = np.empty((len(levels), *size, 3), np.int64)
    cells[..., 2], cells[..., 0], cells[..., 1] = np.ix_(levels, low[0] + np.arange(size[0]), low[1] + np.arange(size[1]))
    row = navigable.find_rows(cells)
    label = np.where(row >= 0, room[np.maximum(row, 0)], -1)
    return label.reshape(len(levels), *size).max(axis=0)


def _find_middle_cell(first: Array, second: Array, way: Array) -> Array | None:
    """Return the cell of `way` halfway between two parts on the shortest connection."""
    steps = [count_steps(part, way) for part in (first, second)]
    total = np.where((steps[0] > 0) & (steps[1] > 0), steps[0] + steps[1], np.iinfo(np.int64).max)
    if not (total < np.iinfo(np.int64).max).any():
        return None
    cells = np.argwhere(total == total.min())
    return cells[np.abs(steps[0] - steps[1])[tuple(cells.T)].argmin()]


def _across(free: Array, clearance: Array, saddle: Array, low: Array) -> tuple[Array, Array, float]:
    """Return the middle, direction and width of the passage at `saddle`: from its nearest wall straight to the one opposite."""
    reach = int(np.ceil(clearance[tuple(saddle)])) + 1  # within which the nearest wall lies
    low_corner = np.maximum(saddle + 1 - reach, 0)
    around = np.pad(free, 1)[low_corner[0] : saddle[0] + reach + 2, low_corner[1] : saddle[1] + reach + 2]
    _, nearest = ndimage.distance_transform_edt(around, return_indices=True)
    wall = nearest[:, *(saddle + 1 - low_corner)] + low_corner - 1
    along = (wall - saddle) / max(float(np.linalg.norm(wall - saddle)), 1e-9)
    ends = []
    for sign in (1.0, -1.0):
        length = 0.0
        while True:
            cell = np.rint(saddle + sign * (length + 0.5) * along).astype(int)
            if (cell < 0).any() or (cell >= free.shape).any() or not free[tuple(cell)]:
                break
            length += 0.5
        ends.append(length)
    middle = saddle + along * (ends[0] - ends[1]) / 2 + low
    return middle, along, sum(ends) + (0.0 if sum(ends) else 1.0)


# Rooms and edges with their measures: the topometric map (seeds 2.7).


def build_topometric_map(grid: VoxelGrid, floor: Floor, body_height: float, known: int = 0) -> TopometricMap:
    """Build the graph of rooms over the voxel grid (seeds 2.7).

    A room without a floor has no place in the graph: its cells lose their label.

    Args:
        grid: occupied cells.
        floor: of all storeys, cut into rooms.
        body_height: m, whatever is lower than this above the floor is no ceiling.
        known: of so many rooms, the first ones, doors and narrowings are known (`fusion.joined_rooms`); only their stairs are
            looked for.
    """
    old_number = select_rooms_with_floor(floor)
    number = np.full(max(int(a.max(initial=-1)) for a in (floor.label, floor.room, floor.room_of_area)) + 2, -1, np.int32)
    number[old_number] = np.arange(len(old_number))
    room, label = number[floor.label], number[floor.room]
    above = measure_floor_to_ceiling(grid, floor.cells, body_height)
    rooms = _measure_rooms(grid, room, floor, label, above, old_number)
    fresh, storey = old_number >= known, rooms["storey"]
    asked = None if not known else (lambda a, b: (fresh[a] & fresh[b]) | (storey[a] != storey[b]))
    edges = find_edges(floor, label, storey, above, asked)
    for edge in edges:
        a, b = old_number[edge["rooms"]].tolist()
        edge["confidence"] = floor.door_probability.get((min(a, b), max(a, b)), 1.0)
    area = np.where(number[floor.room_of_area][floor.area] >= 0, floor.area, -1) if len(floor.room_of_area) else floor.area
    areas, area, old_area = _build_areas(floor, label, area)
    owner = areas["room"]
    narrows = find_edges(floor, area, storey[owner], above, lambda a, b: (owner[a] == owner[b]) & fresh[owner[a]])
    # How surely two areas are one room, so that zones can be cut without extracting again (docs/adr/0047).
    narrows["confidence"] = compute_merge_levels(floor.merges, old_area[narrows["rooms"]])
    return TopometricMap(grid, room, floor.cells, label, rooms, edges, floor.storeys, areas, area, narrows)


def select_rooms_with_floor(floor: Floor) -> Array:
    """Return (R,) numbers of those rooms of a floor that are rooms of its map, in its order."""
    lowest = floor.room[select_lowest_of_column(floor.cells)]
    return np.unique(lowest[lowest >= 0])


def _build_areas(floor: Floor, label: Array, area: Array) -> tuple[Array, Array, Array]:
    """Return (A,) AREA_DTYPE, the areas renumbered, and (A,) the numbers that they had."""
    numbers = np.unique(area[area >= 0])
    number = np.append(np.searchsorted(numbers, np.arange(int(area.max(initial=-1)) + 1)), -1)
    area = number[area].astype(np.int32)
    areas = np.zeros(len(numbers), AREA_DTYPE)
    lowest = select_lowest_of_column(floor.cells)
    for a in range(len(numbers)):
        rows = lowest[area[lowest] == a]
        rows = rows if len(rows) else np.flatnonzero(area == a)
        areas[a] = (
            label[rows[0]],
            floor.cells.compute_centroids(floor.cells.cells[rows]).mean(axis=0),
            len(rows) * floor.cells.edge**2,
        )
    return areas, area, numbers


def _measure_rooms(grid: VoxelGrid, room: Array, floor: Floor, label: Array, above: Array, numbers: Array) -> Array:
    """Return (R,) ROOM_DTYPE; `numbers` (R,) are those of the floor's rooms."""
    count = int(label.max(initial=-1)) + 1
    cells = floor.cells
    rooms = np.zeros(count, ROOM_DTYPE)
    if floor.completeness is not None:
        rooms["completeness"] = floor.completeness[numbers]
    else:
        rooms["completeness"] = measure_completeness(grid, cells, label, count, floor.body_width)
    lowest = select_lowest_of_column(cells)
    order = lowest[np.argsort(label[lowest], kind="stable")]
    floor_of = np.split(order, np.searchsorted(label[order], np.arange(count + 1)))[1:-1]
    order = np.argsort(room, kind="stable")
    cells_of = np.split(order, np.searchsorted(room[order], np.arange(count + 1)))[1:-1]
    for r in range(count):
        rows = floor_of[r]
        rooms["storey"][r] = np.bincount(floor.storey[rows]).argmax()
        for name, value in measure_room(grid, cells, rows, cells_of[r], above[rows], floor.body_width).items():
            rooms[name][r] = value
    return rooms


def measure_room(
    grid: VoxelGrid, navigable: VoxelGrid, floor: Array, occupied: Array, above: Array, body_width: float
) -> dict[str, Any]:
    """Measure a room: those columns of ROOM_DTYPE that its cells tell.

    Args:
        grid: occupied cells.
        navigable: the navigable volume.
        floor: rows of those of its cells that are the floor of the room.
        occupied: rows of the occupied cells of the room.
        above: m of empty space above each cell of the floor, 0 where nothing was seen.
        body_width: m, how much wider than its cells the room is.
    """
    cells = navigable.cells[floor]
    area, height = _measure_area(cells[:, :2], navigable.edge, body_width), estimate_ceiling_height(above)
    low, high = compute_extent(grid.cells[occupied] if len(occupied) else cells)
    return {
        "centroid": navigable.compute_centroids(cells).mean(axis=0),
        "area": area,
        "height": height,
        "volume": area * height,
        "lo": grid.origin + low * grid.edge,
        "hi": grid.origin + (high + 1) * grid.edge,
        "cells": len(occupied),
    }


def _measure_area(columns: Array, edge: float, body_width: float) -> float:
    """Measure the floor, m2: the navigable columns, the strip along the walls in which the body does not fit, and half a cell
    more along the boundary, because a wall's face lies on average in the middle of its cell."""
    reach = int(np.ceil(body_width / edge - 1e-6)) // 2
    low, high = compute_extent(columns)
    low -= reach + 1
    plan = np.zeros(high - low + reach + 2, bool)
    plan[tuple((columns - low).T)] = True
    if reach:
        plan = ndimage.binary_dilation(plan, np.ones((2 * reach + 1, 2 * reach + 1)))
    boundary = sum(int((plan[1:] != plan[:-1]).sum()) for plan in (plan, plan.T))
    return (float(plan.sum()) + boundary / 2) * edge**2
