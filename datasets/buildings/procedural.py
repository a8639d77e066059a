"""Procedural buildings: plans of a kind from a seed, erected.

A building is a layout of corridors (`layouts`) whose rows of rooms are cut up by the kind's deck of rooms. Corridors, stairs,
lifts, halls and atria go through all storeys; the rest repeats or differs from storey to storey.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from topomerge.datasets.buildings.drafting import Draft, point
from topomerge.datasets.buildings.erect import erect
from topomerge.datasets.buildings.layouts import SHAPES, Core, Layout, Row, Size, draw, make_layout
from topomerge.datasets.buildings.profiles import DARK, INNER, KINDS, PROFILES, WIDTHS, Deck, Profile, Range
from topomerge.datasets.buildings.stairs import length_for, width_for
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.core.plan import Flight, Plan

from topomerge.errors import InputError

LANDING = 1.35  # m before a flight
TRIES = 20
CLOSETED = ("office", "meeting", "openplan", "classroom", "lab", "library", "living", "kitchen", "bedroom")


def make_building(
    kind: str, seed: int, storeys: int = 1, difficulty: Difficulty | None = None, shape: str = "", stairs: str = ""
) -> Building:
    """A building of a kind; the same arguments give the same bytes.

    Args:
        kind: one of `KINDS`.
        storeys: 1 to 8.
        shape: of the corridors, one of `layouts.SHAPES`; empty: drawn from what is usual for the kind.
        stairs: straight, dogleg, spiral or ramp; empty: drawn.

    Raises:
        InputError: an unknown kind, shape or kind of stairs, or a number of storeys out of range.
    """
    difficulty = difficulty or Difficulty()
    if kind not in PROFILES:
        raise InputError(f"building kind {kind!r}: {', '.join(KINDS)} are possible")
    if not 1 <= storeys <= 8:
        raise InputError(f"storeys must be 1 to 8, not {storeys}")
    if shape and shape not in SHAPES:
        raise InputError(f"shape {shape!r}: {', '.join(SHAPES)} are possible")
    profile = PROFILES[kind]
    profile = replace(profile, shapes=(shape,) if shape else profile.shapes, stairs=(stairs,) if stairs else profile.stairs)
    rng = np.random.default_rng([seed, KINDS.index(kind), storeys])
    name = f"{kind}-{seed}-{storeys}"
    known = {"kind": kind, "seed": seed, "storeys": storeys, "shape": shape, "stairs": stairs}
    for _ in range(TRIES):
        plans = make_plans(profile, storeys, difficulty, rng)
        building = erect(plans, difficulty, rng, name, kind, known)
        if connected(building):
            return replace(building, seed=seed)
    raise InputError(f"{name}: no plan found in which every room can be reached; another seed will do")


def connected(building: Building) -> bool:
    """Can every room but the lifts be reached on foot from every other one?"""
    parts = building.parts()
    walked = [p for p, room in zip(parts, building.rooms, strict=True) if room.kind != "lift"]
    return len(set(walked)) == 1


def make_plans(profile: Profile, storeys: int, difficulty: Difficulty, rng: np.random.Generator) -> list[Plan]:
    """Plans of all storeys, lowest first."""
    curved = bool(rng.random() < difficulty.curved)
    near, far = np.round(rng.uniform(*profile.depth, 2), 2).tolist()
    size = Size(float(rng.uniform(*profile.length)), near, far, round(float(rng.uniform(*profile.corridor)), 2), curved)
    layout = make_layout(str(rng.choice(profile.shapes)), size, rng)
    height = round(float(rng.uniform(*profile.height)), 2)
    wall, merge = round(float(rng.uniform(0.1, 0.22)), 2), bool(rng.random() < 0.5)
    _add_cores(layout, profile, storeys, height, wall, difficulty, rng)
    gap = float(rng.uniform(0.25, 0.6)) if profile.height[0] < 3.1 else float(rng.uniform(0.45, 0.8))
    seeds = rng.integers(2**31, size=storeys)
    for k in range(1, storeys):
        if rng.random() >= difficulty.differ and not (k == 1 and profile.upper):
            seeds[k] = seeds[k - 1]
    style = rng.integers(2**31)
    return [
        _storey(
            layout, profile, k, storeys, (height, round(height - gap, 2), wall, merge), difficulty, (int(seeds[k]), int(style))
        )
        for k in range(storeys)
    ]


def _add_cores(
    layout: Layout, profile: Profile, storeys: int, height: float, wall: float, difficulty: Difficulty, rng: np.random.Generator
) -> None:
    """Give stairs, lifts, halls and the like their places in the rows, the longest rows first."""
    wanted = []
    if storeys > 1:
        total = sum(r.length for r in layout.rows)
        number = 1 if total < 45 else 2
        drawn = [str(rng.choice(profile.stairs)) for _ in range(number)]
        wanted += [("stairs", "dogleg" if i and kind == "ramp" else kind) for i, kind in enumerate(drawn)]
        wanted += [("lift", "lift")] if profile.lift and (storeys > 2 or rng.random() < 0.5) else []
        wanted += [("atrium", "")] if profile.lift and rng.random() < difficulty.atria else []
    wanted += [(kind, "") for kind in profile.cores]
    for kind, flight in wanted:
        width, depth = _core_size(kind, flight, height, wall, rng)
        for i in sorted(range(len(layout.rows)), key=lambda i: -_longest(layout.rows[i]) * rng.uniform(0.6, 1.0)):
            row = layout.rows[i]
            a, b = max(row.gaps(), key=lambda g: g[1] - g[0], default=(0.0, 0.0))
            if b - a < width + 0.1:
                continue
            spare = b - a - width
            start = a + (0.0 if spare < 4 else float(rng.choice([0.0, spare, max(3.0, min(spare - 3, spare * rng.random()))])))
            core = Core(kind, start, width, depth or float(min(row.ends)), flight)
            if any(o.intersection(row.outline(start, start + width, core.depth)).area > 1e-3 for o in layout.taken(i)):
                continue
            layout.rows[i] = replace(row, cores=tuple(sorted([*row.cores, core], key=lambda c: c.start)))
            break


def _longest(row: Row) -> float:
    return max((b - a for a, b in row.gaps()), default=0.0)


def _core_size(kind: str, flight: str, height: float, wall: float, rng: np.random.Generator) -> Range:
    """Width along the row and depth, m; depth 0: that of the row."""
    if kind == "stairs":
        behind = LANDING if flight == "straight" else 0.02
        lane = LANDING if flight == "straight" else 0.05  # beside the flight, to walk back on
        return width_for(flight, height) + lane + wall, LANDING + length_for(flight, height) + behind + wall
    width = round(float(rng.uniform(*WIDTHS[kind])), 2)
    return width, {"lift": 2.4, "hall": round(float(rng.uniform(12, 18)), 2), "atrium": 9.0}.get(kind, 0.0)


def _storey(
    layout: Layout,
    profile: Profile,
    k: int,
    storeys: int,
    size: tuple[float, float, float, bool],
    difficulty: Difficulty,
    seeds: tuple[int, int],
) -> Plan:
    """Draw one storey."""
    height, ceiling, wall, merge = size
    rng = np.random.default_rng(seeds[0])
    draft = Draft(wall, rng, round(float(np.random.default_rng(seeds[1]).uniform(0.94, 1.08)), 3))
    corridors = draw(layout, draft, "corridor", merge)
    fronts: list[tuple[int, int]] = []  # rooms and their corridors
    deck = Deck(
        profile.upper if k and profile.upper else profile.rooms, seeds[1] if profile.same else None, rng, difficulty.spread
    )
    inner = Deck(INNER, None, rng)
    for row in layout.rows:
        for core in row.cores:
            fronts += _core(draft, row, core, corridors[row.corridor], k, storeys, height)
        for a, b in row.gaps():
            cards = inner if row.inner else deck
            rooms = _fill(draft, row, (a, b), cards, corridors[row.corridor], rng, difficulty.closets)
            fronts += rooms
            if row.behind >= 0:
                _through(draft, [r for r, _ in rooms], corridors[row.behind])
    if k == 0:
        draft.entrance(corridors[0], 1.5) or draft.entrance(corridors[0], 1.0)
    for room, corridor in fronts:
        kind = draft.rooms[room].kind
        if kind not in DARK and kind not in ("ward", "hotel", "flat", "stairs") and rng.random() < difficulty.glass:
            draft.glaze(room, corridor)
    _windows(draft, np.random.default_rng(seeds[1]))
    return draft.plan(height, ceiling)


def _through(draft: Draft, rooms: list[int], corridor: int) -> None:
    """Second doors, for rooms that lie between two corridors."""
    for room in rooms:
        if draft.rooms[room].kind == "lounge":
            draft.door(room, corridor, 2.4, "opening")
        elif draft.rooms[room].kind == "meeting":
            draft.door(room, corridor, 0.9)


def _windows(draft: Draft, rng: np.random.Generator) -> None:
    sill, width = float(rng.choice([0.6, 0.9, 0.9, 1.0])), float(rng.uniform(1.2, 2.2))
    every = width + float(rng.uniform(0.5, 1.4))
    for i, room in enumerate(draft.rooms):
        if room.kind not in DARK:
            draft.windows(i, width, sill, every)
        elif room.kind == "corridor":
            draft.windows(i, 1.2, 0.9, 4.0)


def _core(draft: Draft, row: Row, core: Core, corridor: int, k: int, storeys: int, height: float) -> list[tuple[int, int]]:
    """Draw a core on storey k."""
    end = core.start + core.width
    outline = row.outline(core.start, end, core.depth)
    front = shapely.LineString(np.round(row.place([[core.start, 0], [end, 0]]), 3))  # stairs must be entered at their foot
    tall = core.kind in ("atrium", "hall")
    if tall and k == 1:
        draft.room(outline, "void", height - 0.4)
        draft.cut(front, core.width - 1.0, "gallery", 0.5, bottom=1.0, top=2.3)
        return []
    kind = core.kind if not tall or k == 0 else "openplan"
    ceiling = (2 * height - 0.4 if storeys > 1 else 4.8) if tall and k == 0 else 0.0
    room = draft.room(outline, kind, ceiling)
    width = {"lift": 1.0, "hall": 1.6, "atrium": 2.4, "stairs": 1.0, "nurses": 2.4}.get(kind, 0.9)
    opening = "opening" if kind in ("atrium", "nurses") else "door"
    draft.cut(front, width, opening, 0.3 if kind == "hall" else 0.5, state="shut" if kind == "lift" else "", top=_top(kind))
    if kind == "hall":
        draft.cut(front, width, opening, 0.8)
    if core.flight and k + 1 < storeys:
        draft.flights.append(_flight(row, core, draft.wall, height))
    return [(room, corridor)] if kind not in ("stairs", "lift") else []


def _top(kind: str) -> float:
    """Height of the lintel that a core's door always has; 0: drawn."""
    return 2.1 if kind in ("lift", "stairs", "hall") else 0.0


