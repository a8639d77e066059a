"""Maps for tests of edits: a corridor between eight rooms, extracted once."""

from __future__ import annotations

from functools import cache

import numpy as np

import topomerge as tm
from tests.scenes import corridor
from topomerge.types import Array, TopometricMap


@cache
def corridor_map(voxel_size: float = 0.1) -> TopometricMap:
    """Rooms of 4 x 4 m at (2, 2), (2, 8), (6, 2) … and the corridor at (8, 5)."""
    return tm.extract(corridor().points(), voxel_size=voxel_size, name="corridor")


def label_at(map: TopometricMap, places: Array) -> Array:
    """(n,) room at places (n, 2) m on the floor."""
    from topomerge.extraction.attributes import find_rooms_at

    return find_rooms_at(map, np.column_stack([places, np.full(len(places), 0.05)]))


def assert_same_map(a: TopometricMap, b: TopometricMap) -> None:
    """Equal to the last bit, but for the number of edits."""
    for name in ("room", "navigable_room", "navigable_area", "rooms", "edges", "areas", "narrows", "windows"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name
    assert a.landmarks.table.tobytes() == b.landmarks.table.tobytes()
    assert a.landmarks.values == b.landmarks.values
    assert a.warnings == b.warnings
