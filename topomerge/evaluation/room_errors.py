"""How far a pose puts each shared room from where it is: the measure of a merge in rooms.

An error in the middle of what both maps saw says little of a room at the far end of a corridor, where a degree is half a metre.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from topomerge.types import Array, Sim3, TopometricMap

ROOM_NEAR = 0.1  # m within which every point of a room lies where it should


def floors_of_rooms(map: TopometricMap, rooms: Iterable[Sequence[tuple[int, int]]]) -> list[Array]:
    """(n, 3) points of each shared room: its floor in map b, of all pieces; where none was seen, what stands in it.

    Args:
        map: b.
        rooms: matches (room of a, room of b) of the pieces of each shared room.
    """
    floor, cells = map.navigable.centroids(), map.grid.centroids()
    out = []
    for pieces in rooms:
        of_b = sorted({j for _, j in pieces})
        points = floor[np.isin(map.navigable_room, of_b)]
        out.append(points if len(points) else cells[np.isin(map.room, of_b)])
    return out


def displacements(pose: Sim3, truth: Sim3, rooms: Sequence[Array], flat: bool = False) -> Array:
    """(R,) m, in the frame of a: how far an estimated pose of b puts the worst point of each room from its true place.

    The distance is convex over the room, so its largest is that of the outline.

    Args:
        pose, truth: T_ab.
        rooms: (n, 3) points of b of each room; one without points is infinitely far.
        flat: one of the maps says nothing of heights: distances are horizontal.
    """
    out = np.full(len(rooms), np.inf)
    for k, points in enumerate(rooms):
        if len(points):
            off = (pose.apply(points) - truth.apply(points))[:, : 2 if flat else 3]
            out[k] = float(np.linalg.norm(off, axis=1).max())
    return out
