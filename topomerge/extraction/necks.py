"""Rooms that no neck parts are one room (beyond the thesis: findings.md, "What worked").

The range of the views cuts corridors and halls into pieces, and modularity knows nothing of doors. The floor does: between two
rooms it is narrow, within one it is not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topomerge.extraction.convolution import moore
from topomerge.extraction.distance_field import horizontal_distance_field
from topomerge.extraction.rooms import navigable_rooms
from topomerge.extraction.storeys import ceiling_height
from topomerge.kernels import saddle as kernel
from topomerge.types import Array, VoxelGrid

UNDER_LINTEL = 0.75  # what a share of the width counts where it is that of a door
LINTEL = 0.25  # m: a passage this much lower than the rooms on both sides is a door, however wide


@dataclass
class _Passage:
    """The widest connection of two rooms."""

    half_width: float  # m, at its narrowest; 0 if there is none
    lintel: bool


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
    half_width = (horizontal_distance_field(navigable) + 0.5) * navigable.edge + body / 2
    rows = _rows_by_room(label, half_width, count)
    peak = np.array([half_width[r[0]] if len(r) else 0.0 for r in rows])
    level = [np.bincount(storey[r]).argmax() if len(r) else -1 for r in rows]
    heights = [ceiling_height(floor_to_ceiling[r]) for r in rows]
    scratch = np.full(len(navigable), -1, np.int64)
    passages: dict[tuple[int, int], _Passage] = {}
    for a, b in _neighbours(navigable, label):
        if level[a] == level[b]:
            lowest_ceiling = min(heights[a], heights[b])
            passages[a, b] = _passage(navigable, half_width, rows[a], rows[b], scratch, floor_to_ceiling, lowest_ceiling)
    into = _merge(count, peak, passages, ratio, width)
    kept = np.unique(into)
    number = np.append(np.searchsorted(kept, into), -1).astype(np.int32)
    return number[room]


def _merge(count: int, peak: Array, passages: dict[tuple[int, int], _Passage], ratio: float, width: float) -> Array:
    """(count,) the room that each ends up in."""
    into = np.arange(count)
    peak = peak.copy()

    def score(pair: tuple[int, int]) -> float:
        passage = passages[pair]
        wide = 2 * passage.half_width >= width and not passage.lintel
        share = passage.half_width / min(peak[pair[0]], peak[pair[1]])
        return max(share * (UNDER_LINTEL if passage.lintel else 1.0), 1.0 if wide else 0.0)

    scores = {pair: score(pair) for pair in passages}
    while scores:
        pair = max(scores, key=lambda p: (scores[p], p))
        if scores[pair] < ratio:
            break
        keep, gone = pair
        between = passages.pop(pair)
        larger = keep if peak[keep] >= peak[gone] else gone
        into[into == gone] = keep
        peak[keep] = max(peak[keep], peak[gone])
        del scores[pair]
        for old in [p for p in passages if keep in p or gone in p]:
            mine = keep if keep in old else gone
            other = old[0] if old[1] == mine else old[1]
            passage = passages.pop(old)
            scores.pop(old, None)
            if mine != larger and between.half_width < passage.half_width:
                passage = between  # the widest place of the two is reached through both passages
            new = (min(keep, other), max(keep, other))
            if new not in passages or passage.half_width > passages[new].half_width:
                passages[new] = passage
            scores[new] = score(new)
    return into


def _rows_by_room(label: Array, half_width: Array, count: int) -> list[Array]:
    """Navigable cells of each room, widest place first."""
    order = np.lexsort((-half_width, label))
    return np.split(order, np.searchsorted(label[order], np.arange(count + 1)))[1:-1]


def _neighbours(navigable: VoxelGrid, label: Array) -> list[tuple[int, int]]:
    """Pairs of rooms with adjacent navigable cells."""
    found = []
    for step in ((1, 0, 0), (0, 1, 0), (0, 0, 1)):
        other = navigable.rows(navigable.cells.astype(np.int64) + step)
        a, b = label[other >= 0], label[other[other >= 0]]
        meet = (a >= 0) & (b >= 0) & (a != b)
        found.append(np.sort(np.column_stack([a[meet], b[meet]]), axis=1))
    return [(int(a), int(b)) for a, b in np.unique(np.concatenate(found), axis=0)]


def _passage(
    navigable: VoxelGrid, half_width: Array, first: Array, second: Array, scratch: Array, above: Array, ceiling: float
) -> _Passage:
    """The narrowest place on the widest way between two rooms, given by their cells, widest place first."""
    rows = np.concatenate([first, second])
    rows = rows[np.argsort(-half_width[rows], kind="stable")]
    offsets = moore().stencil[0]
    at = kernel.saddle(navigable.cells, *navigable._bricks, offsets, rows, first[0], second[0], scratch)
    if at < 0:
        return _Passage(0.0, False)
    steps = np.arange(-int(0.4 / navigable.edge), int(0.4 / navigable.edge) + 1)
    window = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    near = navigable.rows(navigable.cells[at] + window)
    height = above[near[near >= 0]]
    seen = height[height > 0]
    # A lintel is as deep as the wall, a fifth of the window; single low points are none.
    lintel = ceiling > 0 and len(seen) > 0 and float(np.quantile(seen, 0.15)) <= ceiling - LINTEL
    return _Passage(float(half_width[at]), lintel)
