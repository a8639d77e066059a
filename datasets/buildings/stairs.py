"""Stairs, ramps and lifts, also in stairwells of real plans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
import shapely
from topomerge.datasets.core.building import Flight, Plan
from topomerge.datasets.core.solids import build_rotation, triangulate_boxes, triangulate_column

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


def count_risers(rise: float) -> int:
    """Compute the number of risers, even, so that a dog-leg has two equal flights."""
    return 2 * int(np.ceil(rise / RISER / 2))


def compute_flight_length(kind: str, rise: float) -> float:
    """Compute the length, m, that a flight needs along its heading, landings at its ends not counted."""
    n = count_risers(rise)
    lengths = {"straight": (n - 1) * TREAD, "dogleg": (n // 2 - 1) * TREAD + HALF_LANDING, "ramp": rise / 0.2 + HALF_LANDING}
    return lengths.get(kind, compute_flight_width(kind, rise))


def compute_flight_width(kind: str, rise: float) -> float:
    """Return the metres across that a flight needs; a spiral's treads must be deep enough along its walking line."""
    spiral = max(2.6, np.ceil((count_risers(rise) - 1) * 0.265 / SPIRAL_TURN * 3 / 2 * 2 * 20) / 20)
    return {"straight": 1.3, "spiral": float(spiral), "lift": 1.0}.get(kind, 2.5)


def build_staircase(flight: Flight, rise: float) -> Staircase:
    """Build a flight that climbs `rise` metres.

    Raises:
        InputError: the flight is too short for a climbable stair, or of an unknown kind.
    """
    make = {
        "straight": _build_straight,
        "dogleg": _build_dogleg,
        "ramp": _build_ramp,
        "spiral": _build_spiral,
        "lift": _build_lift,
    }.get(flight.kind)
    if make is None:
        raise InputError(f"flight of kind {flight.kind!r}: straight, dogleg, spiral, ramp or lift are possible")
    parts, (vertices, triangles), path, riser, tread = make(flight.width, flight.length, rise)
    if riser > MAX_RISER + 1e-6 or (riser and tread < MIN_TREAD - 1e-6):
        raise InputError(f"{flight.kind} stair with riser {riser:.3f} m and tread {tread:.3f} m: too steep, lengthen it")
    w, length = flight.width, flight.length
    corners = np.array([[0, 0], [w, 0], [w, length], [0, length]], float)
    shape = shapely.Point(w / 2, w / 2).buffer(w / 2, 8) if flight.kind == "spiral" else shapely.Polygon(corners)
    solid, faces = triangulate_boxes(parts)
    vertices = np.concatenate([solid, vertices])
    triangles = np.concatenate([faces, triangles + len(solid)])
    place = _build_placement(flight)
    vertices, path = (np.column_stack([place(v[:, :2]), v[:, 2]]) for v in (vertices, _resample(path)))
    well = shapely.transform(shape, place)
    return Staircase(vertices, triangles, well, path, place(corners), riser, tread)


def _build_placement(flight: Flight):  # type: ignore[no-untyped-def]
    turn = build_rotation(flight.heading - np.pi / 2)
    return lambda points: points @ turn + np.asarray(flight.corner)


def _resample(path: Array, count: int = 16) -> Array:
    """Return `count` points along a polyline; its corners are kept where it has fewer."""
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


def _build_steps(x: float, width: float, y: float, tread: float, riser: float, count: int, bottom: float, rail: float) -> Array:
    """Build the boxes of `count` steps that go up along y (down along it for a negative tread), with a rail at `x + rail`."""
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


def _build_straight(width: float, length: float, rise: float) -> Parts:
    n = count_risers(rise)
    tread, riser = length / (n - 1), rise / n
    parts = _build_steps(0, width, 0, tread, riser, n - 1, 0, width - 0.05)
    edge = [
        [width + 0.03, length / 2, rise + RAIL, 0.05, length, 0.06],
        [width + 0.03, length / 2, rise + 0.1, 0.03, length, 0.1],
    ]
    x = width / 2
    path = np.array([[x, -0.6, 0], [x, 0, 0], [x, length, rise], [x, length + 0.6, rise]])
    return np.concatenate([parts, edge]), NOTHING, path, riser, tread


def _build_dogleg(width: float, length: float, rise: float) -> Parts:
    n = count_risers(rise)
    each, run, wide = n // 2 - 1, length - HALF_LANDING, (width - DOGLEG_GAP) / 2
    tread, riser = run / each, rise / n
    parts = [_build_steps(0, wide, 0, tread, riser, each, 0, wide)]
    parts += [_build_steps(wide + DOGLEG_GAP, wide, run, -tread, riser, each, rise / 2, 0)]
    parts += [np.array([[width / 2, length - HALF_LANDING / 2, rise / 2 - STEP_SLAB / 2, width, HALF_LANDING, STEP_SLAB]])]
    a, b, far = wide / 2, wide * 1.5 + DOGLEG_GAP, length - HALF_LANDING / 2
    path = [[a, -0.6, 0], [a, 0, 0], [a, run, rise / 2], [a, far, rise / 2]]
    path += [[b, far, rise / 2], [b, run, rise / 2], [b, 0, rise], [b, -0.6, rise]]
    return np.concatenate(parts), NOTHING, np.array(path), riser, tread


