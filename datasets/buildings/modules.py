"""Other furniture in rooms that stand already, and the furniture of one room copied into another one like it.

Walls, doors, windows and what hangs from the ceiling stay as they are.

Rows of equal modules along a corridor: the buildings in which one place looks like the next.

A module is a bay of the corridor with the rooms beside it, on one side or on both. All have the same outlines, doors and windows,
so that the row, moved by a whole number of periods, lies on itself; only its two ends differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.buildings.drafting import Draft
from topomerge.datasets.buildings.fittings import keep_clear
from topomerge.datasets.buildings.furniture import FurnishedFloor, Item, compute_footprints, furnish
from topomerge.datasets.core.building import SURFACES, THING_DTYPE, Building, Difficulty, Opening, PlanRoom
from topomerge.datasets.core.solids import triangulate_boxes

from topomerge.types import Array

SHELL = ("leaf", "column")  # things that are no furniture
DOOR_MATCH = 0.1  # m by which doors of equal rooms may lie apart
FURNISHINGS_TRIED = 4  # of a room in which nothing would stand


@dataclass(frozen=True, eq=False)
class AddedThing:
    """A thing that is put into a building: its row of `Building.things`, vertices (v, 3), triangles (t, 3) and their label."""

    row: Any
    vertices: Array
    triangles: Array
    label: int


def replace_furniture(
    building: Building, rooms: Sequence[int] | Array, density: float, clutter: float, rng: np.random.Generator
) -> Building:
    """Return the building with other furniture in these rooms; density 0 and clutter 0: with none.

    Args:
        density, clutter: as of `Difficulty.furniture` and `Difficulty.clutter`.
    """
    rooms = [int(r) for r in rooms]
    added = []
    for room in rooms if density > 0 or clutter > 0 else ():
        for _ in range(FURNISHINGS_TRIED):
            floor, doors = _build_floor(building, room, [], rng)
            if items := furnish(floor, building.rooms[room].kind, density, clutter, doors):
                break
        added += [_convert_item(i, room, building) for i in items]
    things = building.things
    return replace_things(building, np.isin(things["room"], rooms) & ~np.isin(things["kind"], SHELL), added)


def replace_clutter(building: Building, rooms: Sequence[int] | Array, clutter: float, rng: np.random.Generator) -> Building:
    """Return the building with other clutter on the floors of these rooms: bags, boxes and bins; the furniture stays."""
    rooms = [int(r) for r in rooms]
    things, added = building.things, []
    strewn = np.isin(things["room"], rooms) & (things["kind"] == "clutter")
    for room in rooms:
        standing = things[(things["room"] == room) & ~strewn & (things["kind"] != "leaf")]
        floor, _ = _build_floor(building, room, [_compute_outline(t) for t in standing], rng)
        added += [
            _convert_item(i, room, building) for i in furnish(floor, building.rooms[room].kind, 0.0, clutter, np.zeros((0, 2)))
        ]
    return replace_things(building, strewn, added)


def copy_furniture(building: Building, of: Array, to: Array, shift: Array, leaves: bool = False) -> Building:
    """Return the building in which the rooms `to` hold copies of what stands in the rooms `of`.

    Args:
        of, to: rooms, in one order.
        shift: (2,) m from the ones to the others.
        leaves: copy how doors hang and stand, and nothing else; without it, all but that.
    """
    things, doors = building.things, building.doors.copy()
    partner = dict(zip(of.tolist(), to.tolist(), strict=True))
    of_kind = things["kind"] == "leaf" if leaves else ~np.isin(things["kind"], SHELL)
    door_of = _match_doors(doors, shift)
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
        added.append(AddedThing(row, building.vertices[used] + [*shift, 0.0], triangles.reshape(-1, 3), label))
    return replace(replace_things(building, of_kind & np.isin(things["room"], to), added), doors=doors)


def replace_things(building: Building, gone: Array, added: Sequence[AddedThing]) -> Building:
    """Return the building without some things (M,) bool, and with others."""
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


def _build_floor(
    building: Building, room: int, taken: list[shapely.Polygon], rng: np.random.Generator
) -> tuple[FurnishedFloor, Array]:
    """Return a room's floor with what is taken there, and where its doors are."""
    shape = shapely.orient_polygons(shapely.Polygon(building.rooms[room].polygon))
    things, doors = building.things, building.doors
    columns = things[(things["room"] == room) & (things["kind"] == "column")]
    taken = [*keep_clear(room, doors, building.stairs), *(_compute_outline(c) for c in columns), *taken]
    height = building.rooms[room].ceiling - building.rooms[room].floor
    return FurnishedFloor(shape, taken, rng, height), doors[(doors["rooms"] == room).any(axis=1)]["centre"][:, :2]


