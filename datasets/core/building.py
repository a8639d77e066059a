"""A building that is known exactly, its difficulty, and which real building it is of.

A storey as drawn on paper: rooms, walls, openings and stairs. `build_building` turns plans into a `Building`.

Lengths are metres, heights are above the storey's floor. Free space is the rooms' polygons, minus the walls, plus the
openings: polygons may therefore run along the walls' faces (then no walls need be given: what lies between rooms is solid) or
along their centre lines (then the walls, with their thickness, are cut out of them).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import shapely

from topomerge.errors import InputError
from topomerge.types import Array, TrueRoom

SURFACES = (
    "wall",
    "floor",
    "ceiling",
    "leaf",
    "glass",
    "furniture",
    "stair",
    "column",
    "beam",  # and lamps: what hangs from the ceiling
    "clutter",
    "person",
    "facade",  # and the roof: seen from outside only
)
DOOR_DTYPE = np.dtype(
    [
        ("rooms", "i4", 2),  # indices into Building.rooms, -1: outside
        ("centre", "f8", 3),  # on the floor, in the middle of the wall's thickness
        ("width", "f8"),  # m, clear
        ("height", "f8"),  # m, from floor to lintel, or to the lower ceiling where there is none
        ("direction", "f8"),  # rad, of the wall's normal, in [0, pi)
        ("thickness", "f8"),  # m, of the wall
        ("state", "U4"),  # open | half | shut | none (an opening without a leaf)
        ("lintel", "?"),
    ]
)
STAIR_DTYPE = np.dtype(
    [
        ("kind", "U8"),  # straight | dogleg | spiral | ramp | lift
        ("storeys", "i4", 2),  # lower, upper
        ("rooms", "i4", 2),  # room of the lower and of the upper landing
        ("lower", "f8", 3),  # landing points, on the floor
        ("upper", "f8", 3),
        ("footprint", "f8", (4, 2)),  # counter-clockwise rectangle around the flights
        ("riser", "f8"),  # m; 0 for ramps and lifts
        ("tread", "f8"),  # m; along the walking line of a spiral
        ("path", "f8", (16, 3)),  # how feet go from `lower` to `upper`
    ]
)
LEVEL_DTYPE = np.dtype([("floor", "f8"), ("ceiling", "f8")])  # m; the ceiling is that of most rooms
NICHE_DTYPE = np.dtype(
    [
        ("centre", "f8", 3),  # of its footprint, on the room's floor
        ("width", "f8"),  # m
        ("depth", "f8"),
        ("direction", "f8"),  # rad, into the wall, away from its room
        ("bottom", "f8"),  # m above the floor
        ("top", "f8"),
    ]
)
THING_DTYPE = np.dtype(
    [
        ("kind", "U12"),  # desk, chair, leaf, column, lamp, ...
        ("room", "i4"),
        ("door", "i4"),  # of a leaf, else -1
        ("centre", "f8", 3),  # of the box around it
        ("size", "f8", 3),
        ("yaw", "f8"),  # of the box, rad
        ("pivot", "f8", 2),  # what it turns about: the hinge of a leaf, else the centre
        ("movable", "?"),  # may have gone or moved at the next session
    ]
)


@dataclass(frozen=True, eq=False)
class Building:
    """A building as triangles, with everything that is true about it.

    Args:
        name: unique within its source; splits are lists of these.
        kind: office, hotel, house, ...
        vertices: (V, 3) float32, m, z up.
        triangles: (T, 3) int32.
        labels: (T,) uint8, index into `SURFACES`.
        thing_of: (T,) int32, row in `things`, -1: part of the building itself.
        rooms: true rooms; the polygon is the floor between the walls' faces.
        doors: (D,) DOOR_DTYPE, doors and openings that one can walk through.
        stairs: (S,) STAIR_DTYPE, one row a flight between two neighbouring storeys.
        storeys: (L,) LEVEL_DTYPE, lowest first.
        things: (M,) THING_DTYPE, furniture, door leaves, columns, lamps: everything that stands in the rooms.
        niches: (N,) NICHE_DTYPE, recesses of walls; those that are made of a building (`bent`, `make_twin_wing`) have none.
        seed: what it was made from; -1 for a real plan whose furniture was not drawn.
        parameters: what it was made with.
    """

    name: str
    kind: str
    vertices: Array
    triangles: Array
    labels: Array
    thing_of: Array
    rooms: tuple[TrueRoom, ...]
    doors: Array
    stairs: Array
    storeys: Array
    things: Array
    seed: int = -1
    parameters: Mapping[str, Any] = field(default_factory=dict)
    niches: Array = field(default_factory=lambda: np.zeros(0, NICHE_DTYPE))

    def __post_init__(self) -> None:
        count = len(self.triangles)
        _check(len(self.labels) == count and len(self.thing_of) == count, "one label and one thing a triangle")
        _check(bool(np.isfinite(self.vertices).all()), f"{self.name}: a vertex is not finite")
        _check(not count or int(self.triangles.max()) < len(self.vertices), f"{self.name}: a triangle lacks a vertex")
        _check(not count or int(self.thing_of.max()) < len(self.things), f"{self.name}: a triangle lacks its thing")
        for name, dtype in (("doors", DOOR_DTYPE), ("stairs", STAIR_DTYPE), ("storeys", LEVEL_DTYPE)):
            _check(getattr(self, name).dtype == dtype, f"{name} must have {name.upper()} dtype")
        for ends in (self.doors["rooms"], self.stairs["rooms"]):
            _check(not ends.size or int(ends.max()) < len(self.rooms), f"{self.name}: a room of an edge is missing")

    def list_edges(self) -> Array:
        """List (E, 2) int64 pairs of rooms that doors, openings or stairs join; lifts and outer doors left out."""
        doors = self.doors["rooms"][(self.doors["rooms"] >= 0).all(axis=1)]
        stairs = self.stairs["rooms"][self.stairs["kind"] != "lift"]
        return np.concatenate([doors, stairs]).astype(np.int64).reshape(-1, 2)

    def find_components(self) -> Array:
        """Find (R,) int32 connected part of each room: rooms of one number can be reached from each other on foot."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        edges, count = self.list_edges(), len(self.rooms)
        graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
        return np.asarray(connected_components(graph, directed=False)[1], np.int32)


