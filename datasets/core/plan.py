"""A storey as drawn on paper: rooms, walls, openings and stairs. `erect` turns plans into a `Building`.

Lengths are metres, heights are above the storey's floor. Free space is the rooms' polygons, minus the walls, plus the
openings: polygons may therefore run along the walls' faces (then no walls need be given: what lies between rooms is solid) or
along their centre lines (then the walls, with their thickness, are cut out of them).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from topomerge.errors import InputError
from topomerge.types import Array

Point = tuple[float, float]


@dataclass(frozen=True, eq=False)
class PlanRoom:
    """A room of a plan.

    Args:
        polygon: (k, 2) float64, simple, either way round, not closed.
        kind: office, corridor, ... decides the furniture; "void" is the upper part of a room below (an atrium), no room.
        ceiling: m; 0: the storey's, spread by the difficulty. Above the storey's height, the room reaches into the
            next storey, whose plan must then have a "void" there.
        slope: m that the ceiling falls along the room's longer side (sloped roofs).
    """

    name: str
    polygon: Array
    kind: str = ""
    ceiling: float = 0.0
    slope: float = 0.0


@dataclass(frozen=True)
class Wall:
    """A wall along its centre line, from floor to ceiling; a glass one is a pane of 2 cm in its middle."""

    start: Point
    end: Point
    thickness: float = 0.15
    glass: bool = False


@dataclass(frozen=True)
class Opening:
    """A hole in a wall: from `start` to `end` along the middle of the wall.

    Args:
        kind: "door" (has a leaf), "opening" (a doorway without leaf), "window" (glazed) or "gallery" (a window without
            glass, above a parapet).
        thickness: m, of the wall; a little more does no harm.
        bottom: m, of the sill; 0 for doors.
        top: m, of the lintel; 0: drawn by the difficulty (doors), up to the lower ceiling (openings).
        state: of the leaf: open, half or shut; empty: drawn by the difficulty.
    """

    kind: str
    start: Point
    end: Point
    thickness: float = 0.2
    bottom: float = 0.0
    top: float = 0.0
    state: str = ""


@dataclass(frozen=True)
class Flight:
    """Stairs, a ramp or a lift from this storey to the next, within a room of both plans.

    Args:
        kind: straight, dogleg, spiral, ramp or lift.
        corner: where the rectangle of the flights starts: standing there and looking along `heading`, the flights lie
            ahead and to the right. The lower landing lies just before it.
        heading: rad, the way one first goes up.
        width: m, across (both flights of a dog-leg; the diameter of a spiral).
        length: m, along; `erect` fills it exactly.
    """

    kind: str
    corner: Point
    heading: float
    width: float
    length: float


@dataclass(frozen=True, eq=False)
class Plan:
    """One storey.

    Args:
        height: m, from this floor to the next one.
        ceiling: m, of most rooms; must leave a slab of at least 0.1 m.
        columns: (c, 4) float64 x, y, side, 1 for round or 0 for square.
    """

    rooms: tuple[PlanRoom, ...]
    walls: tuple[Wall, ...] = ()
    openings: tuple[Opening, ...] = ()
    flights: tuple[Flight, ...] = ()
    columns: Array | None = None
    height: float = 3.2
    ceiling: float = 2.7


MIN_AREA, MAX_AREA = 0.5, 20_000.0  # m2 of a room; beyond it the scale is wrong
MIN_DOOR, MAX_DOOR = 0.4, 12.0  # m of an opening's width
MAX_OVERLAP = 0.05  # share of the smaller room


def check_plan(plan: Plan, name: str = "plan") -> None:
    """Refuse a plan that no building could have.

    Raises:
        InputError: no room; a polygon that is not simple or of an absurd size; overlapping rooms; an opening without width; a
            ceiling that leaves no slab. The message names the plan and the item.
    """
    if not plan.rooms:
        raise InputError(f"{name}: no rooms")
    if not 1.8 <= plan.ceiling <= plan.height - 0.1:
        raise InputError(f"{name}: ceiling at {plan.ceiling} m: give 1.8 m to {plan.height - 0.1:.2f} m (storey less 0.1 m)")
    shapes = [_shape(room, name) for room in plan.rooms]
    first, second = shapely.STRtree(shapes).query(shapes, predicate="intersects")
    for i, j in zip(first.tolist(), second.tolist(), strict=True):
        if i < j and shapes[i].intersection(shapes[j]).area > MAX_OVERLAP * min(shapes[i].area, shapes[j].area):
            raise InputError(f"{name}: rooms {plan.rooms[i].name!r} and {plan.rooms[j].name!r} overlap")
    for k, opening in enumerate(plan.openings):
        width = float(np.hypot(opening.end[0] - opening.start[0], opening.end[1] - opening.start[1]))
        if opening.kind in ("door", "opening") and not MIN_DOOR <= width <= MAX_DOOR:
            raise InputError(f"{name}: {opening.kind} {k} is {width:.2f} m wide, not {MIN_DOOR} to {MAX_DOOR} m")


def _shape(room: PlanRoom, name: str) -> shapely.Polygon:
    if len(room.polygon) < 3 or not np.isfinite(room.polygon).all():
        raise InputError(f"{name}: room {room.name!r} has no outline")
    shape = shapely.Polygon(room.polygon)
    if not shape.is_valid:
        raise InputError(f"{name}: the outline of room {room.name!r} crosses itself")
    if not MIN_AREA <= shape.area <= MAX_AREA:
        raise InputError(f"{name}: room {room.name!r} has {shape.area:.2f} m2: is the scale right?")
    return shape
