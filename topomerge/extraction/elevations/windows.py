"""Windows seen on walls: stretches that the network of elevations takes for one, with sill and head (beyond the thesis).

What several faces show of one window is one. Its rooms are those whose floors lie on its two sides, as a strip goes on past the
corner of its room. Where there is a door there is no window.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from topomerge.extraction.elevations.doorways import HALF_WALL, STOOD, iter_strip_bounds
from topomerge.extraction.elevations.elevation import (
    ACROSS,
    ALONG,
    BANDS,
    BEFORE,
    LOWEST,
    PLACES,
    UPWARDS,
    WALL_CLASSES,
    Elevations,
)
from topomerge.types import WINDOW_DTYPE, Array, TopometricMap
from topomerge.types.grid import wrap_to_turn

# Stretches of walls that show one thing, a window for example: where they begin and end, and whether two show the same one.

STRETCH_CHANCE = 0.5  # probability of every place of a stretch
PLACE = PLACES * ALONG  # m, of a place along a wall
SHARED_WIDTH = 0.5  # share of the narrower of two that lies in the other one, from which they are one
SAME_WALL, STRETCH_LEVEL = 0.6, 0.75  # m across and in height, to be in one wall
SIDES = (0.3, 1.0)  # m from a stretch: where its rooms have their floors, which reach a little into walls
BESIDE = 5  # places beside a stretch that show how full its wall is, and where it stands
BESIDE_BANDS, ABOVE_BANDS = slice(5, 12), slice(11, 13)  # in which walls show beside windows, and above most
LEAST_FILL = 0.15  # of the elements of a surface: in emptier ones nothing shows where it begins or ends


def iter_likely_stretches(probability: Array, likely: float, least: float) -> Iterator[tuple[int, int]]:
    """Yield the first place and that after the last one of every stretch that probably shows one thing.

    Args:
        chance: (n,) probability of it in each place along a strip.
        likely: of it on average; least: m, width.
    """
    ends = np.flatnonzero(np.diff(np.concatenate([[0], probability > STRETCH_CHANCE, [0]]).astype(np.int8)))
    for start, stop in ends.reshape(-1, 2).tolist():
        if (stop - start) * PLACE >= least - 1e-9 and probability[start:stop].mean() >= likely:
            yield start, stop


def find_wall_depth(strip: Array, start: int, stop: int) -> int:
    """Return the element across the strip in which most of the wall of a stretch lies (`compute_wall_profile`)."""
    return int(compute_wall_profile(strip, start, stop).argmax())


def compute_wall_profile(strip: Array, start: int, stop: int) -> Array:
    """Return (32,) how much lies in each element across the strip beside a stretch and above it: its wall. A cupboard has a face,
    too, and its strip shows the wall, or a window, behind it."""
    left, right = strip[max(start - BESIDE, 0) * PLACES : start * PLACES], strip[stop * PLACES : (stop + BESIDE) * PLACES]
    around = np.concatenate([left, right])[:, :, BESIDE_BANDS].sum(axis=(0, 2))
    profile: Array = around + strip[start * PLACES : stop * PLACES, :, ABOVE_BANDS].sum(axis=(0, 2))
    return profile


def measure_face_cover(strip: Array, start: int, stop: int, depth: int) -> Array | None:
    """Return (13,) 0..1 share of the surface at a depth that is there in each band of a stretch, of what is there in most bands
    around it; None where hardly anything is."""
    inner = slice((start + 1) * PLACES, (stop - 1) * PLACES)
    reach = slice(max(start - BESIDE, 0) * PLACES, (stop + BESIDE) * PLACES)
    face = strip[:, max(depth - 1, 0) : depth + 1, :BANDS].max(axis=1)
    full = float(np.quantile(face[reach].mean(axis=0), 0.75))
    return None if full < LEAST_FILL else np.minimum(face[inner].mean(axis=0) / full, 1.0)


def measure_vertical_extent(profile: Array) -> tuple[float, float]:
    """Return the heights, m above the floor, between which most bands of (13,) 0..1 are above a half, and as much of those below
    and above them as is; nan where the end of the strip is one of them, or none is above."""
    runs = np.flatnonzero(np.diff(np.concatenate([[0], profile > 0.5, [0]]))).reshape(-1, 2)
    if not len(runs):
        return np.nan, np.nan
    low, high = runs[np.argmax(runs[:, 1] - runs[:, 0])].tolist()
    bottom = low + (1 - profile[low]) - profile[low - 1] if low > 0 else np.nan
    top = high - (1 - profile[high - 1]) + profile[high] if high < BANDS else np.nan
    return float(LOWEST + UPWARDS * bottom), float(LOWEST + UPWARDS * top)


def iter_distinct_rows(rows: Array, same: Callable[[Array, Array], Array]) -> Iterator[Array]:
    """Yield rows that show one thing, as indices, the likeliest first; the likeliest things first.

    Args:
        rows: with `confidence`.
        same: a row and all rows -> (n,) bool, do these show what it shows?
    """
    open_rows = np.ones(len(rows), bool)
    for i in np.argsort(-rows["confidence"], kind="stable").tolist():
        if open_rows[i]:
            near = np.flatnonzero(open_rows & same(rows[i], rows))
            open_rows[near] = False
            yield near[np.argsort(-rows["confidence"][near], kind="stable")]


def is_in_place(row: Array, centres: Array, widths: Array, across_reach: float = SAME_WALL) -> Array:
    """Return (n,) bool: does something so wide share most of its width, or of the row's, with a row that has `centre`, `width`
    and `direction`?"""
    apart, along = centres - row["centre"], _compute_along(row)
    place, across = apart[:, :2] @ along, np.abs(apart[:, 0] * along[1] - apart[:, 1] * along[0])
    shared = (widths + row["width"]) / 2 - np.abs(place)
    level = np.abs(apart[:, 2]) < STRETCH_LEVEL
    fits: Array = level & (across < across_reach) & (shared > SHARED_WIDTH * np.minimum(widths, row["width"]))
    return fits


def is_at_any(rows: Array, others: Array) -> Array:
    """Return (n,) bool: is one of the others, doors or windows, there?"""
    return np.array([bool(is_in_place(row, others["centre"], others["width"]).any()) for row in rows], bool)


def select_doors(map: TopometricMap) -> Array:
    """Return (D,) EDGE_DTYPE, the doors and openings of a map."""
    doors: Array = map.edges[np.isin(map.edges["kind"], ("door", "opening"))]
    return doors


def find_adjacent_rooms(map: TopometricMap, rows: Array) -> Array:
    """Return (n, 2) the rooms whose floors are the nearest before rows and behind them, along their `direction`; -1 none."""
    inside = map.navigable_room >= 0
    flat = np.array([1, 1, STOOD / STRETCH_LEVEL])
    floor, room = map.navigable.compute_centroids(map.navigable.cells[inside]) * flat, map.navigable_room[inside]
    steps = np.arange(SIDES[0], SIDES[1] + 0.05, 0.1)[:, None] * np.array([-1.0, 1.0])
    shift = rows["width"][:, None] / 4 * np.array([0.0, -1.0, 1.0])
    out = np.stack([np.cos(rows["direction"]), np.sin(rows["direction"])], axis=-1)
    places = np.zeros((len(rows), len(steps), 3, 2, 3))
    places[..., :2] = shift[:, None, :, None, None] * _compute_along(rows)[:, None, None, None]
    places[..., :2] += steps[None, :, None, :, None] * out[:, None, None, None]
    places += rows["centre"][:, None, None, None]
    far, row = cKDTree(floor).query(places * flat, distance_upper_bound=STOOD)
    label = np.where(np.isfinite(far), np.append(room, -1)[row], -1).reshape(len(rows), -1, 2)
    first = (label >= 0).argmax(axis=1)
    sides: Array = np.take_along_axis(label, first[:, None], axis=1)[:, 0].astype(np.int64)
    return sides


def _compute_along(rows: Array) -> Array:
    """Return (n, 2) unit, the ways along the walls that rows are in."""
    return np.stack([-np.sin(rows["direction"]), np.cos(rows["direction"])], axis=-1)


LIKELY_WINDOW = 0.85  # probability of a window, on average of its places
LEAST_WINDOW = 0.4  # m, width
WINDOW = WALL_CLASSES.index("window")
TURNED_AWAY = 0.26  # sine of the angle between two walls that are not one


def add_windows(map: TopometricMap, walls: Elevations, classes: Array) -> TopometricMap:
    """Return the map with the windows that its walls show.

    Args:
        classes: (n / 2, 7) of `classify_places`.
    """
    rows = detect_windows(walls, classes[:, WINDOW])
    return replace(map, windows=select_windows(map, rows))


def detect_windows(walls: Elevations, probability: Array) -> Array:
    """Return (W,) WINDOW_DTYPE, each once however many faces show it, the likeliest first; `rooms` are those of the faces.

    Args:
        chance: (n / 2,) probability of a window in each place along the strips.
    """
    rows, outs = [], []
    for face, (low, high) in zip(walls.faces, iter_strip_bounds(walls), strict=True):
        each, strip = probability[low // PLACES : high // PLACES], walls.strips[low:high]
        for start, stop in iter_likely_stretches(each, LIKELY_WINDOW, LEAST_WINDOW):
            rows.append(_build_window(face, each, strip, start, stop))
            outs.append(face["out"])
    table, out = np.array(rows, WINDOW_DTYPE), np.array(outs, float).reshape(-1, 2)
    return np.array([_merge_windows(table[group], out[group]) for group in iter_same_windows(table)], WINDOW_DTYPE)


def select_windows(map: TopometricMap, rows: Array) -> Array:
    """Return (W,) WINDOW_DTYPE of the windows with the rooms on their two sides, in the order of these; without those where a
    door is.

    A floor that goes on behind a window, seen through it, is often taken for one with the room: then there is no second room.

    Args:
        rows: WINDOW_DTYPE in the map's frame; their rooms stay where no floor is near, and those without any are left out.
    """
    if not len(rows) or not len(map.rooms):
        return np.zeros(0, WINDOW_DTYPE)
    rows = rows.copy()
    sides = find_adjacent_rooms(map, rows)
    unseen = (sides < 0).all(axis=1)
    sides[unseen] = rows["rooms"][unseen]
    sides[sides[:, 0] == sides[:, 1], 1] = -1
    both = np.asarray((sides >= 0).all(axis=1))
    rows["rooms"] = np.where(both[:, None], np.sort(sides, axis=1), -np.sort(-sides, axis=1))
    rows = rows[(rows["rooms"][:, 0] >= 0) & ~is_at_any(rows, select_doors(map))]
    return rows[np.lexsort((*rows["centre"].T[::-1], *rows["rooms"].T[::-1]))]


def iter_same_windows(rows: Array) -> Iterator[Array]:
    """Yield rows of WINDOW_DTYPE that are one window, as indices, the likeliest first; the likeliest windows first."""
    return iter_distinct_rows(rows, _is_overlapping)


def _build_window(face: Array, probability: Array, strip: Array, start: int, stop: int) -> tuple[object, ...]:
    """Build the row of WINDOW_DTYPE of one stretch of a face."""
    depth = find_wall_depth(strip, start, stop)
    off = (depth + 0.5) * ACROSS - BEFORE + HALF_WALL
    middle = face["start"] + (start + stop) / 2 * PLACE * face["along"] + off * face["out"]
    direction = float(wrap_to_turn(np.arctan2(face["out"][1], face["out"][0]), np.pi))
    centre = (*middle.tolist(), float(face["floor"]))
    likely = float(probability[start:stop].mean())
    return (
        (int(face["room"]), -1),
        centre,
        (stop - start) * PLACE,
        *_measure_heights(strip, start, stop, depth),
        direction,
        likely,
    )


def _measure_heights(strip: Array, start: int, stop: int, depth: int) -> tuple[float, float]:
    """Return the heights of sill and head of a stretch, m above the floor, nan where they do not show: the bands of the face that
    are mostly empty, and as much of those below and above them as is."""
    cover = measure_face_cover(strip, start, stop, depth)
    return (np.nan, np.nan) if cover is None else measure_vertical_extent(1 - cover)


def _merge_windows(rows: Array, out: Array) -> Array:
    """Make one window of what faces show of it, (k, 2) `out` away from their rooms: the likeliest, or what lies between the two
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


def _is_overlapping(window: Array, rows: Array) -> Array:
    """Return (W,) bool: in one wall with a window, and sharing most of the narrower of the two."""
    parallel = np.abs(np.sin(rows["direction"] - window["direction"])) < TURNED_AWAY
    return parallel & is_in_place(window, rows["centre"], rows["width"])