def _check(condition: bool, message: str) -> None:
    if not condition:
        raise InputError(message)


@dataclass(frozen=True)
class Difficulty:
    """Shares are 0 to 1; the defaults are an ordinary, tidy building.

    Args:
        lintels: share of doors with a lintel; the others reach the ceiling.
        ceiling_spread: m, standard deviation of the rooms' ceilings about the storey's.
        furniture: density; 0 is an empty building, 1 a tidy one, 2 crammed.
        clutter: boxes, bags and bins on the floor of 10 m2.
        windows: share of the windows that are there.
        glass: share of the walls to corridors that are glazed.
        open, half: shares of the doors that stand open and half open; the others are shut.
        lamps: share of the rooms with lamps hanging below the ceiling.
        beams: share of the rooms with beams.
        columns: share of the large rooms with columns.
        slopes: share of the top storey's rooms with a sloped ceiling.
        curved: share of the plans with a round or slanted part.
        differ: share of the upper storeys with a plan of their own; the others repeat the one below.
        atria: share of buildings of two or more storeys with a hall through two of them.
        moved: share of the movable things that stand elsewhere at the next session; as many again by less than 0.3 m.
        gone: share of the movable things that are gone at the next session.
        doors_moved: share of the doors that stand differently at the next session.
        people: persons a room at the next session.
        ducts: share of the rooms with ducts, trays or rows of panels under the ceiling.
        closets: share of the larger rooms beside a corridor out of which a closet is cut.
        spread: how much rooms of a kind differ in width: share that are half as wide again or more.
        frames: share of the doors with a frame around them and handles, whose leaves stand anywhere in the wall's thickness; the
            leaves of the others lie in the wall's face.
        niches: share of the longer walls with a recess, as deep as what is behind allows.
    """

    lintels: float = 0.9
    ceiling_spread: float = 0.1
    furniture: float = 1.3
    clutter: float = 0.8
    windows: float = 0.9
    glass: float = 0.05
    open: float = 0.6
    half: float = 0.2
    lamps: float = 0.4
    beams: float = 0.2
    columns: float = 0.3
    slopes: float = 0.1
    curved: float = 0.1
    differ: float = 0.3
    atria: float = 0.3
    moved: float = 0.2
    gone: float = 0.1
    doors_moved: float = 0.3
    people: float = 0.2
    ducts: float = 0.25
    closets: float = 0.12
    spread: float = 0.2
    frames: float = 0.0
    niches: float = 0.0

    def __post_init__(self) -> None:
        limits = {"furniture": 3.0, "clutter": 5.0, "people": 5.0}
        for name in (f.name for f in fields(self)):
            value, limit = getattr(self, name), limits.get(name, 1.0)
            if not 0 <= value <= limit:
                raise InputError(f"difficulty {name} must be 0 to {limit:g}, not {value}")
        if self.open + self.half > 1:
            raise InputError(f"difficulty: open {self.open} + half {self.half} must not exceed 1")


