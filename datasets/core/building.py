"""A building that is known exactly: labelled triangles, true rooms, doors, stairs and storeys.

Procedural buildings (`buildings`) and real plans (`floorplans`) both become a `Plan` per storey; `erect` makes this from them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

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
        niches: (N,) NICHE_DTYPE, recesses of walls; those that are made of a building (`bent`, `twin_wing`) have none.
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

    def edges(self) -> Array:
        """(E, 2) int64 pairs of rooms that doors, openings or stairs join; lifts and outer doors left out."""
        doors = self.doors["rooms"][(self.doors["rooms"] >= 0).all(axis=1)]
        stairs = self.stairs["rooms"][self.stairs["kind"] != "lift"]
        return np.concatenate([doors, stairs]).astype(np.int64).reshape(-1, 2)

    def parts(self) -> Array:
        """(R,) int32 connected part of each room: rooms of one number can be reached from each other on foot."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        edges, count = self.edges(), len(self.rooms)
        graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
        return np.asarray(connected_components(graph, directed=False)[1], np.int32)


def _check(condition: bool, message: str) -> None:
    if not condition:
        raise InputError(message)