def _flight(row: Row, core: Core, wall: float, height: float) -> Flight:
    edge = wall / 2 + 0.02
    front = 0.6 if core.flight == "lift" else LANDING + wall / 2
    corner = point(row.place([[core.start + edge, front]])[0])
    length = 1.0 if core.flight == "lift" else length_for(core.flight, height)
    return Flight(core.flight, corner, row.heading + np.pi / 2, width_for(core.flight, height), length)


def _fill(
    draft: Draft,
    row: Row,
    gap: Range,
    deck: Deck,
    corridor: int,
    rng: np.random.Generator,
    closets: float,
) -> list[tuple[int, int]]:
    """Cut a stretch of a row into rooms, each with a door to the corridor."""
    kinds: list[str] = []
    drawn: list[Any] = []
    length = gap[1] - gap[0]
    while sum(drawn) < length:
        kind, width = deck.draw(length)
        if drawn and sum(drawn) + width / 2 > length:  # better stretch the others than squeeze this one in
            break
        kinds.append(kind)
        drawn.append(width)
    ends = np.cumsum(drawn)
    cuts = np.round(gap[0] + np.concatenate([[0.0], ends]) * length / ends[-1], 2)
    cuts[-1] = gap[1]
    out = []
    for kind, a, b in zip(kinds, cuts[:-1], cuts[1:], strict=False):
        out += _row_room(draft, row, (float(a), float(b)), kind, corridor, rng, closets)
    rooms = [r for r, _ in out]
    for left, right in pairwise(rooms):
        if {draft.rooms[left].kind, draft.rooms[right].kind} <= {
            "office",
            "meeting",
            "lab",
            "living",
            "kitchen",
        } and rng.random() < 0.12:
            draft.door(left, right, 0.85)
    return out


