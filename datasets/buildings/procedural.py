"""Procedural buildings: plans of a kind from a seed, erected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.buildings.drafting import Draft, round_point
from topomerge.datasets.buildings.layouts import (
    BUILDING_KINDS,
    CORE_WIDTHS,
    DARK,
    INNER,
    PROFILES,
    SHAPES,
    Core,
    Layout,
    Profile,
    Range,
    RoomDeck,
    Row,
    Size,
    draw,
    fill_row,
    make_layout,
)
from topomerge.datasets.buildings.stairs import compute_flight_length, compute_flight_width
from topomerge.datasets.core.building import Building, Difficulty, Flight, Plan
from topomerge.datasets.plans.sealed import refuse_building

from topomerge.errors import InputError

FOOT_OF_FLIGHT = 1.35  # m before a flight


def add_cores(
    layout: Layout, profile: Profile, storeys: int, height: float, wall: float, difficulty: Difficulty, rng: np.random.Generator
) -> None:
    """Give stairs, lifts, halls and the like their places in the rows, the longest rows first."""
    requested = []
    if storeys > 1:
        total = sum(r.length for r in layout.rows)
        number = 1 if total < 45 else 2
        drawn = [str(rng.choice(profile.stairs)) for _ in range(number)]
        requested += [("stairs", "dogleg" if i and kind == "ramp" else kind) for i, kind in enumerate(drawn)]
        requested += [("lift", "lift")] if profile.lift and (storeys > 2 or rng.random() < 0.5) else []
        requested += [("atrium", "")] if profile.lift and rng.random() < difficulty.atria else []
    requested += [(kind, "") for kind in profile.cores]
    for kind, flight in requested:
        width, depth = _sample_core_size(kind, flight, height, wall, rng)
        for i in sorted(range(len(layout.rows)), key=lambda i: -_measure_longest_gap(layout.rows[i]) * rng.uniform(0.6, 1.0)):
            row = layout.rows[i]
            a, b = max(row.list_gaps(), key=lambda g: g[1] - g[0], default=(0.0, 0.0))
            if b - a < width + 0.1:
                continue
            spare = b - a - width
            start = a + (0.0 if spare < 4 else float(rng.choice([0.0, spare, max(3.0, min(spare - 3, spare * rng.random()))])))
            core = Core(kind, start, width, depth or float(min(row.ends)), flight)
            if any(
                o.intersection(row.build_outline(start, start + width, core.depth)).area > 1e-3 for o in layout.list_obstacles(i)
            ):
                continue
            layout.rows[i] = replace(row, cores=tuple(sorted([*row.cores, core], key=lambda c: c.start)))
            break


def _measure_longest_gap(row: Row) -> float:
    return max((b - a for a, b in row.list_gaps()), default=0.0)


def _sample_core_size(kind: str, flight: str, height: float, wall: float, rng: np.random.Generator) -> Range:
    """Sample the width along the row and depth, m; depth 0: that of the row."""
    if kind == "stairs":
        behind = FOOT_OF_FLIGHT if flight == "straight" else 0.02
        lane = FOOT_OF_FLIGHT if flight == "straight" else 0.05  # beside the flight, to walk back on
        return compute_flight_width(flight, height) + lane + wall, FOOT_OF_FLIGHT + compute_flight_length(
            flight, height
        ) + behind + wall
    width = round(float(rng.uniform(*CORE_WIDTHS[kind])), 2)
    return width, {"lift": 2.4, "hall": round(float(rng.uniform(12, 18)), 2), "atrium": 9.0}.get(kind, 0.0)


def draw_core(draft: Draft, row: Row, core: Core, corridor: int, k: int, storeys: int, height: float) -> list[tuple[int, int]]:
    """Draw a core on storey k."""
    end = core.start + core.width
    outline = row.build_outline(core.start, end, core.depth)
    front = shapely.LineString(
        np.round(row.transform_points([[core.start, 0], [end, 0]]), 3)
    )  # stairs must be entered at their foot
    tall = core.kind in ("atrium", "hall")
    if tall and k == 1:
        draft.add_room(outline, "void", height - 0.4)
        draft.cut(front, core.width - 1.0, "gallery", 0.5, bottom=1.0, top=2.3)
        return []
    kind = core.kind if not tall or k == 0 else "openplan"
    ceiling = (2 * height - 0.4 if storeys > 1 else 4.8) if tall and k == 0 else 0.0
    room = draft.add_room(outline, kind, ceiling)
    width = {"lift": 1.0, "hall": 1.6, "atrium": 2.4, "stairs": 1.0, "nurses": 2.4}.get(kind, 0.9)
    opening = "opening" if kind in ("atrium", "nurses") else "door"
    draft.cut(
        front,
        width,
        opening,
        0.3 if kind == "hall" else 0.5,
        state="shut" if kind == "lift" else "",
        top=_get_lintel_height(kind),
    )
    if kind == "hall":
        draft.cut(front, width, opening, 0.8)
    if core.flight and k + 1 < storeys:
        draft.flights.append(_build_flight(row, core, draft.wall, height))
    return [(room, corridor)] if kind not in ("stairs", "lift") else []


def _get_lintel_height(kind: str) -> float:
    """Return the height of the lintel that a core's door always has; 0: drawn."""
    return 2.1 if kind in ("lift", "stairs", "hall") else 0.0


def _build_flight(row: Row, core: Core, wall: float, height: float) -> Flight:
    edge = wall / 2 + 0.02
    front = 0.6 if core.flight == "lift" else FOOT_OF_FLIGHT + wall / 2
    corner = round_point(row.transform_points([[core.start + edge, front]])[0])
    length = 1.0 if core.flight == "lift" else compute_flight_length(core.flight, height)
    return Flight(core.flight, corner, row.heading + np.pi / 2, compute_flight_width(core.flight, height), length)


