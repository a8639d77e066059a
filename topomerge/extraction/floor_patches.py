"""Small patches of floor that no door leads to are no rooms (beyond the thesis: docs/adr/0018).

A bed, a counter, or the end of what a sensor saw through a window cut the floor of a room into patches. Rooms that somebody was
in have doors, even small ones.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topomerge.extraction.walked_doors import rooms_under
from topomerge.types import Array, TopometricMap

PATCH_AREA = 3.0  # m2, below which floor without a door is a patch


def without_patches(map: TopometricMap, places: Array) -> TopometricMap:
    """The map in which patches of floor are of no room. Those that the sensor was on, and rooms that are alone on their storey,
    stay.

    Args:
        places: (n, 3) m, where the sensor was; may be empty.
    """
    count = len(map.rooms)
    reached = np.isin(np.arange(count), map.edges["rooms"]) | np.isin(np.arange(count), rooms_under(map, places))
    stays = reached | (map.rooms["area"] >= PATCH_AREA)
    storey = map.rooms["storey"]
    stays |= ~np.isin(storey, storey[stays])
    return map if stays.all() else _of_rooms(map, stays)


def _of_rooms(map: TopometricMap, stays: Array) -> TopometricMap:
    """The map of some of its rooms (R,) bool, among them all that edges join."""
    number = np.append(np.where(stays, np.cumsum(stays) - 1, -1), -1).astype(np.int32)
    of_area = stays[map.areas["room"]]
    area_number = np.append(np.where(of_area, np.cumsum(of_area) - 1, -1), -1).astype(np.int32)
    areas = map.areas[of_area].copy()
    areas["room"] = number[areas["room"]]
    edges, narrows = map.edges.copy(), map.narrows[of_area[map.narrows["rooms"]].all(axis=1)].copy()
    edges["rooms"], narrows["rooms"] = number[edges["rooms"]], area_number[narrows["rooms"]]
    windows = map.windows.copy()
    ends = number[windows["rooms"]]
    both = (ends >= 0).all(axis=1, keepdims=True)
    windows["rooms"] = np.where(both, np.sort(ends, axis=1), -np.sort(-ends, axis=1))
    assert map.navigable_area is not None
    return replace(
        map,
        room=number[map.room],
        navigable_room=number[map.navigable_room],
        rooms=map.rooms[stays],
        edges=edges,
        areas=areas,
        navigable_area=area_number[map.navigable_area],
        narrows=narrows,
        windows=windows[windows["rooms"][:, 0] >= 0],
    )
