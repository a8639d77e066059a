"""Niches and cupboards seen on walls: stretches that the network of elevations takes for one (beyond the thesis).

A niche is a recess in a wall, a cupboard what stands before it. What several faces of a room show at one place is one. It is of
the room whose floor lies before it, as a strip goes on past the corner of its room. Where there is a door or a window there is
none.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topomerge.extraction.elevations.doorways import strip_bounds
from topomerge.extraction.elevations.elevation import ACROSS, BANDS, BEFORE, WALL_CLASSES, Elevations
from topomerge.extraction.elevations.stretches import (
    BESIDE,
    LEAST_FILL,
    PLACE,
    at_any,
    doors_of,
    ends_upwards,
    face_cover,
    in_place,
    likely_stretches,
    one_each,
    rooms_beside,
    wall_profile,
)
from topomerge.extraction.elevations.wall_network import PLACES
from topomerge.types import FIXTURE_DTYPE, FIXTURE_KINDS, Array, TopometricMap
from topomerge.types.arrays import within_turn

LIKELY_FIXTURE = 0.8  # probability of a niche or a cupboard, on average of its places
LEAST_FIXTURE = {"niche": 0.3, "cupboard": 0.5}  # m, width: narrower ones are parts of wider ones
ONE_PLACE = 1.0  # m across, in which fixtures of a room are one: a front, and the wall behind what is deep
FACING = 0.97  # cosine between the directions of two that may be one
NEARER_FACE, NEARER_FRONT = 0.5, 0.25  # of the strongest surface that a nearer one has: a thin wall has two; shelves show edges
LEAST_WALL = 0.5  # elements a place that show a wall
SHALLOWEST = 2  # elements between a wall and the back of its niche, or the front of what stands before it
DEPTH_BANDS = slice(2, BANDS)  # in which backs and fronts show: above skirtings
ON_FLOOR = 0.3  # m above the floor: what begins below stands on it, its plinth set back


def with_fixtures(map: TopometricMap, walls: Elevations, classes: Array) -> TopometricMap:
    """The map with the niches and cupboards that its walls show; its doors and windows come first.

    Args:
        classes: (n / 2, 7) of `place_classes`.
    """
    return replace(map, fixtures=fixtures_in_map(map, fixtures_on_walls(walls, classes)))


def fixtures_on_walls(walls: Elevations, classes: Array) -> Array:
    """(F,) FIXTURE_DTYPE, one for each face that shows it, of the room of that face.

    Args:
        classes: (n / 2, 7) of `place_classes`.
    """
    rows = []
    for face, (low, high) in zip(walls.faces, strip_bounds(walls), strict=True):
        each, strip = classes[low // PLACES : high // PLACES], walls.strips[low:high]
        for kind in FIXTURE_KINDS:
            chance = each[:, WALL_CLASSES.index(kind)]
            for start, stop in likely_stretches(chance, LIKELY_FIXTURE, LEAST_FIXTURE[kind]):
                rows.append(_fixture(kind, face, strip, (start, stop), float(chance[start:stop].mean())))
    return np.array(rows, FIXTURE_DTYPE)


def fixtures_in_map(map: TopometricMap, rows: Array) -> Array:
    """(F,) FIXTURE_DTYPE, each once and of the room before it, in the order of rooms; without those where a door or a window is.

    Args:
        rows: FIXTURE_DTYPE in the map's frame; their room stays where no floor is near, and those without any are left out.
    """
    if not len(rows) or not len(map.rooms):
        return np.zeros(0, FIXTURE_DTYPE)
    rows = rows.copy()
    before = rooms_beside(map, rows)[:, 0]
    rows["room"] = np.where(before >= 0, before, rows["room"])
    rows = rows[(rows["room"] >= 0) & ~at_any(rows, doors_of(map)) & ~at_any(rows, map.windows)]
    rows = np.array([_one(rows[group]) for group in one_each(rows, _overlapping)], FIXTURE_DTYPE)
    return rows[np.lexsort((*rows["centre"].T[::-1], rows["room"]))]


def _fixture(kind: str, face: Array, strip: Array, ends: tuple[int, int], likely: float) -> tuple[object, ...]:
    """Row of FIXTURE_DTYPE of one stretch of a face."""
    start, stop = ends
    wall = _wall_face(strip, start, stop)
    sizes = (_recess if kind == "niche" else _front)(strip, start, stop, wall)
    off = 0.0 if wall is None else (wall + 0.5) * ACROSS - BEFORE
    middle = face["start"] + (start + stop) / 2 * PLACE * face["along"] + off * face["out"]
    direction = float(within_turn(np.arctan2(face["out"][1], face["out"][0]), 2 * np.pi))
    centre = (*middle.tolist(), float(face["floor"]))
    return kind, int(face["room"]), centre, (stop - start) * PLACE, *sizes, direction, likely


def _wall_face(strip: Array, start: int, stop: int) -> int | None:
    """Element across the strip in which the face of a stretch's wall lies, the nearer one of a thin wall; None: not seen."""
    profile = wall_profile(strip, start, stop)
    nearer = _nearer(profile, NEARER_FACE)
    return nearer if profile[nearer] >= LEAST_WALL * (stop - start + 2 * BESIDE) else None