def _compute_outline(thing: Array) -> shapely.Polygon:
    return shapely.Polygon(compute_footprints(thing["centre"][None, :2], thing["yaw"][None], thing["size"].tolist())[0])


def _convert_item(item: Item, room: int, building: Building) -> AddedThing:
    """Convert an item of furniture to a thing of a room."""
    floor = building.rooms[room].floor
    vertices, triangles = triangulate_boxes(item.parts, np.array([*item.at, floor]), item.yaw)
    centre = (*item.at, floor + item.size[2] / 2)
    row = (item.kind, room, -1, centre, item.size, item.yaw, tuple(item.at), item.movable)
    return AddedThing(row, vertices, triangles, SURFACES.index(item.label))


def _match_doors(doors: Array, shift: Array) -> dict[int, int]:
    """Map doors to those that lie by `shift` from them; where none lies, the door itself."""
    out = {}
    for d, door in enumerate(doors):
        far = np.linalg.norm(doors["centre"][:, :2] - door["centre"][:2] - shift, axis=1)
        out[d] = int(far.argmin()) if far.min() < DOOR_MATCH else d
    return out


EQUAL = Difficulty(
    ceiling_spread=0.0, furniture=0.0, clutter=0.0, windows=1.0, glass=0.0, lamps=0.0, beams=0.0, columns=0.0, slopes=0.0,
    ducts=0.0, closets=0.0, spread=0.0, lintels=1.0,
)  # fmt: skip
MODULE_LAYOUTS = ("room", "ensuite", "pair", "suite")
WIDTHS = {"room": (3.2, 7.5), "ensuite": (3.6, 4.8), "pair": (6.4, 9.0), "suite": (7.0, 9.5)}  # m, the period
ROOM_KINDS = ("office", "bedroom", "ward", "classroom", "lab", "living", "meeting", "nurses")
ALCOVE = (1.5, 2.2)  # m, depth of the alcove of a suite


@dataclass(frozen=True)
class ModuleRow:
    """A row of equal modules.

    Args:
        building: the building, its rooms module by module.
        period: m from one module to the next, along x.
        count: of modules.
        module: (R,) of each room.
        both: are there rooms on both sides of the corridor?
    """

    building: Building
    period: float
    count: int
    module: Array
    both: bool


@dataclass(frozen=True)
class ModulePlan:
    """Settings that a row of modules is drawn from; lengths in metres.

    Args:
        layout: of the rooms beside a bay, one of `MODULE_LAYOUTS`.
        kinds: of its rooms.
        width: of a module, the period; depth: of its rooms; corridor: of the corridor; split: share of the width that the first
            room of two takes; alcove: depth of the alcove of a suite.
        both: rooms on both sides; turned: those of the other side are turned by half a turn, else mirrored.
        ends: by which the corridor is longer at its two ends.
        doors: share of the wall at which the doors stand.
    """

    layout: str
    kinds: tuple[str, str]
    width: float
    depth: float
    corridor: float
    split: float
    alcove: float
    both: bool
    turned: bool
    ends: tuple[float, float]
    doors: float


def draw_module(layout: str, rng: np.random.Generator) -> ModulePlan:
    """Draw the sizes and kinds of rooms of a module of a layout."""
    low, high = WIDTHS[layout]
    kinds = ("hotel", "bath") if layout == "ensuite" else tuple(str(k) for k in rng.choice(ROOM_KINDS, 2))
    return ModulePlan(
        layout=layout,
        kinds=(kinds[0], kinds[1]),
        width=round(float(rng.uniform(low, high)), 2),
        depth=round(float(rng.uniform(4.0, 5.8)), 2),
        corridor=round(float(rng.uniform(1.6, 2.6)), 2),
        split=round(float(rng.uniform(0.42, 0.6)), 2),
        alcove=round(float(rng.uniform(*ALCOVE)), 2),
        both=bool(rng.random() < 0.25),
        turned=bool(rng.random() < 0.5),
        ends=(round(float(rng.uniform(0.0, 3.0)), 2), round(float(rng.uniform(0.0, 3.0)), 2)),
        doors=round(float(rng.uniform(0.2, 0.8)), 2),
    )


