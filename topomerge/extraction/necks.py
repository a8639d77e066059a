"""Rooms that no neck parts are one room (beyond the thesis: findings.md, "What worked").

The range of the views cuts corridors and halls into pieces, and modularity knows nothing of doors. The floor does: between two rooms
it is narrow, within one it is not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topomerge.extraction.convolution import moore
from topomerge.extraction.distance_field import horizontal_distance_field
from topomerge.extraction.rooms import navigable_rooms
from topomerge.kernels import saddle as kernel
from topomerge.types import Array, VoxelGrid

LINTEL = 0.25  # m: a passage this much lower than the rooms on both sides is a door, however wide


@dataclass
class _Rooms:
    """The state of the merging: what belongs together, and the measures of each room."""

    label: Array  # (m,) room of each navigable cell
    clearance: Array  # (m,) m, half the width that is free at a cell
    height: Array  # (m,) m of empty space above, 0 unknown
    storey: Array  # (R,)
    rows: dict[int, Array]  # cells of a room, widest first


def merge_across_wide_necks(
    grid: VoxelGrid,
    room: Array,
    navigable: VoxelGrid,
    storey: Array,
    floor_to_ceiling: Array,
    body: float,
    ratio: float,
    width: float,
) -> Array:
    """Merge neighbouring rooms, best first, whose widest connection is no narrower than a share of the narrower room.

    Args:
        grid: occupied cells.
        room: (n,) room of each, -1 none.
        navigable: the navigable volume.
        storey: (m,) storey of each of its cells; rooms of two storeys are never merged.
        floor_to_ceiling: (m,) m of empty space above each of its cells, 0 where nothing was seen.
        body: width (m) of the body it was made for.
        ratio: share of the narrower room's width from which on a connection is no neck.
        width: connections wider than this (m) are none either, unless they have a lintel.

    Returns:
        (n,) int32, numbered from 0 in the old order.
    """
    label = navigable_rooms(grid, room, navigable)
    count = int(room.max(initial=-1)) + 1
    clearance = (horizontal_distance_field(navigable) + 0.5) * navigable.edge + body / 2
    by_room = _rows_by_room(label, clearance, count)
    of_room = np.array([np.bincount(storey[by_room[r]]).argmax() if len(by_room[r]) else -1 for r in range(count)])
    state = _Rooms(label, clearance, floor_to_ceiling, of_room, by_room)
    into = np.arange(count)
    offsets = moore().stencil[0]
    scratch = np.full(len(navigable), -1, np.int64)
    pairs = {p: _score(navigable, state, p, offsets, scratch, width) for p in _neighbours(navigable, label)}
    while pairs:
        best = max(pairs, key=lambda p: (pairs[p], p))
        if pairs[best] < ratio:
            break
        keep, gone = best
        into[into == gone] = keep
        state.label[state.rows[gone]] = keep
        joined = np.concatenate([state.rows[keep], state.rows.pop(gone)])
        state.rows[keep] = joined[np.argsort(-clearance[joined], kind="stable")]
        touched = {tuple(sorted((keep if r == gone else r) for r in p)) for p in pairs if keep in p or gone in p} - {(keep, keep)}
        pairs = {p: s for p, s in pairs.items() if keep not in p and gone not in p}
        pairs |= {p: _score(navigable, state, p, offsets, scratch, width) for p in touched}  # type: ignore[arg-type]
    kept = np.unique(into)
    number = np.append(np.searchsorted(kept, into), -1).astype(np.int32)
    return number[room]


def _rows_by_room(label: Array, clearance: Array, count: int) -> dict[int, Array]:
    order = np.lexsort((-clearance, label))
    parts = np.split(order, np.searchsorted(label[order], np.arange(count + 1)))[1:-1]
    return dict(enumerate(parts))


def _neighbours(navigable: VoxelGrid, label: Array) -> list[tuple[int, int]]:
    """Pairs of rooms with adjacent navigable cells."""
    found = []
    for step in ((1, 0, 0), (0, 1, 0), (0, 0, 1)):
        other = navigable.rows(navigable.cells.astype(np.int64) + step)
        a, b = label[other >= 0], label[other[other >= 0]]
        meet = (a >= 0) & (b >= 0) & (a != b)
        found.append(np.sort(np.column_stack([a[meet], b[meet]]), axis=1))
    return [(int(a), int(b)) for a, b in np.unique(np.concatenate(found), axis=0)]


def _score(
    navigable: VoxelGrid, state: _Rooms, pair: tuple[int, int], offsets: Array, scratch: Array, width: float
) -> float:
    """How little of a neck there is between two rooms: 1 for none."""
    a, b = pair
    if state.storey[a] != state.storey[b] or not len(state.rows[a]) or not len(state.rows[b]):
        return 0.0
    rows = np.concatenate([state.rows[a], state.rows[b]])
    rows = rows[np.argsort(-state.clearance[rows], kind="stable")]
    ends = state.rows[a][0], state.rows[b][0]
    at = kernel.saddle(
        navigable.cells, *navigable._bricks, offsets, state.clearance, rows, ends[0], ends[1], scratch
    )
    if at < 0:
        return 0.0
    narrow = float(state.clearance[at])
    score = narrow / min(float(state.clearance[e]) for e in ends)
    if 2 * narrow >= width and not _has_lintel(navigable, state, pair, int(at)):
        return max(score, 1.0)
    return score


def _has_lintel(navigable: VoxelGrid, state: _Rooms, pair: tuple[int, int], at: int) -> bool:
    """Is the passage lower than the rooms on both sides?"""
    near = np.abs(navigable.cells - navigable.cells[at]).max(axis=1) * navigable.edge <= 0.4
    passage = state.height[near][state.height[near] > 0]
    rooms = [state.height[state.rows[p]] for p in pair]
    if not len(passage) or any((h > 0).mean() < 0.5 for h in rooms):
        return False
    return float(passage.min()) <= min(float(np.median(h[h > 0])) for h in rooms) - LINTEL