def _build_ramp(width: float, length: float, rise: float) -> Parts:
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
    path = _build_dogleg(width, length, rise)[2]
    return np.concatenate([landing, wall]), sheet, path, 0.0, 0.0


def _build_spiral(width: float, length: float, rise: float) -> Parts:
    n, radius = count_risers(rise), width / 2
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
    pole, sides = triangulate_column(np.array([radius, radius]), 0.1, 0, rise + 1.0)
    rail = [
        [radius + radius * np.cos(a), radius + radius * np.sin(a), i * riser + RAIL / 2 + 0.1, 0.03, 0.03, RAIL]
        for i, a in enumerate(angle)
    ]
    ring = np.column_stack([radius + walk * np.cos(angle), radius + walk * np.sin(angle), np.arange(n) * riser])
    start, end = [[ring[0, 0], -0.6, 0]], [[ring[-1, 0], ring[-1, 1], rise], [ring[-1, 0], -0.6, rise]]
    mesh = (np.concatenate([*vertices, pole]), np.concatenate([*triangles, sides + 8 * (n - 1)]))
    return np.array(rail), mesh, np.concatenate([start, ring, end]), riser, walk * SPIRAL_TURN / (n - 1)


def _build_lift(width: float, length: float, rise: float) -> Parts:
    x, y = width / 2, length / 2
    return np.zeros((0, 6)), NOTHING, np.array([[x, y, 0], [x, y, rise]]), 0.0, 0.0


LEAST_STAIRWELL = 4.0  # m2 of a stairwell that both storeys have
APRON = 0.9  # m of floor before a flight
PLACE_STEP = 0.15  # m between places that are tried
PASSING_SPACE = 0.28  # m, half of what a person needs beside the flight
DOORSTEP = 0.8  # m from a door's middle to the free floor
POCKET = 0.5  # m2 of free floor that a flight may cut off
TRIED = 60  # places of a kind of stairs


def add_stairs(plans: Sequence[Plan]) -> tuple[list[Plan], tuple[int, ...]]:
    """Return plans with flights where a stairwell lies over a stairwell, and how many there are from each storey to the next.

    A flight is put where it fits into both rooms with its landings, and where every door of both rooms can still be reached; over
    a flight that comes from below, only the same one may go on. Of each stairwell one flight goes up.
    """
    out, count = list(plans), []
    arrives: dict[int, Flight] = {}  # room of the lower storey -> the flight that ends there
    for k, (low, high) in enumerate(pairwise(plans)):
        flights: dict[int, Flight] = {}
        taken: set[int] = set()
        for i, j in _find_stairwells(low, high):
            if i in taken or j in flights:
                continue
            rooms = (_build_polygon(low, i), _build_polygon(high, j))
            doors = (_find_doors(low, rooms[0]), _find_doors(high, rooms[1]))
            flight = fit_flight(rooms, doors, low.height, arrives.get(i))
            if flight is not None:
                taken.add(i)
                flights[j] = flight
        out[k] = replace(out[k], flights=(*out[k].flights, *flights.values()))
        count.append(len(flights))
        arrives = flights
    return out, tuple(count)


def _build_polygon(plan: Plan, room: int) -> shapely.Polygon:
    return shapely.Polygon(plan.rooms[room].polygon)


def _find_stairwells(low: Plan, high: Plan) -> list[tuple[int, int]]:
    """Return the stairwells of the two plans that lie over each other, those with most floor in common first."""
    rooms = [[i for i, r in enumerate(plan.rooms) if r.kind == "stairs"] for plan in (low, high)]
    common = {(i, j): _build_polygon(low, i).intersection(_build_polygon(high, j)).area for i, j in product(*rooms)}
    return sorted((pair for pair, area in common.items() if area > LEAST_STAIRWELL), key=lambda pair: (-common[pair], pair))


def _find_doors(plan: Plan, room: shapely.Polygon) -> Array:
    """Return (n, 2) middles of the doors of a room."""
    passed = [o for o in plan.openings if o.kind in ("door", "opening")]
    middles = np.array([np.add(o.start, o.end) / 2 for o in passed]).reshape(-1, 2)
    reach = np.array([o.thickness / 2 + 0.2 for o in passed])
    return middles[shapely.distance(room, shapely.points(middles)) < reach] if len(middles) else middles


