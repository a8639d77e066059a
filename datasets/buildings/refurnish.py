"""Other furniture in rooms that stand already, and the furniture of one room copied into another one like it.

Walls, doors, windows and what hangs from the ceiling stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from topomerge.datasets.buildings.fittings import keep_clear
from topomerge.datasets.buildings.furnish import Floor, furnish
from topomerge.datasets.buildings.furniture import Item, footprints
from topomerge.datasets.core.building import SURFACES, THING_DTYPE, Building
from topomerge.datasets.core.solids import boxes

from topomerge.types import Array

SHELL = ("leaf", "column")  # things that are no furniture
DOOR_MATCH = 0.1  # m by which doors of equal rooms may lie apart
FURNISHINGS_TRIED = 4  # of a room in which nothing would stand


@dataclass(frozen=True, eq=False)
class Added:
    """A thing that is put into a building: its row of `Building.things`, vertices (v, 3), triangles (t, 3) and their label."""

    row: Any
    vertices: Array
    triangles: Array
    label: int


def refurnished(
    building: Building, rooms: Sequence[int] | Array, density: float, clutter: float, rng: np.random.Generator
) -> Building:
    """The building with other furniture in these rooms; density 0 and clutter 0: with none.

    Args:
        density, clutter: as of `Difficulty.furniture` and `Difficulty.clutter`.
    """
    rooms = [int(r) for r in rooms]
    added = []
    for room in rooms if density > 0 or clutter > 0 else ():
        for _ in range(FURNISHINGS_TRIED):
            floor, doors = _floor(building, room, [], rng)
            if items := furnish(floor, building.rooms[room].kind, density, clutter, doors):
                break
        added += [_of_item(i, room, building) for i in items]
    things = building.things
    return replaced(building, np.isin(things["room"], rooms) & ~np.isin(things["kind"], SHELL), added)


def restrewn(building: Building, rooms: Sequence[int] | Array, clutter: float, rng: np.random.Generator) -> Building:
    """The building with other clutter on the floors of these rooms: bags, boxes and bins; the furniture stays."""
    rooms = [int(r) for r in rooms]
    things, added = building.things, []
    strewn = np.isin(things["room"], rooms) & (things["kind"] == "clutter")
    for room in rooms:
        standing = things[(things["room"] == room) & ~strewn & (things["kind"] != "leaf")]
        floor, _ = _floor(building, room, [_outline(t) for t in standing], rng)
        added += [_of_item(i, room, building) for i in furnish(floor, building.rooms[room].kind, 0.0, clutter, np.zeros((0, 2)))]
    return replaced(building, strewn, added)


def copied(building: Building, of: Array, to: Array, shift: Array, leaves: bool = False) -> Building:
    """The building in which the rooms `to` hold copies of what stands in the rooms `of`.

    Args:
        of, to: rooms, in one order.
        shift: (2,) m from the ones to the others.
        leaves: copy how doors hang and stand, and nothing else; without it, all but that.
    """
    things, doors = building.things, building.doors.copy()
    partner = dict(zip(of.tolist(), to.tolist(), strict=True))
    of_kind = things["kind"] == "leaf" if leaves else ~np.isin(things["kind"], SHELL)
    door_of = _doors_at(doors, shift)
    added = []
    for i in np.flatnonzero(of_kind & np.isin(things["room"], of)).tolist():
        row = things[i].copy()
        row["room"] = partner[int(row["room"])]
        if leaves:
            row["door"] = door_of[int(row["door"])]
            doors["state"][row["door"]] = doors["state"][things[i]["door"]]
        row["centre"][:2] += shift
        row["pivot"] += shift
        mine = building.triangles[building.thing_of == i]
        used, triangles = np.unique(mine, return_inverse=True)
        label = int(building.labels[building.thing_of == i][0])
        added.append(Added(row, building.vertices[used] + [*shift, 0.0], triangles.reshape(-1, 3), label))
    return replace(replaced(building, of_kind & np.isin(things["room"], to), added), doors=doors)


def replaced(building: Building, gone: Array, added: Sequence[Added]) -> Building:
    """The building without some things (M,) bool, and with others."""
    number = np.append(np.where(gone, -1, np.cumsum(~gone) - 1), -1)
    stays = (building.thing_of < 0) | ~np.append(gone, False)[building.thing_of]
    used, triangles = np.unique(building.triangles[stays], return_inverse=True)
    vertices = [building.vertices[used], *(a.vertices for a in added)]
    first, count = np.cumsum([len(v) for v in vertices]), int((~gone).sum())
    faces = [triangles.reshape(-1, 3), *(a.triangles + n for a, n in zip(added, first, strict=False))]
    labels = [building.labels[stays], *(np.full(len(a.triangles), a.label, np.uint8) for a in added)]
    owner = [number[building.thing_of[stays]], *(np.full(len(a.triangles), count + k) for k, a in enumerate(added))]
    rows = np.array([a.row if isinstance(a.row, tuple) else tuple(a.row) for a in added], THING_DTYPE)
    return replace(
        building,
        vertices=np.concatenate(vertices).astype(np.float32),
        triangles=np.concatenate(faces).astype(np.int32),
        labels=np.concatenate(labels),
        thing_of=np.concatenate(owner).astype(np.int32),
        things=np.concatenate([building.things[~gone], rows]),
    )


def _floor(building: Building, room: int, taken: list[shapely.Polygon], rng: np.random.Generator) -> tuple[Floor, Array]:
    """A room's floor with what is taken there, and where its doors are."""
    shape = shapely.orient_polygons(shapely.Polygon(building.rooms[room].polygon))
    things, doors = building.things, building.doors
    columns = things[(things["room"] == room) & (things["kind"] == "column")]
    taken = [*keep_clear(room, doors, building.stairs), *(_outline(c) for c in columns), *taken]
    height = building.rooms[room].ceiling - building.rooms[room].floor
    return Floor(shape, taken, rng, height), doors[(doors["rooms"] == room).any(axis=1)]["centre"][:, :2]


def _outline(thing: Array) -> shapely.Polygon:
    return shapely.Polygon(footprints(thing["centre"][None, :2], thing["yaw"][None], thing["size"].tolist())[0])


def _of_item(item: Item, room: int, building: Building) -> Added:
    """What furnishing gave, as a thing of a room."""
    floor = building.rooms[room].floor
    vertices, triangles = boxes(item.parts, np.array([*item.at, floor]), item.yaw)
    centre = (*item.at, floor + item.size[2] / 2)
    row = (item.kind, room, -1, centre, item.size, item.yaw, tuple(item.at), item.movable)
    return Added(row, vertices, triangles, SURFACES.index(item.label))


def _doors_at(doors: Array, shift: Array) -> dict[int, int]:
    """Doors -> those that lie by `shift` from them; where none lies, the door itself."""
    out = {}
    for d, door in enumerate(doors):
        far = np.linalg.norm(doors["centre"][:, :2] - door["centre"][:2] - shift, axis=1)
        out[d] = int(far.argmin()) if far.min() < DOOR_MATCH else d
    return out