# What a name says of its storey, in words.
LEVEL_WORDS = {
    "basement": -1.0,
    "lower": 0.0,
    "ground": 0.0,
    "main": 1.0,
    "first": 1.0,
    "upper": 2.0,
    "second": 2.0,
    "third": 3.0,
}
ALIASES = {"romainrolland": "romainroland"}  # misspelt by the owner
STRANGERS = ("scuolasconosciuta",)  # "unknown school": the three are different ones
HOMES = ("1c", "l10su")  # robots of which every map is of one home, on another day
SESSIONS = ("tsc", "g4s", "umic", "movecare", "uma")  # of one place, named by date or version behind it
OF_ONE_PLACE = {"octomap": "freiburg/78", "ipad": "delft", "libpointmatcher": "libpointmatcher", "gdc": "utexas/gdc"}


def find_physical_building(source: str, name: str) -> str:
    """Find the real (or made) building of a map; of a pair of two buildings, ``a + b``, that of a.

    Storeys, stacks of storeys, wings, sessions and sensors of one building are one; a procedural building is its kind and seed.

    Args:
        source: procedural, r2v, campus, rmf, mall, utexas, ipa, halmstad, carmen, strands ... as of `plans.splits`.
        name: of the building, its plan or its map, as the source's reader gives it.
    """
    name = name.split(" + ")[0]
    source = source.removesuffix("-plan")
    if source == "own":  # its name is what its owner calls it
        return f"own/{name}"
    if source in OF_ONE_PLACE:
        return OF_ONE_PLACE[source]
    if source == "procedural":  # kind-seed-storeys; kinds may have hyphens
        return f"procedural/{re.sub(r'(?<=[0-9])-.*$', '', name)}"
    if source == "r2v":  # the plans of one property
        return f"r2v/{name.rpartition('/')[0] or name}"
    if source == "home":
        return f"home/{next((h for h in HOMES if name.startswith(h)), name)}"
    if source == "halmstad":
        return f"halmstad/{re.split(r'[_/-]', name)[0]}"
    last = name.rpartition("/")[2].lower()
    if source == "utexas":
        return f"utexas/{next((b for b in ('ahg', 'ase') if last.startswith(b)), 'gdc')}"
    place = re.sub(r"(_scan|_furnitures|_trashbins|_gt_segmentation|-corrected)+$", "", last)
    if freiburg := re.match(r"freiburg-?0*(\d+)", place):
        return f"freiburg/{freiburg[1]}"
    if source == "strands":
        return f"strands/{next((s for s in SESSIONS if last.startswith(s)), last)}"
    if source in ("campus", "rmf", "mall"):
        above = name.rpartition("/")[0]
        base, _ = parse_storey_name(name.rpartition("/")[2])
        return f"{source}/" + "/".join(part for part in (above, last if base in STRANGERS else base) if part)
    return f"{source}/{re.sub('-(first|middle|last)-(first|middle|last)$', '', place)}"


def parse_storey_name(name: str) -> tuple[str, float]:
    """Parse the building and the storey in a plan's name: ("sabadell", 2) of Sabadell2."""
    word = re.fullmatch(rf"(.*?)[ _-]*({'|'.join(LEVEL_WORDS)})(?:[ _-]*floor)?", name, re.IGNORECASE)
    if word:
        return word[1].lower(), LEVEL_WORDS[word[2].lower()]
    number = re.fullmatch(r"(.*?)[ _-]*([PFBL]?)(\d)(v\d|[ns]?e?)", name)
    if not number:
        return name, 0.0
    base, level = number[1].lower(), float(number[3])
    return ALIASES.get(base, base), (-level if number[2] == "B" else level) + (0.5 if number[4] else 0.0)


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
        length: m, along; `build_building` fills it exactly.
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
    shapes = [_build_polygon(room, name) for room in plan.rooms]
    first, second = shapely.STRtree(shapes).query(shapes, predicate="intersects")
    for i, j in zip(first.tolist(), second.tolist(), strict=True):
        if i < j and shapes[i].intersection(shapes[j]).area > MAX_OVERLAP * min(shapes[i].area, shapes[j].area):
            raise InputError(f"{name}: rooms {plan.rooms[i].name!r} and {plan.rooms[j].name!r} overlap")
    for k, opening in enumerate(plan.openings):
        width = float(np.hypot(opening.end[0] - opening.start[0], opening.end[1] - opening.start[1]))
        if opening.kind in ("door", "opening") and not MIN_DOOR <= width <= MAX_DOOR:
            raise InputError(f"{name}: {opening.kind} {k} is {width:.2f} m wide, not {MIN_DOOR} to {MAX_DOOR} m")


def _build_polygon(room: PlanRoom, name: str) -> shapely.Polygon:
    if len(room.polygon) < 3 or not np.isfinite(room.polygon).all():
        raise InputError(f"{name}: room {room.name!r} has no outline")
    shape = shapely.Polygon(room.polygon)
    if not shape.is_valid:
        raise InputError(f"{name}: the outline of room {room.name!r} crosses itself")
    if not MIN_AREA <= shape.area <= MAX_AREA:
        raise InputError(f"{name}: room {room.name!r} has {shape.area:.2f} m2: is the scale right?")
    return shape
