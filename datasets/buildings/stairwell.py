"""Stairs drawn into stairwells that lie over each other in the plans of two storeys."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import shapely
from topomerge.datasets.buildings.stairs import DOGLEG_GAP, HALF_LANDING, MIN_TREAD, TREAD, risers, staircase, width_for
from topomerge.datasets.core.plan import Flight, Plan
from topomerge.datasets.core.solids import rotation

from topomerge.errors import InputError
from topomerge.types import Array

LEAST_STAIRWELL = 4.0  # m2 of a stairwell that both storeys have
APRON = 0.9  # m of floor before a flight
PLACE_STEP = 0.15  # m between places that are tried
PASSING_SPACE = 0.28  # m, half of what a person needs beside the flight
DOORSTEP = 0.8  # m from a door's middle to the free floor
POCKET = 0.5  # m2 of free floor that a flight may cut off
TRIED = 60  # places of a kind of stairs


def add_stairs(plans: Sequence[Plan]) -> tuple[list[Plan], tuple[int, ...]]:
    """Plans with flights where a stairwell lies over a stairwell, and how many there are from each storey to the next.

    A flight is put where it fits into both rooms with its landings, and where every door of both rooms can still be reached; over
    a flight that comes from below, only the same one may go on. Of each stairwell one flight goes up.
    """
    out, count = list(plans), []
    arrives: dict[int, Flight] = {}  # room of the lower storey -> the flight that ends there
    for k, (low, high) in enumerate(pairwise(plans)):
        flights: dict[int, Flight] = {}
        taken: set[int] = set()
        for i, j in _wells(low, high):
            if i in taken or j in flights:
                continue
            rooms = (_shape(low, i), _shape(high, j))
            doors = (_doors(low, rooms[0]), _doors(high, rooms[1]))
            flight = fit_flight(rooms, doors, low.height, arrives.get(i))
            if flight is not None:
                taken.add(i)
                flights[j] = flight
        out[k] = replace(out[k], flights=(*out[k].flights, *flights.values()))
        count.append(len(flights))
        arrives = flights
    return out, tuple(count)


def _shape(plan: Plan, room: int) -> shapely.Polygon:
    return shapely.Polygon(plan.rooms[room].polygon)


def _wells(low: Plan, high: Plan) -> list[tuple[int, int]]:
    """Stairwells of the two plans that lie over each other, those with most floor in common first."""
    rooms = [[i for i, r in enumerate(plan.rooms) if r.kind == "stairs"] for plan in (low, high)]
    common = {(i, j): _shape(low, i).intersection(_shape(high, j)).area for i, j in product(*rooms)}
    return sorted((pair for pair, area in common.items() if area > LEAST_STAIRWELL), key=lambda pair: (-common[pair], pair))


def _doors(plan: Plan, room: shapely.Polygon) -> Array:
    """(n, 2) middles of the doors of a room."""
    passed = [o for o in plan.openings if o.kind in ("door", "opening")]
    middles = np.array([np.add(o.start, o.end) / 2 for o in passed]).reshape(-1, 2)
    reach = np.array([o.thickness / 2 + 0.2 for o in passed])
    return middles[shapely.distance(room, shapely.points(middles)) < reach] if len(middles) else middles


def fit_flight(
    rooms: tuple[shapely.Polygon, shapely.Polygon], doors: tuple[Array, Array], rise: float, given: Flight | None = None
) -> Flight | None:
    """A flight that fits into both stairwells and leaves their doors free; None: there is none.

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
        return given if _climbs(given, rise) and _leaves_free(given, rooms, doors) else None
    edges = np.diff(shapely.get_coordinates(well.minimum_rotated_rectangle), axis=0)
    first = float(np.arctan2(edges[0, 1], edges[0, 0]))
    for kind, width, length in _sizes(rise):
        for heading in (first + np.pi / 2 * k for k in range(4)):
            for flight in _places(well, kind, width, length, heading):
                if _leaves_free(flight, rooms, doors):
                    return flight
    return None


def _climbs(flight: Flight, rise: float) -> bool:
    try:
        staircase(flight, rise)
    except InputError:
        return False
    return True


def _sizes(rise: float) -> list[tuple[str, float, float]]:
    """Kinds of stairs with width and length, the comfortable ones first."""
    n, spiral = risers(rise), width_for("spiral", rise)
    dogleg = [
        ("dogleg", wide, (n // 2 - 1) * tread + HALF_LANDING)
        for tread, wide in product((TREAD, MIN_TREAD), (2.5, 2.0 + DOGLEG_GAP))
    ]
    straight = [("straight", 1.3, (n - 1) * tread) for tread in (TREAD, MIN_TREAD)]
    return [*dogleg, *straight, ("spiral", spiral, spiral)]


def _places(well: shapely.Polygon, kind: str, width: float, length: float, heading: float) -> list[Flight]:
    """Flights of a size and heading within a stairwell, landings included; some of all places, spread evenly."""
    turn = rotation(heading - np.pi / 2)  # own frame -> plan: p @ turn
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


def _leaves_free(flight: Flight, rooms: tuple[shapely.Polygon, shapely.Polygon], doors: tuple[Array, Array]) -> bool:
    """Can one walk from every door of both rooms to the flight's landings, and to all of the floor?"""
    turn = rotation(flight.heading - np.pi / 2)

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
