"""k-step context: what lies around a room, appended to what it is (method 3; finished thesis).

Averaging the neighbours' descriptors is cheaper but blurs: prototypes lost recall by it, so joining geometry is the default.
"""

from __future__ import annotations

import numpy as np

from topomerge.embedding.room_cells import Descriptor, joined, neighbours
from topomerge.embedding.turns import TurnedRows, numbers
from topomerge.errors import InputError
from topomerge.types import Array, TopometricMap

CONTEXT_KINDS = ("join", "mean")
MOST_STEPS = 20  # no room of a building is much farther from another


def with_context(descriptor: Descriptor, k: int = 1, how: str = "join") -> Descriptor:
    """A descriptor of (k + 1) D columns: the room's own, and that of its surroundings within 1, ..., k steps.

    Args:
        descriptor: of D columns.
        k: steps over doors and stairs; 0 gives the descriptor back.
        how: ``"join"``: the geometry of all rooms within reach is joined and described as one room (thesis); ``"mean"``: the
            mean of their descriptors.

    Raises:
        InputError: k is no whole number from 0 to `MOST_STEPS`, `how` is unknown; or, when called, the descriptor gives rows
            for quarter turns, which see their surroundings themselves.
    """
    if not isinstance(k, int) or isinstance(k, bool) or not 0 <= k <= MOST_STEPS:
        raise InputError(f"steps of context must be a whole number from 0 to {MOST_STEPS}, not {k}")
    if how not in CONTEXT_KINDS:
        raise InputError(f"context {how!r}: {', '.join(CONTEXT_KINDS)} are possible")
    if k == 0:
        return descriptor

    def describe(map: TopometricMap) -> Array:
        rows = descriptor(map)
        if isinstance(rows, TurnedRows):
            raise InputError("steps of context are for descriptors of single rooms; this one sees what is around: leave k out")
        parts = [rows]
        for step in range(1, k + 1):
            around = neighbours(map, step)
            parts.append(_joined(descriptor, map, around, rows) if how == "join" else _mean(rows, around))
        return np.concatenate(parts, axis=1)

    return describe


def _mean(rows: Array, around: list[Array]) -> Array:
    return np.stack([rows[rooms].mean(axis=0) for rooms in around]) if len(rows) else rows


def _joined(descriptor: Descriptor, map: TopometricMap, around: list[Array], rows: Array) -> Array:
    """Descriptor of each union; rooms with the same surroundings share the work."""
    by_rooms: dict[tuple[int, ...], Array] = {}
    out = np.zeros_like(rows)
    for room, rooms in enumerate(around):
        key = tuple(rooms.tolist())
        if key not in by_rooms:
            by_rooms[key] = numbers(descriptor(joined(map, rooms)))[0] if len(key) > 1 else rows[room]
        out[room] = by_rooms[key]
    return out
