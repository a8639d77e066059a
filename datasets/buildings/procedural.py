"""Procedural buildings: plans of a kind from a seed, erected.

A building is a layout of corridors (`layouts`) whose rows of rooms are cut up by the kind's deck of rooms. Corridors, stairs,
lifts, halls and atria go through all storeys; the rest repeats or differs from storey to storey.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from topomerge.datasets.buildings.cores import add_cores, draw_core
from topomerge.datasets.buildings.drafting import Draft
from topomerge.datasets.buildings.erect import erect
from topomerge.datasets.buildings.layouts import SHAPES, Layout, Size, draw, make_layout
from topomerge.datasets.buildings.profiles import BUILDING_KINDS, DARK, INNER, PROFILES, Deck, Profile
from topomerge.datasets.buildings.row_rooms import fill_row
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.core.plan import Plan
from topomerge.datasets.plans.sealed import refuse_building

from topomerge.errors import InputError

BUILDINGS_TRIED = 20


def make_building(
    kind: str, seed: int, storeys: int = 1, difficulty: Difficulty | None = None, shape: str = "", stairs: str = ""
) -> Building:
    """A building of a kind; the same arguments give the same bytes.

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
        building = erect(plans, difficulty, rng, name, kind, parameters)
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
    add_cores(layout, profile, storeys, height, wall, difficulty, rng)
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
            fronts += draw_core(draft, row, core, corridors[row.corridor], k, storeys, height)
        for a, b in row.gaps():
            cards = inner if row.inner else deck
            rooms = fill_row(draft, row, (a, b), cards, corridors[row.corridor], rng, difficulty.closets)
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