def _row_room(
    draft: Draft, row: Row, span: Range, kind: str, corridor: int, rng: np.random.Generator, closets: float
) -> list[tuple[int, int]]:
    """One room of a row; hotel rooms and wards have their own bath, flats are several rooms."""
    a, b = span
    outline = row.outline(a, b)
    if b - a < 1.4:
        kind = "storage"
    if kind == "flat" and b - a > 6.0:
        return _flat(draft, row, span, corridor, rng)
    if kind in ("hotel", "ward") and b - a > 3.2:
        return _ensuite(draft, row, span, kind, corridor)
    kind = {"flat": "storage"}.get(kind, kind)
    closet = _closet(draft, row, span, rng) if kind in CLOSETED and rng.random() < closets and b - a > 3.6 else None
    room = draft.room(outline if closet is None else outline.difference(draft.outlines[closet]), kind)
    if closet is not None:
        draft.door(closet, room if rng.random() < 0.5 else corridor, 0.75)
    usual = float(rng.choice([0.8, 0.85, 0.9, 0.9, 1.0, 1.0, 1.25 if kind != "storage" else 0.9]))
    usual = float(rng.choice([1.0, 1.5])) if kind == "meeting" else usual
    wide = {"classroom": 1.0, "ward": 1.2, "lab": 1.2, "openplan": 1.6, "living": 1.2}.get(kind, usual)
    opening = "opening" if kind in ("openplan", "living") and rng.random() < 0.5 else "door"
    if kind == "lounge":
        wide, opening = 2.4, "opening"
    draft.door(room, corridor, min(wide, b - a - 0.6), opening)
    if b - a > 8.5:
        draft.door(room, corridor, min(wide, 1.0))
    return [(room, corridor)]


