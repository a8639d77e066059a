"""Small patches of floor that no door leads to are no rooms (beyond the thesis: docs/adr/0018).

A bed, a counter, or the end of what a sensor saw through a window cut the floor of a room into patches. Rooms that somebody was
in have doors, even small ones.
"""

from __future__ import annotations

import numpy as np

from topomerge.extraction.walked_doors import rooms_under
from topomerge.types import Array, TopometricMap, of_rooms

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
    return map if stays.all() else of_rooms(map, stays)
