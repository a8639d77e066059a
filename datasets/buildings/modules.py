"""Rows of equal modules along a corridor: the buildings in which one place looks like the next.

A module is a bay of the corridor with the rooms beside it, on one side or on both. All have the same outlines, doors and windows,
so that the row, moved by a whole number of periods, lies on itself; only its two ends differ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely
from topomerge.datasets.buildings.drafting import Draft
from topomerge.datasets.buildings.erect import erect
from topomerge.datasets.buildings.refurnish import copied
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.core.plan import Opening, PlanRoom

from topomerge.types import Array

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
    """What a row is drawn from; lengths in metres.

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
    """A module of a layout, its sizes and kinds of rooms drawn."""
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
    """A row of modules, unfurnished (`refurnish` puts things into it); door leaves hang alike in all modules.

    Args:
        difficulty: its `lintels` (all or none), `open` and `half` are used.
    """
    rng = np.random.default_rng(seed)
    draft = Draft(round(float(rng.uniform(0.1, 0.2)), 2), rng)
    owner: list[int] = []
    bays = []
    for k in range(count):
        bays.append(_bay(draft, module, k, count))
        for side in (1, -1) if module.both else (1,):
            _rooms(draft, module, k * module.width, bays[-1], side)
        owner += [k] * (len(draft.rooms) - len(owner))
    for k in range(1, count):
        x, inset = k * module.width, draft.wall / 2
        draft.openings.append(Opening("opening", (x, inset), (x, module.corridor - inset), 0.1))
    for i, room in enumerate(draft.rooms):
        if room.kind not in ("bath", "storage"):
            draft.windows(i, 1.4, 0.9, 2.4)
    height = round(float(rng.uniform(3.0, 3.5)), 2)
    plan = draft.plan(height, round(height - 0.5, 2))
    equal = replace(EQUAL, lintels=float(difficulty.lintels > 0.5), open=difficulty.open, half=difficulty.half)
    building = erect([plan], equal, rng, name, "modules", {"layout": module.layout, "modules": count})
    building = replace(building, seed=seed)
    modules = np.array(owner)
    for k in range(1, count):
        building = copied(building, rooms_of(modules, 0), rooms_of(modules, k), np.array([k * module.width, 0.0]), leaves=True)
    return ModuleRow(building, module.width, count, modules, module.both)


def rooms_of(module: Array, k: int) -> Array:
    """Rooms of module k, in the order in which they were drawn."""
    return np.flatnonzero(module == k)


def _bay(draft: Draft, module: ModulePlan, k: int, count: int) -> int:
    """A bay of the corridor: it touches the next one, without a wall between them."""
    low = k * module.width - (module.ends[0] if k == 0 else 0.0)
    high = (k + 1) * module.width + (module.ends[1] if k == count - 1 else 0.0)
    inset = draft.wall / 2
    inner = (low + inset * (k == 0), inset, high - inset * (k == count - 1), module.corridor - inset)
    draft.outlines.append(shapely.box(low, 0.0, high, module.corridor))
    corners = np.asarray(shapely.box(*inner, ccw=True).exterior.coords)[:-1]
    draft.rooms.append(PlanRoom(f"corridor {len(draft.rooms)}", np.round(corners, 3), "corridor"))
    return len(draft.rooms) - 1


def _rooms(draft: Draft, module: ModulePlan, start: float, bay: int, side: int) -> None:
    """The rooms of a bay on one side (1: above the corridor), with their doors."""
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
        door(draft.room(box(0, 0, wide, deep), first), bay, 0.95)
    elif module.layout == "ensuite":
        bath = draft.room(box(0, 0, 1.8, 2.2), "bath")
        room = draft.room(box(0, 0, wide, deep).difference(draft.outlines[bath]), first)
        door(room, bay, 0.95)
        door(bath, room, 0.75)
    elif module.layout == "pair":
        for low, high, kind in ((0.0, cut, first), (cut, wide, second)):
            door(draft.room(box(low, 0, high, deep), kind), bay, 0.95)
    else:
        alcove = draft.room(box(cut, 0, wide, module.alcove), "lounge")
        door(alcove, bay, round(wide - cut - 0.6, 2), "opening")
        door(draft.room(box(0, 0, cut, deep), first), bay, 0.95)
        door(draft.room(box(cut, module.alcove, wide, deep), second), alcove, 0.85)
