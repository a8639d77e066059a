"""Doors that somebody walked through: the way of the sensor proves them, whatever stands there now (beyond the thesis)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from topomerge.types import EDGE_DTYPE, Array, TopometricMap

WAY_STEP = 1.5  # m between two places of the sensor: farther apart they are no way
SENSOR_HEIGHT = (0.2, 2.2)  # m of a carried sensor above the floor
STOOD = 0.35  # m from above: a place this near to a floor stands on it
SAME_DOOR = 1.2  # m between where a door is and where somebody changed rooms
WALKED_CHANCE = 0.98  # of a door that was walked through
ONLY_WALKED_CHANCE = 0.7  # where neither plan nor wall shows one: 30 of 41 such doors of 48 validation scans are doors
USUAL_WIDTH = 0.9  # m, of a door that nothing else shows
WALL_SHARE = 0.3  # of the changes of rooms may lead through walls: of more, the way is of another building


def with_walked_doors(map: TopometricMap, places: Array) -> tuple[TopometricMap, str]:
    """The map with the doors through which a sensor was carried, and what the user should know about its way, or nothing.

    Args:
        places: (n, 3) m, where the sensor was, in its order.
    """
    crossings = room_changes(map, places)
    if not crossings:
        return map, ""
    blocked = [_wall_between(map, a, b) for _, a, b in crossings]
    edges = map.edges.copy()
    at_edge = [_edge_at(edges, rooms, (a + b) / 2) for rooms, a, b in crossings]
    strange = [wall and at < 0 for wall, at in zip(blocked, at_edge, strict=True)]
    if np.mean(strange) > WALL_SHARE:
        return map, "the sensor's way leads through walls: it proves no doors (is it of another scan?)"
    edges["open"][[at for at in at_edge if at >= 0]] = True
    edges["confidence"][[at for at in at_edge if at >= 0]] = WALKED_CHANCE
    for (rooms, a, b), at, wall in zip(crossings, at_edge, blocked, strict=True):
        if at < 0 and not wall and _edge_at(edges, rooms, (a + b) / 2) < 0:
            edges = np.append(edges, _door(map, rooms, a, b))
    order = np.lexsort((*edges["centre"].T[::-1], edges["rooms"][:, 1], edges["rooms"][:, 0]))
    return replace(map, edges=edges[order]), ""


def room_changes(map: TopometricMap, places: Array) -> list[tuple[tuple[int, int], Array, Array]]:
    """Rooms (the smaller number first) between which a sensor was carried, with the last place in the one and the first in the
    other, m. Places above no floor are passed over; a way ends where the next place is farther than `WAY_STEP`."""
    places = np.asarray(places, np.float64)
    places = places[np.isfinite(places).all(axis=1)]
    room = rooms_under(map, places)
    changes = []
    last, walked = -1, 0.0
    for i in range(len(places)):
        step = float(np.hypot(*(places[i] - places[i - 1])[:2])) if i else 0.0
        walked = walked + step if step <= WAY_STEP else np.inf
        if room[i] < 0:
            continue
        if last >= 0 and room[i] != room[last] and walked <= 2 * WAY_STEP:
            pair = sorted((int(room[last]), int(room[i])))
            changes.append(((pair[0], pair[1]), places[last], places[i]))
        last, walked = i, 0.0
    return [change for change in changes if len({int(s) for s in map.rooms["storey"][list(change[0])]}) == 1]


def rooms_under(map: TopometricMap, places: Array) -> Array:
    """(n,) the room on whose floor somebody with the sensor at each place (n, 3), m, stood; -1 none."""
    out = np.full(len(places), -1, np.int32)
    rows = np.flatnonzero(map.navigable_room >= 0)
    if not len(rows) or not len(places):
        return out
    floor = map.navigable.centroids(map.navigable.cells[rows])
    storey = map.rooms["storey"][map.navigable_room[rows]]
    for s in np.unique(storey):
        own = rows[storey == s]
        far, nearest = cKDTree(floor[storey == s, :2]).query(places[:, :2])
        above = places[:, 2] - floor[storey == s][nearest, 2]
        stands = (far <= STOOD) & (above > SENSOR_HEIGHT[0]) & (above < SENSOR_HEIGHT[1])
        out[stands] = map.navigable_room[own[nearest[stands]]]
    return out


def _edge_at(edges: Array, rooms: tuple[int, int], place: Array) -> int:
    """Row of the edge between two rooms that is nearest to a place, within reach; -1 none."""
    own = np.flatnonzero((np.sort(edges["rooms"], axis=1) == rooms).all(axis=1))
    if not len(own):
        return -1
    apart = np.hypot(*(edges["centre"][own] - place)[:, :2].T) - edges["width"][own] / 2
    return int(own[apart.argmin()]) if apart.min() <= SAME_DOOR else -1


def _wall_between(map: TopometricMap, a: Array, b: Array) -> bool:
    """Do occupied cells stand across the straight way between two places of the sensor, at its height?"""
    steps = max(int(np.ceil(np.linalg.norm(b - a) / (map.grid.edge / 2))), 2)
    way = a + np.linspace(0, 1, steps)[:, None] * (b - a)
    cells = np.unique(map.grid.locate(way), axis=0)
    return bool(map.grid.contains(cells).any())


def _door(map: TopometricMap, rooms: tuple[int, int], a: Array, b: Array) -> Array:
    """An edge halfway between two places of the sensor, on the lower of the floors beneath."""
    out = np.zeros(1, EDGE_DTYPE)
    floor = min(float(map.storeys["floor"][map.rooms["storey"][r]]) for r in rooms)
    out["rooms"], out["centre"], out["width"] = rooms, (*((a + b) / 2)[:2], floor), USUAL_WIDTH
    out["direction"] = np.arctan2(b[1] - a[1], b[0] - a[0]) % np.pi
    out["kind"], out["open"], out["confidence"] = "door", True, ONLY_WALKED_CHANCE
    out["lower"] = out["upper"] = out["centre"]
    return out
