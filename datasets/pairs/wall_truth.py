"""What is truly in each place along the walls of a simulated building: doors and how they stand, windows, niches, cupboards."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree
from topomerge.datasets.buildings.panes import panes
from topomerge.datasets.core.building import Building

from topomerge.extraction.elevations.elevation import ALONG, WALL_CLASSES, Elevations
from topomerge.types import Array, Sim3

CUPBOARDS = ("shelf", "cabinet", "wardrobe", "kitchen", "locker")  # kinds of furniture that stand before walls
LEAST_CUPBOARD = 0.75  # m, height
IN_ROOM = 0.1  # m behind a face, at most, is the front of what stands in its room
DEEP = 0.3  # m beside a wall's middle: a strip there is of that wall
ASKEW = 0.26  # sine of the angle between a wall and a strip along it
SAME_FLOOR = 0.6  # m between floors of one storey
DOOR_STATES = {"open": ("open", "none"), "half": ("half",), "shut": ("shut",)}  # of each class


def true_classes(building: Building, walls: Elevations, frame: Sim3, shift: tuple[Array, Array] | None) -> Array:
    """(n,) uint8 index into `WALL_CLASSES` of each place along the walls.

    Args:
        frame: of the map in which the walls are.
        shift: places of the building that drift bent, and what undoes it there (None: none did).
    """
    truth = np.zeros(int(walls.first[-1]), np.uint8)
    if not len(truth):
        return truth
    place = np.arange(len(truth)) - np.repeat(walls.first[:-1], np.diff(walls.first))
    face = walls.faces[np.repeat(np.arange(len(walls.faces)), np.diff(walls.first))]
    at = face["start"] + (place + 0.5)[:, None] * ALONG * face["along"]
    beside = (at, at + 0.01 * face["along"], at + 0.01 * face["out"])
    ends = [frame.inverse().apply(np.column_stack([p, face["floor"]])) for p in beside]
    if shift is not None:
        undone = shift[1][cKDTree(shift[0]).query(ends[0])[1]]
        ends = [p + undone for p in ends]
    at, along, out = ends[0], (ends[1] - ends[0])[:, :2] / 0.01, (ends[2] - ends[0])[:, :2] / 0.01
    holes_of = {"cupboard": cupboards(building), "niche": niches_of(building), "window": panes(building)}
    holes_of |= {name: _doors(building, states) for name, states in DOOR_STATES.items()}
    for name, holes in holes_of.items():
        for x, y, z, direction, width, thickness in holes:
            normal = np.array([np.cos(direction), np.sin(direction)])
            off = at[:, :2] - (x, y)
            across, aside = np.abs(off @ normal), np.abs(off @ (-normal[1], normal[0]))
            within = (across < thickness / 2 + DEEP) & (aside < width / 2) & (np.abs(along @ normal) < ASKEW)
            if name == "niche":  # the wall's other face does not show it
                within &= out @ normal > 0
            elif name == "cupboard":  # nor what stands behind the wall
                within &= -(off * out).sum(axis=1) < thickness / 2 + IN_ROOM
            truth[within & (np.abs(at[:, 2] - z) < SAME_FLOOR)] = WALL_CLASSES.index(name)
    return truth


def cupboards(building: Building) -> Sequence[tuple[float, ...]]:
    """As `_doors`, the furniture that stands before walls and is as high as a table or higher."""
    things = building.things
    tall = np.isin(things["kind"], CUPBOARDS) & (things["size"][:, 2] >= LEAST_CUPBOARD)
    rows = []
    for thing in things[tall]:
        x, y, z = thing["centre"].tolist()
        wide, deep, high = thing["size"].tolist()
        rows.append((x, y, z - high / 2, float(thing["yaw"]) + np.pi / 2, wide, deep))
    return rows


def niches_of(building: Building) -> Sequence[tuple[float, ...]]:
    """As `_doors`, the recesses of walls."""
    return [(*n["centre"].tolist(), float(n["direction"]), float(n["width"]), float(n["depth"])) for n in building.niches]


def _doors(building: Building, states: Sequence[str]) -> Sequence[tuple[float, ...]]:
    """Middle on the floor (m), direction of the normal (rad), width and thickness (m) of the doors that stand so."""
    doors = building.doors[np.isin(building.doors["state"], states)]
    return [(*d["centre"].tolist(), *(float(d[k]) for k in ("direction", "width", "thickness"))) for d in doors]