def fit_flight(
    rooms: tuple[shapely.Polygon, shapely.Polygon], doors: tuple[Array, Array], rise: float, given: Flight | None = None
) -> Flight | None:
    """Fit a flight into both stairwells that leaves their doors free; None: there is none.

    Args:
        rooms: of the lower and of the upper storey.
        doors: (n, 2) middles of the doors of each.
        given: only this one, where it fits.
    """
    well = rooms[0].intersection(rooms[1]).buffer(-0.03, join_style="mitre")
    well = max((p for p in shapely.get_parts(well) if p.geom_type == "Polygon"), key=lambda p: p.area, default=None)
    if well is None or well.area < LEAST_STAIRWELL:
        return None
    if given is not None:
        return given if _is_climbable(given, rise) and _is_clear(given, rooms, doors) else None
    edges = np.diff(shapely.get_coordinates(well.minimum_rotated_rectangle), axis=0)
    first = float(np.arctan2(edges[0, 1], edges[0, 0]))
    for kind, width, length in _list_sizes(rise):
        for heading in (first + np.pi / 2 * k for k in range(4)):
            for flight in _list_placements(well, kind, width, length, heading):
                if _is_clear(flight, rooms, doors):
                    return flight
    return None


def _is_climbable(flight: Flight, rise: float) -> bool:
    try:
        build_staircase(flight, rise)
    except InputError:
        return False
    return True


def _list_sizes(rise: float) -> list[tuple[str, float, float]]:
    """List the kinds of stairs with width and length, the comfortable ones first."""
    n, spiral = count_risers(rise), compute_flight_width("spiral", rise)
    dogleg = [
        ("dogleg", wide, (n // 2 - 1) * tread + HALF_LANDING)
        for tread, wide in product((TREAD, MIN_TREAD), (2.5, 2.0 + DOGLEG_GAP))
    ]
    straight = [("straight", 1.3, (n - 1) * tread) for tread in (TREAD, MIN_TREAD)]
    return [*dogleg, *straight, ("spiral", spiral, spiral)]


def _list_placements(well: shapely.Polygon, kind: str, width: float, length: float, heading: float) -> list[Flight]:
    """List the flights of a size and heading within a stairwell, landings included; some of all places, spread evenly."""
    turn = build_rotation(heading - np.pi / 2)  # own frame -> plan: p @ turn
    shape = shapely.transform(well, lambda p: p @ turn.T)
    low, high = np.array(shape.bounds).reshape(2, 2)
    after = APRON if kind == "straight" else 0.0
    spans = high - low - (width, length + APRON + after)
    if min(spans) < 0:
        return []
    x, y = (np.arange(0, span + 1e-9, PLACE_STEP) + start for span, start in zip(spans, low, strict=True))
    x, y = (g.ravel() for g in np.meshgrid(x, y + APRON))
    boxes = shapely.box(x, y - APRON, x + width, y + length + after)
    shapely.prepare(shape)
    fits = np.flatnonzero(shapely.covers(shape, boxes))
    fits = fits[np.unique(np.linspace(0, len(fits) - 1, min(len(fits), TRIED)).round().astype(int))] if len(fits) else fits
    corners = np.round(np.column_stack([x, y])[fits] @ turn, 3)
    return [Flight(kind, (float(a), float(b)), round(heading, 6), width, round(length, 3)) for a, b in corners[::-1]]


def _is_clear(flight: Flight, rooms: tuple[shapely.Polygon, shapely.Polygon], doors: tuple[Array, Array]) -> bool:
    """Return whether one can walk from every door of both rooms to the flight's landings, and to all of the floor."""
    turn = build_rotation(flight.heading - np.pi / 2)

    def place(points: Array) -> Array:
        return np.asarray(np.asarray(points) @ turn + flight.corner)

    body = shapely.transform(shapely.box(0, 0, flight.width, flight.length), place)
    far = flight.length + 0.6 if flight.kind == "straight" else -0.6
    across = {"straight": (0.5, 0.5), "dogleg": (0.25, 0.75), "spiral": (0.75, 0.5)}[flight.kind]
    landings = place(np.array([[across[0] * flight.width, -0.6], [across[1] * flight.width, far]]))
    for room, middles, landing in zip(rooms, doors, landings, strict=True):
        free = room.difference(body.buffer(0.02)).buffer(-PASSING_SPACE, join_style="mitre")
        parts = [p for p in shapely.get_parts(free) if p.distance(shapely.Point(landing)) < 0.3]
        reached = max(parts, key=lambda p: p.area, default=None)
        if reached is None or free.area - reached.area > POCKET or not len(middles):
            return False
        if shapely.distance(reached, shapely.points(middles)).max() > DOORSTEP:
            return False
    return True
