"""Stairs, ramps and lifts: their triangles, the hole they need in the slab, and the way that feet take.

Each is built in the flight's own frame: x to the right, y ahead, from its corner, z above the lower floor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from topomerge.datasets.core.plan import Flight
from topomerge.datasets.core.solids import boxes, column, rotation

from topomerge.errors import InputError
from topomerge.types import Array

MAX_RISER, MIN_TREAD = 0.19, 0.25  # m
RISER, TREAD = 0.175, 0.28  # m, what is aimed at
HALF_LANDING = 1.25  # m, depth of a half landing
DOGLEG_GAP = 0.1  # m, between the two flights of a dog-leg
RAIL, STEP_SLAB = 0.9, 0.22  # m
SPIRAL_TURN = np.radians(330)  # of a spiral
MAX_SLOPE = 0.125  # of a ramp


@dataclass(frozen=True, eq=False)
class Staircase:
    """A flight in metres of the building, lower floor at z = 0.

    Args:
        vertices, triangles: of steps and rails.
        well: hole in the slab above.
        path: (16, 3) from landing to landing.
        footprint: (4, 2).
    """

    vertices: Array
    triangles: Array
    well: shapely.Polygon
    path: Array
    footprint: Array
    riser: float
    tread: float


def risers(rise: float) -> int:
    """Number of risers, even, so that a dog-leg has two equal flights."""
    return 2 * int(np.ceil(rise / RISER / 2))


def length_for(kind: str, rise: float) -> float:
    """m of floor that a flight needs along its heading, landings at its ends not counted."""
    n = risers(rise)
    lengths = {"straight": (n - 1) * TREAD, "dogleg": (n // 2 - 1) * TREAD + HALF_LANDING, "ramp": rise / 0.2 + HALF_LANDING}
    return lengths.get(kind, width_for(kind, rise))


def width_for(kind: str, rise: float) -> float:
    """m across that a flight needs; a spiral's treads must be deep enough along its walking line."""
    spiral = max(2.6, np.ceil((risers(rise) - 1) * 0.265 / SPIRAL_TURN * 3 / 2 * 2 * 20) / 20)
    return {"straight": 1.3, "spiral": float(spiral), "lift": 1.0}.get(kind, 2.5)


def staircase(flight: Flight, rise: float) -> Staircase:
    """Build a flight that climbs `rise` metres.

    Raises:
        InputError: the flight is too short for a climbable stair, or of an unknown kind.
    """
    make = {"straight": _straight, "dogleg": _dogleg, "ramp": _ramp, "spiral": _spiral, "lift": _lift}.get(flight.kind)
    if make is None:
        raise InputError(f"flight of kind {flight.kind!r}: straight, dogleg, spiral, ramp or lift are possible")
    parts, (vertices, triangles), path, riser, tread = make(flight.width, flight.length, rise)
    if riser > MAX_RISER + 1e-6 or (riser and tread < MIN_TREAD - 1e-6):
        raise InputError(f"{flight.kind} stair with riser {riser:.3f} m and tread {tread:.3f} m: too steep, lengthen it")
    w, length = flight.width, flight.length
    corners = np.array([[0, 0], [w, 0], [w, length], [0, length]], float)
    shape = shapely.Point(w / 2, w / 2).buffer(w / 2, 8) if flight.kind == "spiral" else shapely.Polygon(corners)
    solid, faces = boxes(parts)
    vertices = np.concatenate([solid, vertices])
    triangles = np.concatenate([faces, triangles + len(solid)])
    place = _placing(flight)
    vertices, path = (np.column_stack([place(v[:, :2]), v[:, 2]]) for v in (vertices, _resample(path)))
    well = shapely.transform(shape, place)
    return Staircase(vertices, triangles, well, path, place(corners), riser, tread)


def _placing(flight: Flight):  # type: ignore[no-untyped-def]
    turn = rotation(flight.heading - np.pi / 2)
    return lambda points: points @ turn + np.asarray(flight.corner)


def _resample(path: Array, count: int = 16) -> Array:
    """`count` points along a polyline; its corners are kept where it has fewer."""
    while len(path) < count:
        longest = int(np.argmax(np.linalg.norm(np.diff(path, axis=0), axis=1)))
        path = np.insert(path, longest + 1, path[longest : longest + 2].mean(axis=0), axis=0)
    if len(path) == count:
        return path
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.linspace(0, along[-1], count)
    return np.stack([np.interp(at, along, path[:, k]) for k in range(3)], axis=1)


NOTHING = (np.zeros((0, 3)), np.zeros((0, 3), int))
Parts = tuple[Array, tuple[Array, Array], Array, float, float]


def _steps(x: float, width: float, y: float, tread: float, riser: float, count: int, bottom: float, rail: float) -> Array:
    """Boxes of `count` steps that go up along y (down along it for a negative tread), with a rail at `x + rail`."""
    i = np.arange(count)
    top = bottom + (i + 1) * riser
    thick = np.minimum(top, STEP_SLAB + riser)
    middle = y + (i + 0.5) * tread
    whole = np.full(count, 1.0)
    steps = np.stack([whole * (x + width / 2), middle, top - thick / 2, whole * width, whole * abs(tread), thick], axis=1)
    rails = np.stack(
        [whole * (x + rail), middle, top + RAIL, whole * 0.05, whole * abs(tread) * 1.05, whole * (riser + 0.05)],
        axis=1,
    )
    posts = np.stack([whole * (x + rail), middle, top + RAIL / 2, whole * 0.02, whole * 0.02, whole * RAIL], axis=1)
    return np.concatenate([steps, rails, posts[::2]])


