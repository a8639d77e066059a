"""A map without some of its rooms, doors and windows: those that are no rooms, and those that a user does not trust."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topomerge.errors import InputError
from topomerge.types.arrays import Array
from topomerge.types.topometric_map import TopometricMap


def of_rooms(map: TopometricMap, stays: Array) -> TopometricMap:
    """The map of some of its rooms, numbered anew in their order.

    Cells of the others are of no room, and their areas, doors and stairs are left out. A window of theirs stays
    where the room on its other side does; it then leads to where nothing was seen. Storeys stay.

    Args:
        map: any map.
        stays: (R,) bool.
    """
    number = np.append(np.where(stays, np.cumsum(stays) - 1, -1), -1).astype(np.int32)
    of_area = stays[map.areas["room"]]
    area_number = np.append(np.where(of_area, np.cumsum(of_area) - 1, -1), -1).astype(np.int32)
    areas = map.areas[of_area].copy()
    areas["room"] = number[areas["room"]]
    edges = map.edges[stays[map.edges["rooms"]].all(axis=1)].copy()
    narrows = map.narrows[of_area[map.narrows["rooms"]].all(axis=1)].copy()
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


def confident(map: TopometricMap, least: float) -> TopometricMap:
    """The map without the rooms, doors, stairs and windows that are less likely than `least`; as `of_rooms` has it.

    Args:
        map: any map.
        least: confidence from which on they stay, 0 to 1; 0: the map itself.

    Raises:
        InputError: `least` is no probability.
    """
    if not 0 <= least <= 1:
        raise InputError(f"min_confidence {least}: is no probability; give a number from 0 to 1 (0 keeps everything)")
    if least == 0:
        return map
    edges, windows = (table[table["confidence"] >= least] for table in (map.edges, map.windows))
    return of_rooms(replace(map, edges=edges, windows=windows), map.rooms["confidence"] >= least)
