"""Doors where a drawing shows them (beyond the thesis: docs/adr/0052).

The cut finds that two rooms meet, and where their border is widest. A drawing says where the door is, and that there are two.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from topomerge.extraction.topology import DOOR_MOST_WIDTH, LEVEL_KINDS
from topomerge.types import EDGE_DTYPE, Array, TopometricMap

SURE_DOOR = 0.5  # probability from which a place is of a door
PLACE_STEP = 0.05  # m between places that are looked at
BOTH_ROOMS = 0.35  # m from a place of a door to the farther of its two rooms, at most
LEAST_WIDTH = 0.4  # m, of a door
SAME_LEVEL = 0.5  # m between a drawn door and the floor of its storey


@dataclass(frozen=True)
class DrawnDoor:
    """A door that a drawing shows between two rooms.

    Args:
        rooms: the smaller number first.
        centre: (2,) m; width: m; direction: rad, of the wall's normal.
        probability: mean over its places.
    """

    rooms: tuple[int, int]
    centre: Array
    width: float
    direction: float
    probability: float


def place_drawn_doors(map: TopometricMap, drawn: Array) -> TopometricMap:
    """Return the map with the doors that a drawing shows between two of its rooms, in place of what the cut found between these.

    Args:
        drawn: (k, 4) places on the floor, m, and how probably the drawing shows a door there.
    """
    rows = []
    kept = np.ones(len(map.edges), bool)
    level = np.isin(map.edges["kind"], LEVEL_KINDS)
    for number, storey in enumerate(map.storeys):
        here = drawn[(drawn[:, 3] >= SURE_DOOR) & (np.abs(drawn[:, 2] - storey["floor"]) < SAME_LEVEL)]
        for door in find_drawn_doors(map, number, here):
            same = level & (np.sort(map.edges["rooms"], axis=1) == door.rooms).all(axis=1)
            kept &= ~same
            rows.append(_build_edge(map.edges[same], door, float(storey["floor"])))
    if not rows:
        return map
    edges = np.concatenate([map.edges[kept], *rows])
    order = np.lexsort((*edges["centre"].T[::-1], edges["rooms"][:, 1], edges["rooms"][:, 0]))
    return replace(map, edges=edges[order])


def find_drawn_doors(map: TopometricMap, storey: int, drawn: Array) -> Iterator[DrawnDoor]:
    """Find the doors between two rooms of a storey that places (k, 4) of doors show.

    A place is of the two rooms that are nearest to it, if both are near. Connected places of one pair of rooms are one door.
    """
    rooms = np.flatnonzero(map.rooms["storey"] == storey)
    if not len(drawn) or len(rooms) < 2:
        return
    low = drawn[:, :2].min(axis=0)
    cells, of = np.unique(np.floor((drawn[:, :2] - low) / PLACE_STEP).astype(np.int64), axis=0, return_inverse=True)
    chance = np.bincount(of.ravel(), drawn[:, 3]) / np.bincount(of.ravel())
    places = low + (cells + 0.5) * PLACE_STEP
    floor = map.navigable.compute_centroids()[:, :2]
    far, nearest = np.full((len(places), len(rooms)), np.inf), np.zeros((len(places), len(rooms), 2))
    for k, room in enumerate(rooms.tolist()):
        own = floor[map.navigable_room == room]
        if len(own):
            far[:, k], row = cKDTree(own).query(places, distance_upper_bound=BOTH_ROOMS)
            nearest[:, k] = own[np.minimum(row, len(own) - 1)]
    two = np.sort(np.argsort(far, axis=1)[:, :2], axis=1)
    met = np.isfinite(np.take_along_axis(far, two, axis=1)).all(axis=1)
    for pair in np.unique(two[met], axis=0):
        rows = np.flatnonzero(met & (two == pair).all(axis=1))
        raster = np.zeros(cells[rows].max(axis=0) + 1, bool)
        raster[tuple(cells[rows].T)] = True
        label, count = ndimage.label(raster, np.ones((3, 3)))
        for number in range(1, count + 1):
            part = rows[label[tuple(cells[rows].T)] == number]
            way = (nearest[part, pair[1]] - nearest[part, pair[0]]).mean(axis=0)
            direction = float(np.arctan2(way[1], way[0]) % np.pi)
            along = places[part] @ (-np.sin(direction), np.cos(direction))
            if (width := float(np.ptp(along)) + PLACE_STEP) >= LEAST_WIDTH:
                middle = places[part].mean(axis=0)
                yield DrawnDoor((int(rooms[pair[0]]), int(rooms[pair[1]])), middle, width, direction, float(chance[part].mean()))


def _build_edge(found: Array, door: DrawnDoor, floor: float) -> Array:
    """Return an edge of a door, with the height and state of the surest edge that the cut found there."""
    out = np.zeros(1, EDGE_DTYPE)
    out["open"] = True
    if len(found):
        out[0] = found[found["confidence"].argmax()]
    out["rooms"], out["centre"], out["width"], out["direction"] = door.rooms, (*door.centre, floor), door.width, door.direction
    out["kind"] = "door" if door.width <= DOOR_MOST_WIDTH else "opening"
    out["confidence"] = max(float(out["confidence"][0]), door.probability)
    out["lower"] = out["upper"] = out["centre"]
    return out
