"""The occupied cells of each room, and rooms joined to one: what every geometric descriptor looks at."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from topomerge.embedding.turns import Rows
from topomerge.types import EDGE_DTYPE, ROOM_DTYPE, Array, TopometricMap

Descriptor = Callable[[TopometricMap], Rows]  # -> (R, D) float64, a row for each room; or one for each quarter turn of it


def rows_of(labels: Array, count: int) -> list[Array]:
    """Rows of each label 0..count-1, ascending."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.searchsorted(labels[order], np.arange(count + 1)))[1:-1]


def room_cells(map: TopometricMap) -> list[Array]:
    """(n, 3) int32 occupied cells of each room; its navigable ones where it has no other."""
    walk = rows_of(map.navigable_room, len(map.rooms))
    seen = rows_of(map.room, len(map.rooms))
    return [map.grid.cells[s] if len(s) else map.navigable.cells[w] for s, w in zip(seen, walk, strict=True)]


def neighbours(map: TopometricMap, steps: int = 1) -> list[Array]:
    """Ascending rooms within `steps` doors or stairs of each room, the room itself among them."""
    count = len(map.rooms)
    beside: list[set[int]] = [set() for _ in range(count)]
    for a, b in map.edges["rooms"].tolist():
        beside[a].add(b)
        beside[b].add(a)
    neighbourhoods = []
    for room in range(count):
        reached, border = {room}, {room}
        for _ in range(steps):
            border = {n for r in border for n in beside[r]} - reached
            reached |= border
        neighbourhoods.append(np.array(sorted(reached)))
    return neighbourhoods


def joined(map: TopometricMap, members: Array) -> TopometricMap:
    """A map whose only room is the union of the given ones; the doors that lead out of them are lost."""
    occupied = np.flatnonzero(np.isin(map.room, members))
    walk = np.flatnonzero(np.isin(map.navigable_room, members))
    rows = map.rooms[members]
    share = rows["area"] / max(rows["area"].sum(), 1e-9)
    room = np.zeros(1, ROOM_DTYPE)
    for name in ("area", "volume", "cells"):
        room[name] = rows[name].sum()
    for name in ("height", "completeness"):
        room[name] = (rows[name] * share).sum()
    room["centroid"] = (rows["centroid"] * share[:, None]).sum(axis=0)
    room["lo"], room["hi"] = rows["lo"].min(axis=0), rows["hi"].max(axis=0)
    room["storey"] = rows["storey"].min()
    return replace(
        map,
        grid=map.grid.subset(occupied),
        room=np.zeros(len(occupied), np.int32),
        navigable=map.navigable.subset(walk),
        navigable_room=np.zeros(len(walk), np.int32),
        rooms=room,
        edges=np.zeros(0, EDGE_DTYPE),
        areas=map.areas[:0],
        navigable_area=None,
        narrows=np.zeros(0, EDGE_DTYPE),
        windows=map.windows[:0],
        free=None,
        provenance=None,
    )
