"""Zones: the rooms of a map cut finer, where people and robots disagree about what a room is (beyond the thesis: docs/adr/0047).

The merges that made rooms of areas are a tree. Cut at the probability of a door it gives the rooms; cut lower, their zones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from topomerge.extraction.plans.storey_plan import Merge
from topomerge.types import Array, TopometricMap, select_lowest_of_column

# Down to .1 the tree gives more, but then a piece of floor in an opening parts a cubicle from its aisle, and their door is
# lost (docs/adr/0047).
ZONE_LEVEL = 0.2  # up to this probability of a door between them two areas are one zone


def compute_merge_levels(merges: Sequence[Merge], pairs: Array) -> Array:
    """Compute (n,) the probability at which two areas became parts of one room: the largest of the merges that led there; 1 where
    they did not.

    Args:
        merges: in their order.
        pairs: (n, 2) areas.
    """
    level = np.ones(len(pairs))
    if not len(pairs) or not merges:
        return level
    of = np.arange(max(int(pairs.max()), *(max(a, b) for a, b, _ in merges)) + 1)
    height = np.zeros(len(of))
    for a, b, probability in merges:
        kept, absorbed = of[a], of[b]
        height[kept] = max(probability, height[kept], height[absorbed])
        ends = np.sort(of[pairs], axis=1)
        level[(ends == sorted((kept, absorbed))).all(axis=1)] = height[kept]
        of[of == absorbed] = kept
    return level


def find_zones(map: TopometricMap, level: float = ZONE_LEVEL) -> Array:
    """Find the zone of each area: the parts of rooms that a door parts with more than a probability.

    Args:
        level: that probability; from that of the rooms' doors on, rooms have one zone each.

    Returns:
        (A,) int64, numbered from 0 in the order of the rooms and their areas.
    """
    zone = np.arange(len(map.areas))
    for a, b in map.narrows["rooms"][map.narrows["confidence"] <= level].tolist():
        zone[zone == zone[b]] = zone[a]
    by_room = np.lexsort((np.arange(len(zone)), map.areas["room"]))
    _, first, of = np.unique(zone[by_room], return_index=True, return_inverse=True)
    out = np.empty(len(zone), np.int64)
    out[by_room] = np.argsort(np.argsort(first))[of.ravel()]
    return out


def cut_zones(map: TopometricMap, level: float = ZONE_LEVEL) -> TopometricMap:
    """Cut the rooms of a map into their zones: a map whose rooms they are, with an edge where two zones of a room meet.

    What is known of a room (its storey, height and probabilities) is said of each of its zones.

    Args:
        level: as of `find_zones`.
    """
    assert map.navigable_area is not None
    zone = find_zones(map, level)
    bare = np.setdiff1d(np.arange(len(map.rooms)), map.areas["room"])
    count = int(zone.max(initial=-1)) + 1
    owner = np.append(np.zeros(count, np.int64), bare)
    owner[zone] = map.areas["room"]
    # No least size: zones below 1 m2 as parts of their neighbour lose (IoU .788 for .814: docs/adr/0047).
    order = np.argsort(owner, kind="stable")
    number, owner = np.argsort(order), owner[order]
    zone = number[zone]
    floor = np.append(zone, -1)[map.navigable_area]
    places = _ZonePlaces(map, floor, owner)
    floor = np.where((floor < 0) & (map.navigable_room >= 0), places.first[map.navigable_room], floor)
    cells = places.find(map.grid.compute_centroids(), map.room)
    edges, windows, marks = map.edges.copy(), map.windows.copy(), map.landmarks.table.copy()
    for table in (edges, windows):
        table["rooms"] = np.column_stack([places.find(table["centre"], table["rooms"][:, k]) for k in (0, 1)])
    marks["room"] = places.find(np.nan_to_num(marks["position"]), marks["room"])
    areas, narrows = map.areas.copy(), map.narrows.copy()
    areas["room"] = zone
    ends = zone[narrows["rooms"]]
    apart = ends[:, 0] != ends[:, 1]
    openings = narrows[apart]
    openings["rooms"] = np.sort(ends[apart], axis=1)
    edges = np.concatenate([edges, openings])
    edges["rooms"] = np.sort(edges["rooms"], axis=1)
    edges = edges[np.lexsort((*edges["centre"].T[::-1], *edges["rooms"].T[::-1]))]
    return replace(
        map, room=cells, navigable_room=floor.astype(np.int32), rooms=_measure_zones(map, floor, cells, owner), edges=edges,
        areas=areas, narrows=narrows[~apart], windows=windows, landmarks=replace(map.landmarks, table=marks),
    )  # fmt: skip


class _ZonePlaces:
    """Which zone of a room a place is nearest to.

    Args:
        floor: (m,) zone of each navigable cell, -1 none.
        owner: (Z,) room of each zone, ascending.
    """

    def __init__(self, map: TopometricMap, floor: Array, owner: Array) -> None:
        self.first = np.append(np.searchsorted(owner, np.arange(len(map.rooms))), -1).astype(np.int32)
        cut = np.flatnonzero(np.bincount(owner, minlength=len(map.rooms)) > 1).tolist()
        rows = {room: np.flatnonzero((map.navigable_room == room) & (floor >= 0)) for room in cut}
        self.floor = {room: floor[own] for room, own in rows.items()}
        self.trees = {r: cKDTree(map.navigable.compute_centroids(map.navigable.cells[own])) for r, own in rows.items()}

    def find(self, places: Array, room: Array) -> Array:
        """Find the (n,) int32 zone of places (n, 3) m in rooms (n,), -1 where there is no room."""
        out: Array = self.first[room]
        for number, tree in self.trees.items():
            own = np.flatnonzero(room == number)
            if len(own):
                out[own] = self.floor[number][tree.query(places[own])[1]]
        return out


def _measure_zones(map: TopometricMap, floor: Array, cells: Array, owner: Array) -> Array:
    """Return (Z,) ROOM_DTYPE: what is known of the room of each zone, with the measures of its own floor and cells."""
    rooms, lowest = map.rooms[owner].copy(), select_lowest_of_column(map.navigable)
    middles, edge = map.navigable.compute_centroids(), map.grid.edge
    floors = np.bincount(floor[lowest][floor[lowest] >= 0], minlength=len(owner))
    whole = np.bincount(owner, floors, len(map.rooms))
    for z in np.flatnonzero(np.bincount(owner)[owner] > 1).tolist():
        rows, own = np.flatnonzero(floor == z), map.grid.cells[cells == z]
        box = own if len(own) else map.grid.locate(middles[rows])
        rooms["centroid"][z], rooms["cells"][z] = middles[rows].mean(axis=0), len(own)
        rooms["area"][z] *= floors[z] / max(whole[owner[z]], 1)
        rooms["volume"][z] = rooms["area"][z] * rooms["height"][z]
        rooms["lo"][z], rooms["hi"][z] = (map.grid.origin + at * edge for at in (box.min(axis=0), box.max(axis=0) + 1))
    return rooms
