"""A doorway joins the two rooms that lie across it, once (beyond the thesis).

What is seen on a wall, in the plan, and by a sensor's way may be one doorway told twice, between different rooms: a sliver of a
third room often lies in it. Of the doors of 60 simulated validation maps a twentieth were such doubles.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from topomerge.types import Array, TopometricMap

LEVEL_KINDS = ("door", "opening")
ONE_DOORWAY = 0.5  # m between the centres of what is one doorway
SIDES_AT = (0.4, 0.6, 0.8)  # m before and behind a door, where its rooms are looked for


def distinct_doors(map: TopometricMap) -> TopometricMap:
    """The map with each doorway once: of edges in one place the one whose rooms lie across it, of these the surest."""
    level = np.flatnonzero(np.isin(map.edges["kind"], LEVEL_KINDS))
    doors = map.edges[level]
    same = cKDTree(doors["centre"]).query_ball_point(doors["centre"], ONE_DOORWAY) if len(doors) else ()
    single = np.ones(len(map.edges), bool)
    single[level] = False
    for k in np.lexsort((-doors["confidence"], ~_between_its_rooms(map, doors))).tolist():
        single[level[k]] = not single[level[same[k]]].any()
    return map if single.all() else replace(map, edges=map.edges[single])


def _between_its_rooms(map: TopometricMap, doors: Array) -> Array:
    """(n,) bool: do the rooms of each door lie before and behind it?"""
    normal = np.column_stack([np.cos(doors["direction"]), np.sin(doors["direction"]), np.zeros(len(doors))])
    wanted, out = np.sort(doors["rooms"], axis=1), np.zeros(len(doors), bool)
    for reach in SIDES_AT:
        sides = [rooms_at(map, doors["centre"] + way * reach * normal) for way in (1, -1)]
        out |= (np.sort(np.column_stack(sides), axis=1) == wanted).all(axis=1)
    return out


def rooms_at(map: TopometricMap, floor: Array) -> Array:
    """(n,) int64 room of the map at each place (n, 3) m of a floor, -1 none. Floors of two maps differ by up to two cells."""
    cells = map.navigable.locate(floor)
    out = np.full(len(cells), -1, np.int64)
    for up in (0, 1, -1, 2, -2):
        rows = map.navigable.rows(cells + (0, 0, up))
        missing = (out < 0) & (rows >= 0)
        out[missing] = map.navigable_room[rows[missing]]
    return out