def _closet(draft: Draft, row: Row, span: Range, rng: np.random.Generator) -> int:
    """A closet in the corner of a room, beside the corridor."""
    a, b = span
    wide, deep = np.round(rng.uniform(1.6, min(2.4, (b - a) / 2.1)), 2), np.round(rng.uniform(1.75, 2.8), 2)
    start = a if rng.random() < 0.5 else b - wide
    return draft.room(row.outline(start, start + wide, min(deep, row.depth(a) * 0.6)), "storage")


def _ensuite(draft: Draft, row: Row, span: Range, kind: str, corridor: int) -> list[tuple[int, int]]:
    """A bath beside the entrance; every second room is mirrored, so that baths lie back to back."""
    a, b = span
    mirrored = len(draft.rooms) % 4 >= 2
    wide, deep = min(2.0, b - a - 1.8), 2.2
    box = row.outline(b - wide, b, deep) if mirrored else row.outline(a, a + wide, deep)
    bath = draft.room(box, "bath")
    room = draft.room(row.outline(a, b).difference(box), kind)
    draft.door(room, corridor, 0.95 if kind == "hotel" else 1.2, at=0.5)
    draft.door(bath, room, 0.75)
    return [(room, corridor)]


def _flat(draft: Draft, row: Row, span: Range, corridor: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """A flat: a hall from the corridor; bath, kitchen and bedrooms beside it, the living room at its end."""
    a, b = span
    depth = min(row.ends)
    mirrored = bool(rng.random() < 0.5)

    def box(x0: float, y0: float, x1: float, y1: float) -> shapely.Polygon:
        u, v = (b - x1, b - x0) if mirrored else (a + x0, a + x1)
        return shapely.Polygon(np.round(row.place([[u, y0], [v, y0], [v, y1], [u, y1]]), 3))

    width, side, hall = b - a, round(float(rng.uniform(2.7, 3.4)), 2), 1.4
    bath, kitchen, back = 2.3, round(float(rng.uniform(2.6, 3.0)), 2), round(depth * float(rng.uniform(0.52, 0.6)), 2)
    entry = draft.room(box(side, 0, side + hall, back), "corridor")
    rooms = [
        draft.room(box(0, 0, side, bath), "bath"),
        draft.room(box(0, bath, side, depth), "bedroom"),
        draft.room(box(side, back, width, depth), "living"),
    ]
    right = (side + hall, width)
    if back - kitchen > 2.2 and right[1] - right[0] > 2.4:
        rooms.append(draft.room(box(right[0], 0, right[1], kitchen), "kitchen"))
        rooms.append(draft.room(box(right[0], kitchen, right[1], back), "bedroom"))
    else:
        rooms.append(draft.room(box(right[0], 0, right[1], back), "kitchen"))
    draft.door(entry, corridor, 0.9, state="", at=0.5)
    for room in rooms:
        wide = 0.75 if draft.rooms[room].kind == "bath" else 0.85
        if not draft.door(entry, room, wide):
            draft.door(rooms[2], room, wide)
    return []
