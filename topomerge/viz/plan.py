"""Data of the views of a map: rasters of its storeys, and its cells in 3D."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import edt
import numpy as np
from scipy import ndimage

from topomerge.io.rooms_ply import NO_ROOM, assign_room_colours
from topomerge.types import Array, TopometricMap, compute_extent

CUT = (1.0, 1.9)  # m above the floor: what fills this band is drawn as wall, as architects cut a plan
WALL_SHARE = 0.5  # share of the band that must be occupied
KEPT_DRAWINGS = 8  # plans of which is kept what is drawn: a report draws those of two maps several times
MAX_PIXELS = 1500  # along an axis; cells of larger buildings are drawn together


@dataclass(frozen=True, eq=False)
class Frame:
    """Pixels over the building: pixel (i, j) covers x from low[0] + i * size."""

    low: Array  # (2,) m, in the input's frame
    size: float  # m
    shape: tuple[int, int]
    first: Array  # (2,) the cell at pixel (0, 0)
    step: int  # cells a pixel, along an axis

    @property
    def high(self) -> Array:
        """(2,) the far corner, m."""
        return self.low + np.asarray(self.shape) * self.size

    def compute_pixels(self, cells: Array) -> Array:
        """Compute (n, 2) pixels of (n, 3) cells."""
        return (cells[:, :2] - self.first) // self.step

    def compute_centre(self, pixel: Array) -> Array:
        """Compute (..., 2) middle of pixels, m."""
        return self.low + (np.asarray(pixel) + 0.5) * self.size


@dataclass(frozen=True, eq=False)
class StoreyView:
    """One storey from above."""

    room: Array  # (nx, ny) int32 room of each pixel, -1 none
    floor: Array  # (nx, ny) bool: something is there, of a room or not
    wall: Array  # (nx, ny) bool


def compute_frame(map: TopometricMap) -> Frame:
    """Compute pixels over all cells of the map, as many cells each as it takes to stay below `MAX_PIXELS`."""
    grids = [grid.cells for grid in (map.grid, map.navigable) if len(grid)] or [np.zeros((1, 3), np.int32)]
    first = np.array([min(int(cells[:, k].min()) for cells in grids) for k in (0, 1)])
    last = np.array([max(int(cells[:, k].max()) for cells in grids) for k in (0, 1)])
    step = int(np.ceil((last - first + 1).max() / MAX_PIXELS))
    nx, ny = ((last - first) // step + 1).tolist()
    return Frame(map.grid.origin[:2] + first * map.grid.edge, step * map.grid.edge, (nx, ny), first, step)


@dataclass(frozen=True, eq=False)
class StoreyCells:
    """The cells that the plan of a storey shows, and where. They stay when the map is cut into rooms in another way.

    Args:
        occupied: rows of occupied cells, ascending.
        occupied_at: their pixels, x * ny + y.
        walked: rows of navigable cells, ascending.
        walked_at: their pixels.
        floor: (nx, ny) bool: something is there.
        wall: (nx, ny) bool.
    """

    occupied: Array
    occupied_at: Array
    walked: Array
    walked_at: Array
    floor: Array
    wall: Array


def rasterize_storeys(map: TopometricMap, frame: Frame) -> list[StoreyView]:
    """Return a plan of each storey, lowest first; one plan of everything where the map has no storeys."""
    return [paint_rooms(map, cells) for cells in locate_storey_cells(map, frame)]


def locate_storey_cells(map: TopometricMap, frame: Frame) -> list[StoreyCells]:
    """Find the cells of each storey, lowest first, and their pixels."""
    count = max(len(map.storeys), 1)
    occupied = _group_cells(map.grid.cells, np.maximum(map.find_cell_storeys(), 0), frame, count)
    walked = [(np.zeros(0, np.int64), np.zeros(0, np.int64))] * count
    if len(map.rooms):
        storey = np.where(map.navigable_room >= 0, map.rooms["storey"][map.navigable_room], count)
        walked = _group_cells(map.navigable.cells, storey, frame, count)
    found = []
    for s, ((rows, at), (floor_rows, floor_at)) in enumerate(zip(occupied, walked, strict=True)):
        floor = np.zeros(frame.shape[0] * frame.shape[1], bool)
        floor[at] = floor[floor_at] = True
        wall = _rasterize_walls(map, frame, s, map.grid.cells[rows, 2], at)
        found.append(StoreyCells(rows, at, floor_rows, floor_at, floor.reshape(frame.shape), wall))
    return found


def _group_cells(cells: Array, storey: Array, frame: Frame, count: int) -> list[tuple[Array, Array]]:
    """Return the rows of the cells of each storey below `count`, and their pixels."""
    order = np.argsort(storey.astype(np.uint8 if count < 256 else np.int32), kind="stable")
    ends = np.cumsum(np.bincount(storey, minlength=count))[:count].tolist()
    x, y = ((cells[order, k] - frame.first[k]) // frame.step for k in (0, 1))
    at = x.astype(np.int64) * frame.shape[1] + y
    return [(order[a:b], at[a:b]) for a, b in zip([0, *ends], ends, strict=False)]


def paint_rooms(map: TopometricMap, cells: StoreyCells) -> StoreyView:
    """Paint the rooms of a storey."""
    room = np.full(cells.floor.size, -1, np.int32)
    labels = map.room[cells.occupied]
    inside = labels >= 0
    room[cells.occupied_at[inside]] = labels[inside]
    room[cells.walked_at] = map.navigable_room[cells.walked]  # where one walks is surer than what hangs over it
    return StoreyView(room.reshape(cells.floor.shape), cells.floor, cells.wall)


def _rasterize_walls(map: TopometricMap, frame: Frame, storey: int, level: Array, at: Array) -> Array:
    """Return (nx, ny) bool: the cut of the storey, at heights above its floor."""
    if not len(level):
        return np.zeros(frame.shape, bool)
    lowest = map.grid.origin[2] + level.min() * map.grid.edge
    floor = float(map.storeys["floor"][storey]) if storey < len(map.storeys) else lowest
    height = map.grid.origin[2] + (np.arange(int(level.max()) + 1) + 0.5) * map.grid.edge - floor
    cut = at[((height >= CUT[0]) & (height < CUT[1]))[level]]
    filled = np.bincount(cut, minlength=frame.shape[0] * frame.shape[1]).reshape(frame.shape)
    # A pixel of step x step cells shows a wall that is one cell wide.
    return np.asarray(filled >= max(WALL_SHARE * (CUT[1] - CUT[0]) / map.grid.edge * frame.step, 1))


@dataclass(frozen=True)
class Place:
    """Where the name of a room stands: well inside it, near its middle."""

    x: float  # m
    y: float
    clear: float  # m to the nearest edge of the room's area


@lru_cache(maxsize=KEPT_DRAWINGS)
def find_label_places(plan: StoreyView, frame: Frame) -> dict[int, Place]:
    """Map each room to the point of its area with most space around it; of nearly equal ones the nearest to the middle."""
    boxes = enumerate(ndimage.find_objects(plan.room + 1))
    return {i: find_label_place(plan.room[box] == i, plan.wall[box], box, frame) for i, box in boxes if box is not None}


def find_label_place(room: Array, wall: Array, box: tuple[slice, slice], frame: Frame) -> Place:
    """Find the place of the name of one room.

    Args:
        room: (nx, ny) bool, its pixels in a box around it.
        wall: (nx, ny) bool, the walls there.
        box: where the box is.
        frame: the pixels of the plan.
    """
    mask = np.pad(room & ~wall, 1)
    if not mask.any():
        mask = np.pad(room, 1)
    space = np.sqrt(edt.edtsq(mask.view(np.uint8), parallel=1).astype(np.float64))  # whole numbers before the root
    options = np.argwhere(space >= 0.85 * space.max())
    middle = np.argwhere(mask).mean(axis=0)
    best = options[np.argmin(((options - middle) ** 2).sum(axis=1))]
    x, y = frame.compute_centre(best - 1 + np.array([box[0].start, box[1].start])).tolist()
    return Place(x, y, float(space[tuple(best)]) * frame.size)


MOST_DRAWN = 2_500_000  # cells that are drawn once the view rests; of a map with more, neighbours are merged
LONGEST_AXIS = 65_535  # cells along an axis that 16 bits can number


def build_scene_data(
    map: TopometricMap,
    key: str = "",
    turn: float = 0.0,
    most: int = MOST_DRAWN,
    seen: Array | None = None,
    only: Sequence[int] | Array | None = None,
) -> dict[str, Any]:
    """Build the data of the 3D view, as plain values.

    Cells are grouped by storey, room and `seen`; within a group they are sorted by their number
    (x * ny + y) * nz + z, of which the differences are kept as LEB128 in base64: about 1.3 bytes a cell.

    Args:
        map: any map.
        key: what stands before the numbers of its rooms, as in its plan and tables.
        turn: rad, by which its plan is turned against the clock: the camera stands accordingly.
        most: with more cells than this, cubes of 2, 3, … cells along an axis become one, of the room most of them have.
        seen: (n,) small ints, another label for which cells can be coloured (as of maps that saw them), or None.
        only: rooms that are numbered and looked at; None: all.

    Returns:
        `edge` (m, of what is drawn), `merged` (cells along an axis that became one), `cells` (of the map), `drawn`, `origin`
        (m), `shape`, `turn`, `look` (box around the rooms, m from `origin`, or None), `storeys` [{name, floor}],
        `groups` [[storey, room, seen, cells]], `colours` {name: [hex for each group]},
        `rooms` [[key, storey, x, y, z]] in m, `data`.
    """
    named = np.arange(len(map.rooms)) if only is None else np.asarray(only, np.int64)
    seen = np.zeros(len(map.grid), np.int64) if seen is None else seen.astype(np.int64)
    labels = np.stack([np.maximum(map.find_cell_storeys(), 0), map.room + 1, seen], axis=1).astype(np.int64)
    low = compute_extent(map.grid.cells)[0] if len(map.grid) else np.zeros(3, np.int32)
    cells = map.grid.cells.astype(np.int64) - low
    factor, number, shape, kinds, kind = _merge_cells(cells, labels, most)
    order = np.lexsort((number, kind))
    groups = np.concatenate([kinds, np.bincount(kind, minlength=len(kinds))[:, None]], axis=1)
    starts = np.concatenate([[0], np.cumsum(groups[:, 3])[:-1]]).astype(np.int64)
    steps = np.diff(number[order], prepend=0)
    steps[starts[groups[:, 3] > 0]] = number[order][starts[groups[:, 3] > 0]]  # each group starts anew
    palette = np.concatenate([assign_room_colours(map), np.array([NO_ROOM], np.uint8)])
    floors = map.storeys["floor"] if len(map.storeys) else [map.grid.origin[2] + low[2] * map.grid.edge]
    return {
        "edge": round(map.grid.edge * factor, 6),
        "merged": factor,
        "cells": len(map.grid),
        "drawn": len(number),
        "origin": [round(float(v), 4) for v in map.grid.origin + low * map.grid.edge],
        "shape": shape,
        "turn": round(turn, 6),
        "look": _compute_corners(map.rooms[named], map.grid.origin + low * map.grid.edge),
        "storeys": [{"name": str(i), "floor": round(float(f), 3)} for i, f in enumerate(floors)],
        "groups": groups.tolist(),
        "colours": {"room": [format_hex_colour(palette[room]) for room in kinds[:, 1]]},
        "rooms": [[f"{key}{i}", int(map.rooms["storey"][i]), *_compute_middle(map.rooms[i])] for i in named.tolist()],
        "data": base64.b64encode(encode_leb128(steps)).decode("ascii"),
    }


def format_hex_colour(colour: Array) -> str:
    """Format a (3,) uint8 colour as #rrggbb."""
    return "#" + bytes(colour.tolist()).hex()