def _straight(width: float, length: float, rise: float) -> Parts:
    n = risers(rise)
    tread, riser = length / (n - 1), rise / n
    parts = _steps(0, width, 0, tread, riser, n - 1, 0, width - 0.05)
    edge = [
        [width + 0.03, length / 2, rise + RAIL, 0.05, length, 0.06],
        [width + 0.03, length / 2, rise + 0.1, 0.03, length, 0.1],
    ]
    x = width / 2
    path = np.array([[x, -0.6, 0], [x, 0, 0], [x, length, rise], [x, length + 0.6, rise]])
    return np.concatenate([parts, edge]), NOTHING, path, riser, tread


def _dogleg(width: float, length: float, rise: float) -> Parts:
    n = risers(rise)
    each, run, wide = n // 2 - 1, length - HALF_LANDING, (width - DOGLEG_GAP) / 2
    tread, riser = run / each, rise / n
    parts = [_steps(0, wide, 0, tread, riser, each, 0, wide)]
    parts += [_steps(wide + DOGLEG_GAP, wide, run, -tread, riser, each, rise / 2, 0)]
    parts += [np.array([[width / 2, length - HALF_LANDING / 2, rise / 2 - STEP_SLAB / 2, width, HALF_LANDING, STEP_SLAB]])]
    a, b, far = wide / 2, wide * 1.5 + DOGLEG_GAP, length - HALF_LANDING / 2
    path = [[a, -0.6, 0], [a, 0, 0], [a, run, rise / 2], [a, far, rise / 2]]
    path += [[b, far, rise / 2], [b, run, rise / 2], [b, 0, rise], [b, -0.6, rise]]
    return np.concatenate(parts), NOTHING, np.array(path), riser, tread


def _ramp(width: float, length: float, rise: float) -> Parts:
    run, wide = length - HALF_LANDING, (width - DOGLEG_GAP) / 2
    if rise / 2 / run > MAX_SLOPE + 1e-6:
        raise InputError(f"ramp of {length:.1f} m for {rise:.2f} m: steeper than 1:8, lengthen it")
    near = [[x, 0, z] for z in (-STEP_SLAB, 0) for x in (0, wide)]
    far = [[x, run, rise / 2 + z] for z in (-STEP_SLAB, 0) for x in (0, wide)]
    up = np.array(near + far)
    down = up * [1, 1, -1] + [wide + DOGLEG_GAP, 0, rise - STEP_SLAB]
    faces = np.array([[2, 3, 6], [3, 7, 6], [0, 4, 1], [1, 4, 5], [0, 2, 4], [2, 6, 4], [1, 5, 3], [3, 5, 7]])
    sheet = (np.concatenate([up, down]), np.concatenate([faces, faces[:, ::-1] + 8]))
    landing = np.array([[width / 2, length - HALF_LANDING / 2, rise / 2 - STEP_SLAB / 2, width, HALF_LANDING, STEP_SLAB]])
    wall = np.array([[wide + DOGLEG_GAP / 2, run / 2, rise / 2, DOGLEG_GAP, run, rise + 1.8]])
    path = _dogleg(width, length, rise)[2]
    return np.concatenate([landing, wall]), sheet, path, 0.0, 0.0


def _spiral(width: float, length: float, rise: float) -> Parts:
    n, radius = risers(rise), width / 2
    angle = np.radians(-75) + SPIRAL_TURN * np.arange(n) / (n - 1)
    riser, walk = rise / n, radius * 2 / 3
    vertices, triangles = [], []
    for i in range(n - 1):
        arc = np.array([[np.cos(a), np.sin(a)] for a in (angle[i], angle[i + 1] + 0.03)])
        plan = np.concatenate([arc * 0.1, arc * radius]) + radius
        top = (i + 1) * riser
        vertices.append(np.column_stack([np.tile(plan, (2, 1)), np.repeat([top - 0.08, top], 4)]))
        triangles.append(
            np.array([[4, 6, 5], [5, 6, 7], [0, 1, 2], [1, 3, 2], [0, 2, 4], [2, 6, 4], [2, 3, 6], [3, 7, 6]]) + 8 * i
        )
    pole, sides = column(np.array([radius, radius]), 0.1, 0, rise + 1.0)
    rail = [
        [radius + radius * np.cos(a), radius + radius * np.sin(a), i * riser + RAIL / 2 + 0.1, 0.03, 0.03, RAIL]
        for i, a in enumerate(angle)
    ]
    ring = np.column_stack([radius + walk * np.cos(angle), radius + walk * np.sin(angle), np.arange(n) * riser])
    start, end = [[ring[0, 0], -0.6, 0]], [[ring[-1, 0], ring[-1, 1], rise], [ring[-1, 0], -0.6, rise]]
    mesh = (np.concatenate([*vertices, pole]), np.concatenate([*triangles, sides + 8 * (n - 1)]))
    return np.array(rail), mesh, np.concatenate([start, ring, end]), riser, walk * SPIRAL_TURN / (n - 1)


def _lift(width: float, length: float, rise: float) -> Parts:
    x, y = width / 2, length / 2
    return np.zeros((0, 6)), NOTHING, np.array([[x, y, 0], [x, y, rise]]), 0.0, 0.0
