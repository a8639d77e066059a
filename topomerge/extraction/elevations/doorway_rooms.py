"""Doorways on walls with the rooms on their two sides: floor tells what lies behind (beyond the thesis: docs/adr/0018)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from topomerge.extraction.distinct_doors import rooms_at
from topomerge.extraction.doors import DOOR_MOST_WIDTH
from topomerge.extraction.elevations.doorways import DOORWAY_DTYPE, STOOD, coloured_classes, door_places, doorways
from topomerge.extraction.elevations.elevation import ALONG, Elevations
from topomerge.extraction.elevations.wall_network import PLACES
from topomerge.extraction.plans.inner_doors import INNER_DOOR_DTYPE
from topomerge.types import Array, TopometricMap

SPOTS_BEFORE = (0.2, 0.35, 0.5)  # m before a face: there its room's floor lies
BEYOND = (0.1, 1.0)  # m from a wall: there the other room begins
SURE_INSIDE = 0.91  # probability of a door, the mean along a doorway, from which on it parts what was one room
SAME_ROOM = 0.5  # of the places behind it
LARGEST_PARTED = 30.0  # m2: the plan misses the doors of toilets and stores, and the room on their other side is small, too


def rooms_before(map: TopometricMap, walls: Elevations) -> Array:
    """(n / 2, 3) int64 room on whose floor spots before each place along all strips lie, -1 none."""
    sizes = np.diff(walls.first) // PLACES
    face = walls.faces[np.repeat(np.arange(len(sizes)), sizes)]
    along = (np.arange(len(face)) - np.repeat(walls.first[:-1] // PLACES, sizes) + 0.5) * (PLACES * ALONG)
    at = face["start"] + along[:, None] * face["along"]
    spots = [np.column_stack([at - off * face["out"], face["floor"]]) for off in SPOTS_BEFORE]
    return np.stack([rooms_at(map, spot) for spot in spots], axis=1)


def doorways_of(map: TopometricMap, walls: Elevations, doors: Array) -> Array:
    """(D,) DOORWAY_DTYPE of a map's walls with the rooms on both sides.

    Args:
        doors: (n / 2, 3) of `door_places`.
    """
    return with_other_room(map, doorways(walls, doors, rooms_before(map, walls)))


def with_other_room(map: TopometricMap, ways: Array) -> Array:
    """The doorways (D,) DOORWAY_DTYPE with the room behind those that one face shows, -1 where there is none but their own."""
    ways = ways.copy()
    if not len(ways):
        return ways
    floor = map.navigable.centroids()
    storey = map.rooms["storey"][map.navigable_room]
    trees = {s: np.flatnonzero((storey == s) & (map.navigable_room >= 0)) for s in range(len(map.storeys))}
    looked = {s: cKDTree(floor[rows, :2]) for s, rows in trees.items() if len(rows)}
    for way in ways:
        s = int(map.rooms["storey"][way["rooms"][0]])
        if way["rooms"][1] >= 0 or s not in looked:
            continue
        far, row = looked[s].query(_places_behind(way), distance_upper_bound=STOOD)
        rows = trees[s][np.minimum(row, len(trees[s]) - 1)]
        label = np.where(np.isfinite(far), map.navigable_room[rows], -1)
        other = label[(label >= 0) & (label != way["rooms"][0])]
        if len(other):
            way["rooms"][1] = np.bincount(other).argmax()
    return ways


def doors_inside_rooms(map: TopometricMap, walls: Elevations, classes: Array) -> Array:
    """(D,) INNER_DOOR_DTYPE: doors that walls show surely, with the same room before and behind: the plan did not part there.

    Args:
        walls, classes: as of `with_wall_doors`.
    """
    ways = doorways(walls, door_places(walls, classes), rooms_before(map, walls))
    sure = (ways["rooms"][:, 1] < 0) & (ways["mean"] >= SURE_INSIDE) & (ways["width"] <= DOOR_MOST_WIDTH)
    sure &= map.rooms["area"][ways["rooms"][:, 0]] <= LARGEST_PARTED
    ways = with_other_room(map, ways[sure])
    ways = ways[ways["rooms"][:, 1] < 0]
    own = np.array([bool(np.mean(_behind(map, way) == way["rooms"][0]) >= SAME_ROOM) for way in ways], bool)
    out = np.zeros(int(own.sum()), INNER_DOOR_DTYPE)
    out["centre"], out["normal"], out["width"] = ways["centre"][own], ways["out"][own], ways["width"][own]
    return out


def _behind(map: TopometricMap, way: Array) -> Array:
    """(k,) room of places behind a doorway, -1 none."""
    storey = map.rooms["storey"][way["rooms"][0]]
    rows = np.flatnonzero((map.navigable_room >= 0) & (map.rooms["storey"][map.navigable_room] == storey))
    far, row = cKDTree(map.navigable.centroids(map.navigable.cells[rows])[:, :2]).query(_places_behind(way))
    return np.where(far < STOOD, map.navigable_room[rows[row]], -1)


def _places_behind(way: Array) -> Array:
    """(k, 2) m, behind a doorway as its first room sees it."""
    steps = np.arange(BEYOND[0], BEYOND[1] + 0.05, 0.1)
    side = np.array([-way["out"][1], way["out"][0]]) * float(way["width"]) / 4
    places = way["centre"][:2] + side * np.array([[-1.0], [0.0], [1.0]]) + steps[:, None, None] * way["out"]
    return np.asarray(places.reshape(-1, 2))


def colour_doorways(map: TopometricMap, walls: Elevations, classes: Array, others: Array, reach: float) -> Array:
    """(D,) DOORWAY_DTYPE: doorways between two rooms that the colours of walls show and their shape does not.

    Args:
        others: (k, 3) m, doorways that shape or the plan shows; reach: m from them, where they are the same.
    """
    if walls.colours is None:
        return np.zeros(0, DOORWAY_DTYPE)
    ways = doorways(walls, door_places(walls, coloured_classes(walls, classes)), rooms_before(map, walls), by_shape=False)
    apart = ways["centre"][:, None] - others
    far = (np.linalg.norm(apart[..., :2], axis=2) > reach) | (np.abs(apart[..., 2]) > reach)
    ways = with_other_room(map, ways[far.all(axis=1)])
    return ways[ways["rooms"][:, 1] >= 0]
