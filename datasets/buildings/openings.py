"""Openings of a storey's walls: which rooms they join, how high they are, and how their doors stand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from topomerge.datasets.buildings.spaces import Space, footprint
from topomerge.datasets.core.building import DOOR_DTYPE
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.core.plan import Opening, Plan
from topomerge.datasets.core.solids import rectangle

from topomerge.types import Array

OPENING_REACH = 0.6  # m beyond its wall that an opening looks for the room it leads to
DOOR_TOPS = (2.0, 2.05, 2.1, 2.2)  # m


@dataclass(frozen=True, eq=False)
class Hole:
    """An opening with the spaces on its two sides (-1: outside) and its box of free space."""

    opening: Opening
    storey: int
    sides: tuple[int, int]
    box: shapely.Polygon
    bottom: float
    top: float
    lintel: bool


def storey_holes(plan: Plan, k: int, spaces: list[Space], difficulty: Difficulty, rng: np.random.Generator) -> list[Hole]:
    """The openings of a storey that lead from a room to another one or outside; the others are left out."""
    here = [i for i, s in enumerate(spaces) if s.storey == k]
    shapes = [spaces[i].shape for i in here]
    openings = [o for o in plan.openings if o.kind != "window" or rng.random() < difficulty.windows] + _glazing(plan)
    if not openings:
        return []
    door_top = float(rng.choice(DOOR_TOPS))
    start, end = (np.array([getattr(o, w) for o in openings], float) for w in ("start", "end"))
    along = (end - start) / np.maximum(np.hypot(*(end - start).T), 1e-9)[:, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    steps = np.arange(0.02, OPENING_REACH + 0.5, 0.04)
    probes = (start + end)[:, None, None] / 2 + normal[:, None, None] * np.stack([-steps, steps])[None, ..., None]
    which = _which(probes, shapes, here)
    limit = np.array([o.thickness / 2 + OPENING_REACH for o in openings])
    out = []
    for o, opening in enumerate(openings):
        hits = [_first(which[o, s], steps, limit[o]) for s in (0, 1)]
        sides, depths = tuple(h[0] for h in hits), [h[1] for h in hits]
        if max(sides) < 0 or min(sides) == -2 or sides[0] == sides[1]:
            continue
        near, far = -(depths[0] + 0.02) * normal[o], (depths[1] + 0.02) * normal[o]
        box = shapely.Polygon([start[o] + near, end[o] + near, end[o] + far, start[o] + far])
        lintel = bool(rng.random() < difficulty.lintels)
        out.append(_hole(opening, k, sides, box, spaces, door_top, lintel))  # type: ignore[arg-type]
    return [h for h in out if h.top > h.bottom + 0.1]


def _which(probes: Array, shapes: list[shapely.Polygon], here: list[int]) -> Array:
    """Space of each probe point; -1: outside of the building, -2: within a wall."""
    points = shapely.points(probes.reshape(-1, 2))
    out = np.full(len(points), -2)
    outside = ~shapely.contains(footprint(shapes), points)
    out[outside] = -1
    point, shape = shapely.STRtree(shapes).query(points, predicate="intersects")
    out[point] = np.asarray(here)[shape]
    return out.reshape(probes.shape[:-1])


def _first(which: Array, steps: Array, limit: float) -> tuple[int, float]:
    open_steps = np.flatnonzero((which != -2) & (steps <= limit))
    return (int(which[open_steps[0]]), float(steps[open_steps[0]])) if len(open_steps) else (-2, 0.0)


def _hole(
    opening: Opening, k: int, sides: tuple[int, int], box: shapely.Polygon, spaces: list[Space], door_top: float, lintel: bool
) -> Hole:
    inner = [spaces[s] for s in sides if s >= 0]
    floor = max(s.floor for s in inner)
    limit = min(s.ceiling - s.plan.slope for s in inner) - floor
    top = min(opening.top, limit)
    if not opening.top:
        outer = min(sides) < 0
        top = min(door_top, limit) if opening.kind == "door" and (lintel or outer) else limit
        top = min(2.3, limit - 0.2) if opening.kind == "window" else top
    return Hole(opening, k, sides, box, floor + opening.bottom, floor + top, bool(top < limit - 0.05))


def _glazing(plan: Plan) -> list[Opening]:
    """Glass walls as windows from the floor up, doors left out."""
    doors = shapely.union_all([rectangle(o.start, o.end, 0.6) for o in plan.openings if o.kind != "window"])
    out = []
    for wall in (w for w in plan.walls if w.glass):
        for piece in shapely.get_parts(shapely.LineString([wall.start, wall.end]).difference(doors.buffer(0.08))):
            ends = [(float(x), float(y)) for x, y in piece.coords]
            if piece.length > 0.3:
                out.append(Opening("window", ends[0], ends[-1], wall.thickness, 0.1, 20.0))
    return out


def true_doors(holes: list[Hole], spaces: list[Space], difficulty: Difficulty, rng: np.random.Generator) -> Array:
    """True doors and openings; windows and galleries are none."""
    rows = []
    for hole in holes:
        if hole.opening.kind not in ("door", "opening"):
            continue
        a, b = np.array(hole.opening.start), np.array(hole.opening.end)
        rooms = sorted((spaces[s].room if s >= 0 else -1 for s in hole.sides), reverse=True)
        direction = (np.arctan2(b[1] - a[1], b[0] - a[0]) + np.pi / 2) % np.pi
        sides = np.asarray(hole.box.exterior.coords)
        thickness = float(np.hypot(*(sides[2] - sides[1]))) - 0.04
        state = hole.opening.state or draw_state(difficulty, rng)
        state = "none" if hole.opening.kind == "opening" else "shut" if rooms[1] < 0 and not hole.opening.state else state
        centre = (*((a + b) / 2), hole.bottom)
        width = float(np.hypot(*(b - a)))
        rows.append((rooms[::-1], centre, width, hole.top - hole.bottom, direction, thickness, state, hole.lintel))
    return np.array([(tuple(r[0]), *r[1:]) for r in rows], DOOR_DTYPE)


def draw_state(difficulty: Difficulty, rng: np.random.Generator) -> str:
    """How a door stands."""
    u = rng.random()
    return "open" if u < difficulty.open else "half" if u < difficulty.open + difficulty.half else "shut"
