"""Windows seen on walls: stretches that the network of elevations takes for one, with sill and head (beyond the thesis).

What several faces show of one window is one. Its rooms are those whose floors lie on its two sides, as a strip goes on past the
corner of its room. Where there is a door there is no window.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from topomerge.extraction.elevations.doorways import HALF_WALL, strip_bounds
from topomerge.extraction.elevations.elevation import ACROSS, BEFORE, WALL_CLASSES, Elevations
from topomerge.extraction.elevations.stretches import (
    PLACE,
    at_any,
    doors_of,
    ends_upwards,
    face_cover,
    in_place,
    likely_stretches,
    one_each,
    rooms_beside,
    wall_depth,
)
from topomerge.extraction.elevations.wall_network import PLACES
from topomerge.types import WINDOW_DTYPE, Array, TopometricMap
from topomerge.types.arrays import within_turn

LIKELY_WINDOW = 0.85  # probability of a window, on average of its places
LEAST_WINDOW = 0.4  # m, width
WINDOW = WALL_CLASSES.index("window")
TURNED_AWAY = 0.26  # sine of the angle between two walls that are not one


def with_windows(map: TopometricMap, walls: Elevations, classes: Array) -> TopometricMap:
    """The map with the windows that its walls show.

    Args:
        classes: (n / 2, 7) of `place_classes`.
    """
    rows = windows_on_walls(walls, classes[:, WINDOW])
    return replace(map, windows=in_map(map, rows))


def windows_on_walls(walls: Elevations, chance: Array) -> Array:
    """(W,) WINDOW_DTYPE, each once however many faces show it, the likeliest first; `rooms` are those of the faces.

    Args:
        chance: (n / 2,) probability of a window in each place along the strips.
    """
    rows, outs = [], []
    for face, (low, high) in zip(walls.faces, strip_bounds(walls), strict=True):
        each, strip = chance[low // PLACES : high // PLACES], walls.strips[low:high]
        for start, stop in likely_stretches(each, LIKELY_WINDOW, LEAST_WINDOW):
            rows.append(_window(face, each, strip, start, stop))
            outs.append(face["out"])
    table, out = np.array(rows, WINDOW_DTYPE), np.array(outs, float).reshape(-1, 2)
    return np.array([_one(table[group], out[group]) for group in same_windows(table)], WINDOW_DTYPE)


def in_map(map: TopometricMap, rows: Array) -> Array:
    """(W,) WINDOW_DTYPE of the windows with the rooms on their two sides, in the order of these; without those where a door is.

    A floor that goes on behind a window, seen through it, is often taken for one with the room: then there is no second room.

    Args:
        rows: WINDOW_DTYPE in the map's frame; their rooms stay where no floor is near, and those without any are left out.
    """
    if not len(rows) or not len(map.rooms):
        return np.zeros(0, WINDOW_DTYPE)
    rows = rows.copy()
    sides = rooms_beside(map, rows)
    unseen = (sides < 0).all(axis=1)
    sides[unseen] = rows["rooms"][unseen]
    sides[sides[:, 0] == sides[:, 1], 1] = -1
    both = np.asarray((sides >= 0).all(axis=1))
    rows["rooms"] = np.where(both[:, None], np.sort(sides, axis=1), -np.sort(-sides, axis=1))
    rows = rows[(rows["rooms"][:, 0] >= 0) & ~at_any(rows, doors_of(map))]
    return rows[np.lexsort((*rows["centre"].T[::-1], *rows["rooms"].T[::-1]))]


def same_windows(rows: Array) -> Iterator[Array]:
    """Rows of WINDOW_DTYPE that are one window, as indices, the likeliest first; the likeliest windows first."""
    return one_each(rows, _overlapping)


def _window(face: Array, chance: Array, strip: Array, start: int, stop: int) -> tuple[object, ...]:
    """Row of WINDOW_DTYPE of one stretch of a face."""
    depth = wall_depth(strip, start, stop)
    off = (depth + 0.5) * ACROSS - BEFORE + HALF_WALL
    middle = face["start"] + (start + stop) / 2 * PLACE * face["along"] + off * face["out"]
    direction = float(within_turn(np.arctan2(face["out"][1], face["out"][0]), np.pi))
    centre = (*middle.tolist(), float(face["floor"]))
    likely = float(chance[start:stop].mean())
    return (int(face["room"]), -1), centre, (stop - start) * PLACE, *_heights(strip, start, stop, depth), direction, likely


def _heights(strip: Array, start: int, stop: int, depth: int) -> tuple[float, float]:
    """m above the floor of sill and head of a stretch, nan where they do not show: the bands of the face that are mostly empty,
    and as much of those below and above them as is."""
    cover = face_cover(strip, start, stop, depth)
    return (np.nan, np.nan) if cover is None else ends_upwards(1 - cover)


def _one(rows: Array, out: Array) -> Array:
    """One window of what faces show of it, (k, 2) `out` away from their rooms: the likeliest, or what lies between the two
    that are the likeliest on both sides of the wall."""
    window = rows[0].copy()
    opposite = np.flatnonzero(out @ out[0] < 0)
    if len(opposite):
        pair = rows[[0, opposite[0]]]
        for name in ("centre", "width"):
            window[name] = pair[name].mean(axis=0)
        window["rooms"] = pair["rooms"][:, 0]
    for name in ("sill", "head"):
        seen = rows[name][np.isfinite(rows[name])]
        window[name] = seen.mean() if len(seen) else np.nan
    if window["head"] <= window["sill"]:  # one face shows the sill only, the other one a head below it
        window["sill"], window["head"] = rows[0]["sill"], rows[0]["head"]
    return window


def _overlapping(window: Array, rows: Array) -> Array:
    """(W,) bool: in one wall with a window, and sharing most of the narrower of the two."""
    parallel = np.abs(np.sin(rows["direction"] - window["direction"])) < TURNED_AWAY
    return parallel & in_place(window, rows["centre"], rows["width"])