def _recess(strip: Array, start: int, stop: int, wall: int | None) -> tuple[float, float, float]:
    """m of depth, bottom and top of a niche: the wall is empty there, and its back shows behind."""
    cover = None if wall is None else face_cover(strip, start, stop, wall)
    if wall is None or cover is None:
        return np.nan, np.nan, np.nan
    back = _surface(strip[:, wall + SHALLOWEST :], start, stop, cover < 0.5, NEARER_FACE)
    return np.nan if back is None else (back + SHALLOWEST) * ACROSS, *ends_upwards(1 - cover)


def _front(strip: Array, start: int, stop: int, wall: int | None) -> tuple[float, float, float]:
    """m of depth, bottom and top of what stands before a wall: its front shows before that, or it hides the wall."""
    before = strip if wall is None else strip[:, : max(wall - SHALLOWEST + 1, 0)]
    front = _surface(before, start, stop, np.ones(BANDS, bool), NEARER_FRONT)
    depth = np.nan if front is None or wall is None else (wall - front) * ACROSS
    if front is not None:
        cover = face_cover(strip, start, stop, int(front) + 1)
    else:
        hidden = None if wall is None else face_cover(strip, start, stop, wall)
        cover = None if hidden is None else 1 - hidden
    if cover is None:
        return depth, np.nan, np.nan
    below, above = np.maximum.accumulate(cover), np.maximum.accumulate(cover[::-1])[::-1]
    bottom, top = ends_upwards(np.minimum(below, above))  # shelves are open between their boards
    return depth, bottom if bottom >= ON_FLOOR else 0.0, top


def _surface(strip: Array, start: int, stop: int, bands: Array, share: float) -> float | None:
    """Element across a strip in which a surface of a stretch lies, in some bands (13,) bool; None where hardly anything is."""
    inner = strip[(start + 1) * PLACES : (stop - 1) * PLACES, :, DEPTH_BANDS][:, :, bands[DEPTH_BANDS]]
    if not inner.size:
        return None
    fill = inner.mean(axis=(0, 2))
    peak = _nearer(fill, share)
    near = slice(max(peak - 1, 0), peak + 2)
    return float(np.average(np.arange(len(fill))[near], weights=fill[near])) if fill[near].sum() >= LEAST_FILL else None


def _nearer(profile: Array, share: float) -> int:
    """Element across a strip in which the first surface lies that has a share of the strength of the strongest one."""
    two = profile + np.append(profile[1:], 0)  # a surface may lie between two elements
    first = int((two >= share * two.max()).argmax())
    return first + int(profile[first : first + 2].argmax())


def _one(rows: Array) -> Array:
    """One fixture of what shows at one place: the likeliest, with what others of its kind show and it does not."""
    fixture = rows[0].copy()
    alike = rows[rows["kind"] == fixture["kind"]]
    for name in ("depth", "bottom", "top"):
        seen = alike[name][np.isfinite(alike[name])]
        fixture[name] = seen[0] if len(seen) else np.nan
    if fixture["top"] <= fixture["bottom"]:  # of two faces
        fixture["bottom"], fixture["top"] = rows[0]["bottom"], rows[0]["top"]
    return fixture


def _overlapping(fixture: Array, rows: Array) -> Array:
    """(F,) bool: seen from one room, on one side of a wall, and sharing most of the narrower of the two."""
    facing = np.cos(rows["direction"] - fixture["direction"]) > FACING
    return facing & (rows["room"] == fixture["room"]) & in_place(fixture, rows["centre"], rows["width"], ONE_PLACE)
