"""What goes through all storeys of a procedural building beside its corridors: stairs, lifts, halls, atria, toilets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
from topomerge.datasets.buildings.drafting import Draft, point
from topomerge.datasets.buildings.layouts import Core, Layout, Row
from topomerge.datasets.buildings.profiles import CORE_WIDTHS, Profile, Range
from topomerge.datasets.buildings.stairs import length_for, width_for
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.core.plan import Flight

FOOT_OF_FLIGHT = 1.35  # m before a flight


def add_cores(
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
        behind = FOOT_OF_FLIGHT if flight == "straight" else 0.02
        lane = FOOT_OF_FLIGHT if flight == "straight" else 0.05  # beside the flight, to walk back on
        return width_for(flight, height) + lane + wall, FOOT_OF_FLIGHT + length_for(flight, height) + behind + wall
    width = round(float(rng.uniform(*CORE_WIDTHS[kind])), 2)
    return width, {"lift": 2.4, "hall": round(float(rng.uniform(12, 18)), 2), "atrium": 9.0}.get(kind, 0.0)


def draw_core(draft: Draft, row: Row, core: Core, corridor: int, k: int, storeys: int, height: float) -> list[tuple[int, int]]:
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
    front = 0.6 if core.flight == "lift" else FOOT_OF_FLIGHT + wall / 2
    corner = point(row.place([[core.start + edge, front]])[0])
    length = 1.0 if core.flight == "lift" else length_for(core.flight, height)
    return Flight(core.flight, corner, row.heading + np.pi / 2, width_for(core.flight, height), length)
