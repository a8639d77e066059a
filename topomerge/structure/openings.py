"""Doors, openings and windows of a map, set into the walls that carry them."""

from __future__ import annotations

from typing import Any

import numpy as np

from topomerge.structure.floors import is_flight
from topomerge.types import Array, TopometricMap

OPENING_DTYPE = np.dtype(
    [
        ("edge", "i4"),  # row of the map's edges
        ("wall", "i4"),  # row of the walls; -1: none was seen around it
        ("centre", "f8", 3),  # on the floor, in the middle of the wall, in the input's frame
        ("width", "f8"),  # m
        ("height", "f8"),  # m; 0 where nothing was seen above
        ("direction", "f8"),  # rad, of the wall's normal, in [0, pi)
        ("kind", "U8"),  # door | opening
    ]
)
SET_WINDOW_DTYPE = np.dtype(
    [
        ("window", "i4"),  # row of the map's windows
        ("wall", "i4"),  # row of the walls; -1: none was seen around it
        ("centre", "f8", 3),  # on the floor, in the middle of the wall, in the input's frame
        ("width", "f8"),  # m
        ("sill", "f8"),  # m above the floor; a usual height where it was not seen
        ("head", "f8"),
        ("direction", "f8"),  # rad, of the wall's normal, in [0, pi)
    ]
)
USUAL_SILL, USUAL_HEAD, LEAST_PANE = 0.9, 2.1, 0.3  # m above the floor, where they were not seen, and between them at least
CARRIER_REACH = 0.8  # m between the middle of a door and the middle line of its wall
STRANGE = 0.4  # m: a wall of other rooms has to be so much nearer
LEAST_SHARE = 0.5  # of an opening's width that is in its wall


def openings_in_walls(map: TopometricMap, walls: Array) -> Array:
    """(O,) OPENING_DTYPE, in the order of the map's edges; flights of stairs are none.

    An opening lies in the middle of the wall that carries it, and turned as it is: the wall's direction is better known.

    Args:
        walls: WALL_DTYPE of the whole map.
    """
    rows = [i for i, edge in enumerate(map.edges) if not is_flight(edge)]
    out = np.zeros(len(rows), OPENING_DTYPE)
    for opening, i in zip(out, rows, strict=True):
        edge = map.edges[i]
        for name in ("centre", "width", "height", "direction", "kind"):
            opening[name] = edge[name]
        opening["edge"], opening["wall"] = i, _carrier(edge, edge["rooms"], walls, map.rooms)
        if opening["wall"] >= 0:
            _set_into(opening, walls[opening["wall"]])
    return out


def windows_in_walls(map: TopometricMap, walls: Array) -> Array:
    """(W,) SET_WINDOW_DTYPE, in the order of the map's windows; they lie in their walls as openings do.

    Args:
        walls: WALL_DTYPE of the whole map.
    """
    out = np.zeros(len(map.windows), SET_WINDOW_DTYPE)
    for k, (pane, window) in enumerate(zip(out, map.windows, strict=True)):
        for name in ("centre", "width", "direction"):
            pane[name] = window[name]
        pane["window"], pane["wall"] = k, _carrier(window, window["rooms"], walls, map.rooms)
        if pane["wall"] >= 0:
            _set_into(pane, walls[pane["wall"]])
        pane["sill"], pane["head"] = _pane(float(window["sill"]), float(window["head"]))
    return out


def _pane(sill: float, head: float) -> tuple[float, float]:
    """Sill and head above the floor, usual ones where they were not seen; LEAST_PANE high what ends below the floor."""
    low = sill if np.isfinite(sill) else min(USUAL_SILL, head - LEAST_PANE) if np.isfinite(head) else USUAL_SILL
    low = max(low, 0.0)
    if not np.isfinite(head):
        return low, max(USUAL_HEAD, low + LEAST_PANE)
    return low, head if head > low else low + LEAST_PANE


def _carrier(edge: Array, rooms: Array, walls: Array, table: Array) -> int:
    """Row of the wall nearest to a door or a window among those that part its rooms, -1 none.

    Args:
        rooms: (2,) on its two sides, -1 none.
        table: ROOM_DTYPE of the whole map.
    """
    inner = rooms[rooms >= 0]
    line = walls["end"] - walls["start"]
    length = np.maximum(np.hypot(*line.T), 1e-9)
    along = line / length[:, None]
    apart = edge["centre"][:2] - walls["start"]
    place = (apart * along).sum(axis=1)
    off = np.abs(apart[:, 0] * along[:, 1] - apart[:, 1] * along[:, 0])
    past = np.maximum(np.maximum(-place, place - length), 0.0)
    beside = np.isin(walls["rooms"], inner).sum(axis=1)
    two = (np.sort(walls["rooms"], axis=1) == np.sort(rooms)).all(axis=1)
    cost = np.hypot(off, past) + np.where(two, 0.0, STRANGE)
    fits = np.isin(walls["storey"], table["storey"][inner]) & (beside > 0) & (off <= CARRIER_REACH)
    fits &= past <= (0.5 - LEAST_SHARE) * edge["width"] + 0.1
    return int(np.flatnonzero(fits)[cost[fits].argmin()]) if fits.any() else -1


def _set_into(opening: Any, wall: Array) -> None:
    line = wall["end"] - wall["start"]
    length = float(np.hypot(*line))
    along = line / length
    width = min(float(opening["width"]), length)
    place = float(np.clip((opening["centre"][:2] - wall["start"]) @ along, width / 2, length - width / 2))
    opening["centre"][:2] = wall["start"] + along * place
    opening["width"], opening["direction"] = width, float(np.arctan2(along[0], -along[1]) % np.pi)
