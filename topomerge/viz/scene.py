"""The occupied cells of a map for the 3D view of a report: few enough to be drawn, small enough to be sent."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from topomerge.io.palette import NO_ROOM, room_colours
from topomerge.types import Array, TopometricMap

MOST_DRAWN = 2_500_000  # cells that are drawn once the view rests; of a map with more, neighbours are merged
LONGEST_AXIS = 65_535  # cells along an axis that 16 bits can number


def scene_data(
    map: TopometricMap,
    key: str = "",
    turn: float = 0.0,
    most: int = MOST_DRAWN,
    seen: Array | None = None,
    only: Sequence[int] | Array | None = None,
) -> dict[str, Any]:
    """What the 3D view needs, as plain values.

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
    labels = np.stack([np.maximum(map.storey_of_cells(), 0), map.room + 1, seen], axis=1).astype(np.int64)
    low = map.grid.cells.min(axis=0) if len(map.grid) else np.zeros(3, np.int32)
    cells = map.grid.cells.astype(np.int64) - low
    factor, number, shape, kinds, kind = _merged(cells, labels, most)
    order = np.lexsort((number, kind))
    groups = np.concatenate([kinds, np.bincount(kind, minlength=len(kinds))[:, None]], axis=1)
    starts = np.concatenate([[0], np.cumsum(groups[:, 3])[:-1]]).astype(np.int64)
    steps = np.diff(number[order], prepend=0)
    steps[starts[groups[:, 3] > 0]] = number[order][starts[groups[:, 3] > 0]]  # each group starts anew
    palette = np.concatenate([room_colours(map), np.array([NO_ROOM], np.uint8)])
    floors = map.storeys["floor"] if len(map.storeys) else [map.grid.origin[2] + low[2] * map.grid.edge]
    return {
        "edge": round(map.grid.edge * factor, 6),
        "merged": factor,
        "cells": len(map.grid),
        "drawn": len(number),
        "origin": [round(float(v), 4) for v in map.grid.origin + low * map.grid.edge],
        "shape": shape,
        "turn": round(turn, 6),
        "look": _look(map.rooms[named], map.grid.origin + low * map.grid.edge),
        "storeys": [{"name": str(i), "floor": round(float(f), 3)} for i, f in enumerate(floors)],
        "groups": groups.tolist(),
        "colours": {"room": [hex_colour(palette[room]) for room in kinds[:, 1]]},
        "rooms": [[f"{key}{i}", int(map.rooms["storey"][i]), *_middle(map.rooms[i])] for i in named.tolist()],
        "data": base64.b64encode(leb128(steps)).decode("ascii"),
    }


def hex_colour(colour: Array) -> str:
    """(3,) uint8 as #rrggbb."""
    return "#" + bytes(colour.tolist()).hex()


def _look(rooms: Array, origin: Array) -> list[list[float]] | None:
    """The corners of the box around rooms, m from the scene's corner."""
    if not len(rooms):
        return None
    low, high = rooms["lo"].min(axis=0) - origin, rooms["hi"].max(axis=0) - origin
    return [low.round(3).tolist(), high.round(3).tolist()]


def _middle(room: Any) -> list[float]:
    return [round(float(v), 2) for v in room["centroid"]]


def _merged(cells: Array, labels: Array, most: int) -> tuple[int, Array, list[int], Array, Array]:
    """Cells along an axis that become one, then for each drawn cell its number, the shape, kinds and each cell's kind."""
    longest = int(cells.max(initial=0)) + 1
    factor = -(-longest // LONGEST_AXIS)
    base = labels.max(axis=0, initial=0) + 1
    code, kind = np.unique((labels[:, 0] * base[1] + labels[:, 1]) * base[2] + labels[:, 2], return_inverse=True)
    kinds = np.stack([code // (base[1] * base[2]), code // base[2] % base[1] - 1, code % base[2]], axis=1)
    while True:
        coarse = cells // factor
        shape = (coarse.max(axis=0) + 1).tolist() if len(cells) else [1, 1, 1]
        number = (coarse[:, 0] * shape[1] + coarse[:, 1]) * shape[2] + coarse[:, 2]
        if len(number) <= most and factor == 1:
            return factor, number, shape, kinds, kind
        number, winner = _most_common(number, kind, kinds)
        if len(number) <= most:
            return factor, number, shape, kinds, winner
        factor += 1


def _most_common(number: Array, kind: Array, kinds: Array) -> tuple[Array, Array]:
    """One row for each number on each storey: with the kind that most of its cells have, the lowest of equal ones."""
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


def leb128(values: Array) -> bytes:
    """Unsigned ints, seven bits a byte, the lowest first; the top bit says that more follow."""
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