def _compute_corners(rooms: Array, origin: Array) -> list[list[float]] | None:
    """Return the corners of the box around rooms, m from the scene's corner."""
    if not len(rooms):
        return None
    low, high = rooms["lo"].min(axis=0) - origin, rooms["hi"].max(axis=0) - origin
    return [low.round(3).tolist(), high.round(3).tolist()]


def _compute_middle(room: Any) -> list[float]:
    return [round(float(v), 2) for v in room["centroid"]]


def _merge_cells(cells: Array, labels: Array, most: int) -> tuple[int, Array, list[int], Array, Array]:
    """Merge cells along an axis that become one; return also for each drawn cell its number, the shape, kinds and each cell's
    kind."""
    longest = int(cells.max(initial=0)) + 1
    factor = -(-longest // LONGEST_AXIS)
    base = labels.max(axis=0, initial=0) + 1
    code, kind = np.unique((labels[:, 0] * base[1] + labels[:, 1]) * base[2] + labels[:, 2], return_inverse=True)
    kinds = np.stack([code // (base[1] * base[2]), code // base[2] % base[1] - 1, code % base[2]], axis=1)
    while True:
        coarse = cells // factor
        shape = (compute_extent(coarse)[1] + 1).tolist() if len(cells) else [1, 1, 1]
        number = (coarse[:, 0] * shape[1] + coarse[:, 1]) * shape[2] + coarse[:, 2]
        if len(number) <= most and factor == 1:
            return factor, number, shape, kinds, kind
        number, winner = _find_most_common(number, kind, kinds)
        if len(number) <= most:
            return factor, number, shape, kinds, winner
        factor += 1


def _find_most_common(number: Array, kind: Array, kinds: Array) -> tuple[Array, Array]:
    """Return one row for each number on each storey: with the kind that most of its cells have, the lowest of equal ones."""
    storey = kinds[:, 0]
    order = np.lexsort((kind, number))
    number, kind = number[order], kind[order]
    first = np.flatnonzero(np.concatenate([[True], (np.diff(number) != 0) | (np.diff(kind) != 0)]))
    count = np.diff(np.append(first, len(number)))
    number, kind = number[first], kind[first]
    order = np.lexsort((kind, -count, storey[kind], number))
    number, kind = number[order], kind[order]
    best = np.concatenate([[True], (np.diff(number) != 0) | (np.diff(storey[kind]) != 0)])
    return number[best], kind[best]


def encode_leb128(values: Array) -> bytes:
    """Encode unsigned ints, seven bits a byte, the lowest first; the top bit says that more follow."""
    rest = values.astype(np.uint64)
    size = np.ones(len(rest), np.int64)
    for bits in range(7, 64, 7):
        size += rest >= np.uint64(1 << bits)
    at = np.cumsum(size) - size
    out = np.zeros(int(size.sum()), np.uint8)
    for k in range(int(size.max(initial=0))):
        has = size > k
        more = np.where(size[has] > k + 1, 0x80, 0)
        out[at[has] + k] = (((rest[has] >> np.uint64(7 * k)) & np.uint64(0x7F)) | more.astype(np.uint64)).astype(np.uint8)
    return out.tobytes()
