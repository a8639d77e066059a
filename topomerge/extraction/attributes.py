"""Attributes of a map, once its rooms are cut: odds of rooms, doors with their kinds and states, windows (beyond the thesis)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import edt
import numpy as np
from scipy.spatial import cKDTree

from topomerge.extraction.drawn_doors import place_drawn_doors
from topomerge.extraction.elevations.doorways import StoreyWalls
from topomerge.extraction.elevations.wall_doors import add_wall_doors
from topomerge.extraction.elevations.windows import add_windows
from topomerge.extraction.plans.storey_plan import Floor
from topomerge.extraction.room_odds import add_room_probabilities
from topomerge.extraction.scan import Scan
from topomerge.extraction.topology import LEVEL_KINDS
from topomerge.types import EDGE_DTYPE, Array, TopometricMap, compute_extent, select_rooms

# A doorway joins the two rooms that lie across it, once (beyond the thesis).
#
# What is seen on a wall, in the plan, and by a sensor's way may be one doorway told twice, between different rooms: a sliver of a
# third room often lies in it. Of the doors of 60 simulated validation maps a twentieth were such doubles.

# Many doorways were told twice, with a sliver of a third room between (docs/adr/0020).
ONE_DOORWAY = 0.5  # m between the centres of what is one doorway
SIDES_AT = (0.4, 0.6, 0.8)  # m before and behind a door, where its rooms are looked for


def select_distinct_doors(map: TopometricMap) -> TopometricMap:
    """Return the map with each doorway once: of edges in one place the one whose rooms lie across it, of these the surest."""
    level = np.flatnonzero(np.isin(map.edges["kind"], LEVEL_KINDS))
    doors = map.edges[level]
    same = cKDTree(doors["centre"]).query_ball_point(doors["centre"], ONE_DOORWAY) if len(doors) else ()
    single = np.ones(len(map.edges), bool)
    single[level] = False
    for k in np.lexsort((-doors["confidence"], ~_is_between_rooms(map, doors))).tolist():
        single[level[k]] = not single[level[same[k]]].any()
    return map if single.all() else replace(map, edges=map.edges[single])


def _is_between_rooms(map: TopometricMap, doors: Array) -> Array:
    """Return (n,) bool: do the rooms of each door lie before and behind it?"""
    normal = np.column_stack([np.cos(doors["direction"]), np.sin(doors["direction"]), np.zeros(len(doors))])
    requested, out = np.sort(doors["rooms"], axis=1), np.zeros(len(doors), bool)
    for reach in SIDES_AT:
        sides = [find_rooms_at(map, doors["centre"] + way * reach * normal) for way in (1, -1)]
        out |= (np.sort(np.column_stack(sides), axis=1) == requested).all(axis=1)
    return out


def find_rooms_at(map: TopometricMap, floor: Array) -> Array:
    """Return (n,) int64 room of the map at each place (n, 3) m of a floor, -1 none. Floors of two maps differ by up to two
    cells."""
    cells = map.navigable.locate(floor)
    out = np.full(len(cells), -1, np.int64)
    for up in (0, 1, -1, 2, -2):
        rows = map.navigable.find_rows(cells + (0, 0, up))
        missing = (out < 0) & (rows >= 0)
        out[missing] = map.navigable_room[rows[missing]]
    return out


# Doors that somebody walked through: the way of the sensor proves them, whatever stands there now (beyond the thesis).

Crossing = tuple[tuple[int, int], Array, Array]  # as `find_room_changes` gives them
WAY_STEP = 1.5  # m between two places of the sensor: farther apart they are no way
SENSOR_HEIGHT = (0.2, 2.2)  # m of a carried sensor above the floor
STOOD = 0.35  # m from above: a place this near to a floor stands on it
SAME_DOOR = 1.2  # m between where a door is and where somebody changed rooms
WALKED_CHANCE = 0.98  # of a door that was walked through
ONLY_WALKED_CHANCE = 0.7  # where neither plan nor wall shows one: 30 of 41 such doors of 48 validation scans are doors
USUAL_WIDTH = 0.9  # m, of a door that nothing else shows
WALL_SHARE = 0.3  # of the changes of rooms may lead through walls: of more, the way is of another building
# A door that was shut later, which neither plan nor wall shows, is wall in the map: a way that fits its map but for one place.
SHUT_LATER_CHANCE = 0.85  # 131 of 149 doors that 56 validation maps were robbed of, and 4 of 4 that they lacked, are true
ON_FLOORS = 0.97  # of the places of a way that fits its map: .98 and more of those of 24 validation scans
THIN_WALL = 0.35  # m along the way: thicker is furniture, or a wall along which the way drifted
FLOOR_BESIDE = 0.4  # m from its middle: the floors of its rooms lie on both sides, or it is a cupboard or a shaft
NO_OTHER_DOOR = 1.2  # m about it: a way that drifted leads through the wall beside the door


def add_walked_doors(map: TopometricMap, places: Array) -> tuple[TopometricMap, str]:
    """Return the map with the doors through which a sensor was carried, and what the user should know about its way, or nothing.

    Args:
        places: (n, 3) m, where the sensor was, in its order.
    """
    crossings = find_room_changes(map, places)
    if not crossings:
        return map, ""
    blocked = [len(_find_obstacles(map, a, b)) > 0 for _, a, b in crossings]
    edges = map.edges.copy()
    at_edge = [_find_edge_at(edges, rooms, (a + b) / 2) for rooms, a, b in crossings]
    strange = [wall and at < 0 for wall, at in zip(blocked, at_edge, strict=True)]
    later = _find_shut_door(map, places, [crossing for crossing, odd in zip(crossings, strange, strict=True) if odd])
    if np.mean(strange) > WALL_SHARE and not len(later):
        return map, "the sensor's way leads through walls: it proves no doors (is it of another scan?)"
    edges["open"][[at for at in at_edge if at >= 0]] = True
    edges["confidence"][[at for at in at_edge if at >= 0]] = WALKED_CHANCE
    for (rooms, a, b), at, wall in zip(crossings, at_edge, blocked, strict=True):
        if at < 0 and not wall and _find_edge_at(edges, rooms, (a + b) / 2) < 0:
            edges = np.append(edges, _build_door(map, rooms, a, b))
    for door in later:
        if _find_edge_at(edges, (int(door["rooms"][0]), int(door["rooms"][1])), door["centre"]) < 0:  # or the way was free once
            edges = np.append(edges, door)
    order = np.lexsort((*edges["centre"].T[::-1], edges["rooms"][:, 1], edges["rooms"][:, 0]))
    return replace(map, edges=edges[order]), ""


def _find_shut_door(map: TopometricMap, places: Array, strange: Sequence[Crossing]) -> Array:
    """Return, as EDGE_DTYPE, one shut door or none: where all changes of rooms through walls are, if that is one thin place away
    from other doors and the way is on floors everywhere. A way that is of another building, or drifted, leads through walls
    elsewhere, too; a wrong door is worse than a missing one."""
    none = np.zeros(0, EDGE_DTYPE)
    if not strange or np.mean(find_rooms_under(map, _select_finite(places)) >= 0) < ON_FLOORS:
        return none
    rooms, a, b = strange[0]
    wall = _find_obstacles(map, a, b)
    door = _build_door(map, rooms, a, b)
    door["centre"][0, :2] = (wall[0] + wall[-1])[:2] / 2
    door["lower"] = door["upper"] = door["centre"]
    door["open"], door["confidence"] = False, SHUT_LATER_CHANCE
    if (
        any(_find_edge_at(door, other, (c + d) / 2) < 0 for other, c, d in strange)
        or np.hypot(*(wall[-1] - wall[0])[:2]) > THIN_WALL
    ):
        return none
    beyond = FLOOR_BESIDE * (b - a) / np.hypot(*(b - a)[:2]) * (1, 1, 0)
    sides = find_rooms_at(map, door["centre"][0] + [-beyond, beyond])
    if sorted(sides.tolist()) != list(rooms):
        return none
    apart = map.edges["centre"] - door["centre"]
    near = (np.hypot(*apart[:, :2].T) < NO_OTHER_DOOR) & (np.abs(apart[:, 2]) < SENSOR_HEIGHT[1])
    return none if near.any() else door


def find_room_changes(map: TopometricMap, places: Array) -> list[Crossing]:
    """Find the rooms (the smaller number first) between which a sensor was carried, with the last place in the one and the first
    in the other, m. Places above no floor are passed over; a way ends where the next place is farther than `WAY_STEP`."""
    places = _select_finite(places)
    room = find_rooms_under(map, places)
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


def find_rooms_under(map: TopometricMap, places: Array) -> Array:
    """Return (n,) the room on whose floor somebody with the sensor at each place (n, 3), m, stood; -1 none."""
    out = np.full(len(places), -1, np.int32)
    rows = np.flatnonzero(map.navigable_room >= 0)
    if not len(rows) or not len(places):
        return out
    floor = map.navigable.compute_centroids(map.navigable.cells[rows])
    storey = map.rooms["storey"][map.navigable_room[rows]]
    for s in np.unique(storey):
        own = rows[storey == s]
        far, nearest = cKDTree(floor[storey == s, :2]).query(places[:, :2])
        above = places[:, 2] - floor[storey == s][nearest, 2]
        stands = (far <= STOOD) & (above > SENSOR_HEIGHT[0]) & (above < SENSOR_HEIGHT[1])
        out[stands] = map.navigable_room[own[nearest[stands]]]
    return out


def _select_finite(places: Array) -> Array:
    places = np.asarray(places, np.float64)
    finite: Array = places[np.isfinite(places).all(axis=1)]
    return finite


def _find_edge_at(edges: Array, rooms: tuple[int, int], place: Array) -> int:
    """Return the row of the edge between two rooms that is nearest to a place, within reach; -1 none."""
    own = np.flatnonzero((np.sort(edges["rooms"], axis=1) == rooms).all(axis=1))
    if not len(own):
        return -1
    apart = np.hypot(*(edges["centre"][own] - place)[:, :2].T) - edges["width"][own] / 2
    return int(own[apart.argmin()]) if apart.min() <= SAME_DOOR else -1


def _find_obstacles(map: TopometricMap, a: Array, b: Array) -> Array:
    """Return (k, 3) m: where the straight way between two places of the sensor, at its height, is in occupied cells."""
    steps = max(int(np.ceil(np.linalg.norm(b - a) / (map.grid.edge / 2))), 2)
    way = a + np.linspace(0, 1, steps)[:, None] * (b - a)
    inside: Array = way[map.grid.contains(map.grid.locate(way))]
    return inside


def _build_door(map: TopometricMap, rooms: tuple[int, int], a: Array, b: Array) -> Array:
    """Return an edge halfway between two places of the sensor, on the lower of the floors beneath."""
    out = np.zeros(1, EDGE_DTYPE)
    floor = min(float(map.storeys["floor"][map.rooms["storey"][r]]) for r in rooms)
    out["rooms"], out["centre"], out["width"] = rooms, (*((a + b) / 2)[:2], floor), USUAL_WIDTH
    out["direction"] = np.arctan2(b[1] - a[1], b[0] - a[0]) % np.pi
    out["kind"], out["open"], out["confidence"] = "door", True, ONLY_WALKED_CHANCE
    out["lower"] = out["upper"] = out["centre"]
    return out


# Small patches of floor that no door leads to are no rooms (beyond the thesis: docs/adr/0018).
#
# A bed, a counter, or the end of what a sensor saw through a window cut the floor of a room into patches. Rooms that somebody was
# in have doors, even small ones.

# Of 50 rooms below 4 m2 on 80 validation scans all 16 true ones have a door, 33 of 34 false ones have none (docs/adr/0018).
PATCH_AREA = 3.0  # m2, below which floor without a door is a patch


def remove_patches(map: TopometricMap, places: Array) -> TopometricMap:
    """Return the map in which patches of floor are of no room. Those that the sensor was on, and rooms that are alone on their
    storey, stay.

    Args:
        places: (n, 3) m, where the sensor was; may be empty.
    """
    count = len(map.rooms)
    reached = np.isin(np.arange(count), map.edges["rooms"]) | np.isin(np.arange(count), find_rooms_under(map, places))
    stays = reached | (map.rooms["area"] >= PATCH_AREA)
    storey = map.rooms["storey"]
    stays |= ~np.isin(storey, storey[stays])
    return map if stays.all() else select_rooms(map, stays)


# Strokes of letters painted on a grid are free floor between walls, too: narrow, and no door leads there (docs/adr/0047).

# Not all rooms in which no body fits: without these the IoU fell from .796 to .750 (docs/adr/0047).
STROKE_HALF_WIDTH = 0.35  # m to the middle of the next wall cell, that no place of a stroke has: strokes are up to 0.6 m wide


def remove_strokes(map: TopometricMap) -> TopometricMap:
    """Return the map without the rooms that are as narrow as a stroke everywhere and to which no door leads. Rooms that are alone
    on their storey stay."""
    count, storey = len(map.rooms), map.rooms["storey"]
    stays = np.isin(np.arange(count), map.edges["rooms"])
    for room in np.flatnonzero(~stays).tolist():
        at = map.navigable.cells[map.navigable_room == room][:, :2].astype(np.int64)
        low, high = compute_extent(at)
        low -= 1
        floor = np.zeros(high - low + 2, np.uint8)
        floor[tuple((at - low).T)] = 1
        stays[room] = edt.edt(floor, parallel=1).max() * map.navigable.edge >= STROKE_HALF_WIDTH
    stays |= ~np.isin(storey, storey[stays])
    return map if stays.all() else select_rooms(map, stays)


# Attributes of a map, once its rooms are cut: odds of rooms, doors with their kinds and states, windows (beyond the thesis).


def estimate_attributes(
    map: TopometricMap, scan: Scan, floor: Floor, walls: StoreyWalls | None, doors: bool = True
) -> tuple[TopometricMap, list[str]]:
    """Return the map with how likely each room is one, its doors and windows; and what is odd about the sensor's way.

    Args:
        floor: that the map was made of.
        walls: with the map's rooms beside them; None of a scan that shows none at heights.
        doors: are the doors of plans weighed with what walls and the plan network show?
    """
    map = add_room_probabilities(map, scan.rays, scan.raised)
    if doors:
        map = add_wall_doors(map, floor.classified_storeys, walls)
    if scan.drawn_doors is not None:
        map = place_drawn_doors(map, scan.drawn_doors)
    map, doubt = add_walked_doors(map, scan.places)
    map = select_distinct_doors(map)
    if scan.raised:
        map = remove_strokes(map)
    # Not of slices: the same rule loses true rooms there (recall .924 to .916, docs/adr/0018).
    if walls is not None:
        map = remove_patches(add_windows(map, walls.elevations, walls.classes), scan.places)
    return map, [doubt] if doubt else []