BUILDINGS_TRIED = 20


def make_building(
    kind: str, seed: int, storeys: int = 1, difficulty: Difficulty | None = None, shape: str = "", stairs: str = ""
) -> Building:
    """Make a building of a kind; the same arguments give the same bytes.

    Args:
        kind: one of `BUILDING_KINDS`.
        storeys: 1 to 8.
        shape: of the corridors, one of `layouts.SHAPES`; empty: drawn from what is usual for the kind.
        stairs: straight, dogleg, spiral or ramp; empty: drawn.

    Raises:
        InputError: an unknown kind, shape or kind of stairs, a number of storeys out of range, or a sealed seed.
    """
    refuse_building("procedural", str(seed))
    difficulty = difficulty or Difficulty()
    if kind not in PROFILES:
        raise InputError(f"building kind {kind!r}: {', '.join(BUILDING_KINDS)} are possible")
    if not 1 <= storeys <= 8:
        raise InputError(f"storeys must be 1 to 8, not {storeys}")
    if shape and shape not in SHAPES:
        raise InputError(f"shape {shape!r}: {', '.join(SHAPES)} are possible")
    profile = PROFILES[kind]
    profile = replace(profile, shapes=(shape,) if shape else profile.shapes, stairs=(stairs,) if stairs else profile.stairs)
    rng = np.random.default_rng([seed, BUILDING_KINDS.index(kind), storeys])
    name = f"{kind}-{seed}-{storeys}"
    parameters = {"kind": kind, "seed": seed, "storeys": storeys, "shape": shape, "stairs": stairs}
    for _ in range(BUILDINGS_TRIED):
        plans = make_plans(profile, storeys, difficulty, rng)
        building = build_building(plans, difficulty, rng, name, kind, parameters)
        if is_connected(building):
            return replace(building, seed=seed)
    raise InputError(f"{name}: no plan found in which every room can be reached; another seed will do")


def is_connected(building: Building) -> bool:
    """Return whether every room but the lifts can be reached on foot from every other one."""
    parts = building.find_components()
    walked = [p for p, room in zip(parts, building.rooms, strict=True) if room.kind != "lift"]
    return len(set(walked)) == 1


def make_plans(profile: Profile, storeys: int, difficulty: Difficulty, rng: np.random.Generator) -> list[Plan]:
    """Make plans of all storeys, lowest first."""
    curved = bool(rng.random() < difficulty.curved)
    near, far = np.round(rng.uniform(*profile.depth, 2), 2).tolist()
    size = Size(float(rng.uniform(*profile.length)), near, far, round(float(rng.uniform(*profile.corridor)), 2), curved)
    layout = make_layout(str(rng.choice(profile.shapes)), size, rng)
    height = round(float(rng.uniform(*profile.height)), 2)
    wall, merge = round(float(rng.uniform(0.1, 0.22)), 2), bool(rng.random() < 0.5)
    add_cores(layout, profile, storeys, height, wall, difficulty, rng)
    gap = float(rng.uniform(0.25, 0.6)) if profile.height[0] < 3.1 else float(rng.uniform(0.45, 0.8))
    seeds = rng.integers(2**31, size=storeys)
    for k in range(1, storeys):
        if rng.random() >= difficulty.differ and not (k == 1 and profile.upper):
            seeds[k] = seeds[k - 1]
    style = rng.integers(2**31)
    return [
        _draw_storey(
            layout, profile, k, storeys, (height, round(height - gap, 2), wall, merge), difficulty, (int(seeds[k]), int(style))
        )
        for k in range(storeys)
    ]


def _draw_storey(
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
    deck = RoomDeck(
        profile.upper if k and profile.upper else profile.rooms, seeds[1] if profile.same else None, rng, difficulty.spread
    )
    inner = RoomDeck(INNER, None, rng)
    for row in layout.rows:
        for core in row.cores:
            fronts += draw_core(draft, row, core, corridors[row.corridor], k, storeys, height)
        for a, b in row.list_gaps():
            cards = inner if row.inner else deck
            rooms = fill_row(draft, row, (a, b), cards, corridors[row.corridor], rng, difficulty.closets)
            fronts += rooms
            if row.behind >= 0:
                _add_second_doors(draft, [r for r, _ in rooms], corridors[row.behind])
    if k == 0:
        draft.add_entrance(corridors[0], 1.5) or draft.add_entrance(corridors[0], 1.0)
    for room, corridor in fronts:
        kind = draft.rooms[room].kind
        if kind not in DARK and kind not in ("ward", "hotel", "flat", "stairs") and rng.random() < difficulty.glass:
            draft.glaze(room, corridor)
    _add_windows(draft, np.random.default_rng(seeds[1]))
    return draft.build_plan(height, ceiling)


def _add_second_doors(draft: Draft, rooms: list[int], corridor: int) -> None:
    """Add second doors, for rooms that lie between two corridors."""
    for room in rooms:
        if draft.rooms[room].kind == "lounge":
            draft.add_door(room, corridor, 2.4, "opening")
        elif draft.rooms[room].kind == "meeting":
            draft.add_door(room, corridor, 0.9)


def _add_windows(draft: Draft, rng: np.random.Generator) -> None:
    sill, width = float(rng.choice([0.6, 0.9, 0.9, 1.0])), float(rng.uniform(1.2, 2.2))
    every = width + float(rng.uniform(0.5, 1.4))
    for i, room in enumerate(draft.rooms):
        if room.kind not in DARK:
            draft.add_windows(i, width, sill, every)
        elif room.kind == "corridor":
            draft.add_windows(i, 1.2, 0.9, 4.0)