def make_row(module: ModulePlan, count: int, difficulty: Difficulty, seed: int, name: str) -> ModuleRow:
    """Make a row of modules, unfurnished (`replace_furniture` puts things into it); door leaves hang alike in all modules.

    Args:
        difficulty: its `lintels` (all or none), `open` and `half` are used.
    """
    rng = np.random.default_rng(seed)
    draft = Draft(round(float(rng.uniform(0.1, 0.2)), 2), rng)
    owner: list[int] = []
    bays = []
    for k in range(count):
        bays.append(_add_bay(draft, module, k, count))
        for side in (1, -1) if module.both else (1,):
            _add_rooms(draft, module, k * module.width, bays[-1], side)
        owner += [k] * (len(draft.rooms) - len(owner))
    for k in range(1, count):
        x, inset = k * module.width, draft.wall / 2
        draft.openings.append(Opening("opening", (x, inset), (x, module.corridor - inset), 0.1))
    for i, room in enumerate(draft.rooms):
        if room.kind not in ("bath", "storage"):
            draft.add_windows(i, 1.4, 0.9, 2.4)
    height = round(float(rng.uniform(3.0, 3.5)), 2)
    plan = draft.build_plan(height, round(height - 0.5, 2))
    equal = replace(EQUAL, lintels=float(difficulty.lintels > 0.5), open=difficulty.open, half=difficulty.half)
    building = build_building([plan], equal, rng, name, "modules", {"layout": module.layout, "modules": count})
    building = replace(building, seed=seed)
    modules = np.array(owner)
    for k in range(1, count):
        building = copy_furniture(
            building, find_module_rooms(modules, 0), find_module_rooms(modules, k), np.array([k * module.width, 0.0]), leaves=True
        )
    return ModuleRow(building, module.width, count, modules, module.both)


def find_module_rooms(module: Array, k: int) -> Array:
    """Find rooms of module k, in the order in which they were drawn."""
    return np.flatnonzero(module == k)


def _add_bay(draft: Draft, module: ModulePlan, k: int, count: int) -> int:
    """Add a bay of the corridor: it touches the next one, without a wall between them."""
    low = k * module.width - (module.ends[0] if k == 0 else 0.0)
    high = (k + 1) * module.width + (module.ends[1] if k == count - 1 else 0.0)
    inset = draft.wall / 2
    inner = (low + inset * (k == 0), inset, high - inset * (k == count - 1), module.corridor - inset)
    draft.outlines.append(shapely.box(low, 0.0, high, module.corridor))
    corners = np.asarray(shapely.box(*inner, ccw=True).exterior.coords)[:-1]
    draft.rooms.append(PlanRoom(f"corridor {len(draft.rooms)}", np.round(corners, 3), "corridor"))
    return len(draft.rooms) - 1


def _add_rooms(draft: Draft, module: ModulePlan, start: float, bay: int, side: int) -> None:
    """Add the rooms of a bay on one side (1: above the corridor), with their doors."""
    wide, deep, cut = module.width, module.depth, round(module.split * module.width, 2)
    flip = side < 0 and module.turned

    def box(x0: float, y0: float, x1: float, y1: float) -> shapely.Polygon:
        if flip:
            x0, x1 = wide - x1, wide - x0
        y0, y1 = (module.corridor + y0, module.corridor + y1) if side > 0 else (-y1, -y0)
        return shapely.box(round(start + x0, 3), round(y0, 3), round(start + x1, 3), round(y1, 3))

    def door(a: int, b: int, width: float, kind: str = "door") -> None:
        line = shapely.normalize(shapely.line_merge(draft.outlines[a].intersection(draft.outlines[b])))
        draft.cut(line, width, kind, 1 - module.doors if flip else module.doors)

    first, second = module.kinds
    if module.layout == "room":
        door(draft.add_room(box(0, 0, wide, deep), first), bay, 0.95)
    elif module.layout == "ensuite":
        bath = draft.add_room(box(0, 0, 1.8, 2.2), "bath")
        room = draft.add_room(box(0, 0, wide, deep).difference(draft.outlines[bath]), first)
        door(room, bay, 0.95)
        door(bath, room, 0.75)
    elif module.layout == "pair":
        for low, high, kind in ((0.0, cut, first), (cut, wide, second)):
            door(draft.add_room(box(low, 0, high, deep), kind), bay, 0.95)
    else:
        alcove = draft.add_room(box(cut, 0, wide, module.alcove), "lounge")
        door(alcove, bay, round(wide - cut - 0.6, 2), "opening")
        door(draft.add_room(box(0, 0, cut, deep), first), bay, 0.95)
        door(draft.add_room(box(cut, module.alcove, wide, deep), second), alcove, 0.85)
