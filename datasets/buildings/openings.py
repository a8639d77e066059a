"""Openings and recesses of walls, windows, and the free space of rooms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely
from topomerge.datasets.core.building import DOOR_DTYPE, NICHE_DTYPE, SURFACES, Building, Difficulty, Opening, Plan, PlanRoom
from topomerge.datasets.core.solids import Prism, build_rectangle

from topomerge.types import Array, TrueRoom

LOW_SILL = 0.3  # m: panes that begin lower are walls of glass


def list_windows(building: Building) -> list[tuple[float, ...]]:
    """List windows: their middle at the height of the floor, direction of the normal (rad), width and depth of the reveal (m)."""
    return [(*place, 0.3) for *place, _, _ in find_windows(building)]


def find_windows(building: Building) -> list[tuple[float, ...]]:
    """Return the windows: middle at the height of the floor, direction of the normal (rad), width, sill and head above the floor
    (m)."""
    glass = building.triangles[building.labels == SURFACES.index("glass")]
    windows = []
    for triangle in glass[::2]:  # two make a pane
        corners = building.vertices[triangle].astype(float)
        low, high = corners[:, 2].min(), corners[:, 2].max()
        floors = building.storeys["floor"]
        floor = float(floors[floors <= low + LOW_SILL].max(initial=floors[0]))
        ends = corners[np.argsort(corners[:, 2])][:2, :2] if corners[1, 2] == low else corners[[0, 2], :2]
        wide = ends[1] - ends[0]
        if low > floor + LOW_SILL and high > low and np.hypot(*wide) > 0.2:
            direction = float(np.arctan2(wide[1], wide[0]) + np.pi / 2)
            windows.append((*ends.mean(axis=0).tolist(), floor, direction, float(np.hypot(*wide)), low - floor, high - floor))
    return windows


OUTER_WALL = 0.3  # m, thickness of outer walls


@dataclass(frozen=True, eq=False)
class RoomCells:
    """A room, or the void over one, as free space."""

    shape: shapely.Polygon
    plan: PlanRoom
    storey: int
    room: int  # index of the true room, -1: a void
    floor: float
    ceiling: float


def build_storey_spaces(
    plans: Sequence[Plan], k: int, floor: float, difficulty: Difficulty, rng: np.random.Generator
) -> list[RoomCells]:
    """Build free space of the rooms of storey k; a room that the walls fill is left out."""
    plan, last = plans[k], k + 1 == len(plans)
    solid = shapely.union_all([build_rectangle(w.start, w.end, w.thickness) for w in plan.walls if not w.glass])
    voids = [] if last else [shapely.Polygon(r.polygon) for r in plans[k + 1].rooms if r.kind == "void"]
    out = []
    for room in plan.rooms:
        shape = shapely.Polygon(room.polygon).difference(solid)
        shape = max(shapely.get_parts(shape), key=lambda p: p.area, default=shapely.Polygon())
        if shape.area < 0.3:
            continue
        ceiling = room.ceiling or plan.ceiling + float(rng.normal(0, 1)) * difficulty.ceiling_spread
        high = bool(room.ceiling > plan.height and any(shape.intersection(v).area > 0.9 * shape.area for v in voids))
        highest = room.ceiling if room.ceiling and (high or last) else plan.height - 0.15
        ceiling = round(min(max(ceiling, 2.2), highest) * 20) / 20
        slope = room.slope
        if last and not slope and room.kind not in ("stairs", "lift", "corridor") and rng.random() < difficulty.slopes:
            slope = 0.5
        slope = min(slope, max(ceiling - 2.25, 0.0))
        out.append(RoomCells(shape, replace(room, slope=slope), k, -1, floor, floor + ceiling))
    return out


def number_spaces(spaces: list[RoomCells]) -> list[RoomCells]:
    count, out = 0, []
    for space in spaces:
        void = space.plan.kind == "void"
        out.append(replace(space, room=-1 if void else count))
        count += not void
    return out


def build_true_room(space: RoomCells) -> TrueRoom:
    ring = np.asarray(shapely.orient_polygons(space.shape).exterior.coords)[:-1]
    kind = space.plan.kind
    return TrueRoom(space.plan.name, ring, space.floor, space.ceiling - space.plan.slope / 2, space.storey, kind)


def compute_footprint(shapes: Sequence[shapely.Geometry]) -> shapely.Geometry:
    """Compute the plan of a storey out to the outer walls' faces; courtyards of more than 9 m2 stay open."""
    closed = shapely.union_all([s.buffer(2 * OUTER_WALL, join_style="mitre") for s in shapes]).buffer(
        -OUTER_WALL, join_style="mitre"
    )
    outlines = [
        shapely.Polygon(p.exterior, [h for h in p.interiors if shapely.Polygon(h).area > 9]) for p in shapely.get_parts(closed)
    ]
    return shapely.union_all(outlines)


OPENING_REACH = 0.6  # m beyond its wall that an opening looks for the room it leads to
DOOR_TOPS = (2.0, 2.05, 2.1, 2.2)  # m


@dataclass(frozen=True, eq=False)
class WallOpening:
    """An opening with the spaces on its two sides (-1: outside) and its box of free space."""

    opening: Opening
    storey: int
    sides: tuple[int, int]
    box: shapely.Polygon
    bottom: float
    top: float
    lintel: bool


def build_openings(
    plan: Plan, k: int, spaces: list[RoomCells], difficulty: Difficulty, rng: np.random.Generator
) -> list[WallOpening]:
    """Build the openings of a storey that lead from a room to another one or outside; the others are left out."""
    here = [i for i, s in enumerate(spaces) if s.storey == k]
    shapes = [spaces[i].shape for i in here]
    openings = [o for o in plan.openings if o.kind != "window" or rng.random() < difficulty.windows] + _convert_glass_walls(plan)
    if not openings:
        return []
    door_top = float(rng.choice(DOOR_TOPS))
    start, end = (np.array([getattr(o, w) for o in openings], float) for w in ("start", "end"))
    along = (end - start) / np.maximum(np.hypot(*(end - start).T), 1e-9)[:, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    steps = np.arange(0.02, OPENING_REACH + 0.5, 0.04)
    probes = (start + end)[:, None, None] / 2 + normal[:, None, None] * np.stack([-steps, steps])[None, ..., None]
    which = _find_spaces(probes, shapes, here)
    limit = np.array([o.thickness / 2 + OPENING_REACH for o in openings])
    out = []
    for o, opening in enumerate(openings):
        hits = [_find_first_space(which[o, s], steps, limit[o]) for s in (0, 1)]
        sides, depths = tuple(h[0] for h in hits), [h[1] for h in hits]
        if max(sides) < 0 or min(sides) == -2 or sides[0] == sides[1]:
            continue
        near, far = -(depths[0] + 0.02) * normal[o], (depths[1] + 0.02) * normal[o]
        box = shapely.Polygon([start[o] + near, end[o] + near, end[o] + far, start[o] + far])
        lintel = bool(rng.random() < difficulty.lintels)
        out.append(_build_opening(opening, k, sides, box, spaces, door_top, lintel))  # type: ignore[arg-type]
    return [h for h in out if h.top > h.bottom + 0.1]


def _find_spaces(probes: Array, shapes: list[shapely.Polygon], here: list[int]) -> Array:
    """Return the space of each probe point; -1: outside of the building, -2: within a wall."""
    points = shapely.points(probes.reshape(-1, 2))
    out = np.full(len(points), -2)
    outside = ~shapely.contains(compute_footprint(shapes), points)
    out[outside] = -1
    point, shape = shapely.STRtree(shapes).query(points, predicate="intersects")
    out[point] = np.asarray(here)[shape]
    return out.reshape(probes.shape[:-1])


def _find_first_space(which: Array, steps: Array, limit: float) -> tuple[int, float]:
    open_steps = np.flatnonzero((which != -2) & (steps <= limit))
    return (int(which[open_steps[0]]), float(steps[open_steps[0]])) if len(open_steps) else (-2, 0.0)


def _build_opening(
    opening: Opening, k: int, sides: tuple[int, int], box: shapely.Polygon, spaces: list[RoomCells], door_top: float, lintel: bool
) -> WallOpening:
    inner = [spaces[s] for s in sides if s >= 0]
    floor = max(s.floor for s in inner)
    limit = min(s.ceiling - s.plan.slope for s in inner) - floor
    top = min(opening.top, limit)
    if not opening.top:
        outer = min(sides) < 0
        top = min(door_top, limit) if opening.kind == "door" and (lintel or outer) else limit
        top = min(2.3, limit - 0.2) if opening.kind == "window" else top
    return WallOpening(opening, k, sides, box, floor + opening.bottom, floor + top, bool(top < limit - 0.05))


def _convert_glass_walls(plan: Plan) -> list[Opening]:
    """Convert glass walls to windows from the floor up, doors left out."""
    doors = shapely.union_all([build_rectangle(o.start, o.end, 0.6) for o in plan.openings if o.kind != "window"])
    out = []
    for wall in (w for w in plan.walls if w.glass):
        for piece in shapely.get_parts(shapely.LineString([wall.start, wall.end]).difference(doors.buffer(0.08))):
            ends = [(float(x), float(y)) for x, y in piece.coords]
            if piece.length > 0.3:
                out.append(Opening("window", ends[0], ends[-1], wall.thickness, 0.1, 20.0))
    return out


def build_true_doors(
    holes: list[WallOpening], spaces: list[RoomCells], difficulty: Difficulty, rng: np.random.Generator
) -> Array:
    """Build true doors and openings; windows and galleries are none."""
    rows = []
    for hole in holes:
        if hole.opening.kind not in ("door", "opening"):
            continue
        a, b = np.array(hole.opening.start), np.array(hole.opening.end)
        rooms = sorted((spaces[s].room if s >= 0 else -1 for s in hole.sides), reverse=True)
        direction = (np.arctan2(b[1] - a[1], b[0] - a[0]) + np.pi / 2) % np.pi
        sides = np.asarray(hole.box.exterior.coords)
        thickness = float(np.hypot(*(sides[2] - sides[1]))) - 0.04
        state = hole.opening.state or sample_door_state(difficulty, rng)
        state = "none" if hole.opening.kind == "opening" else "shut" if rooms[1] < 0 and not hole.opening.state else state
        centre = (*((a + b) / 2), hole.bottom)
        width = float(np.hypot(*(b - a)))
        rows.append((rooms[::-1], centre, width, hole.top - hole.bottom, direction, thickness, state, hole.lintel))
    return np.array([(tuple(r[0]), *r[1:]) for r in rows], DOOR_DTYPE)


def sample_door_state(difficulty: Difficulty, rng: np.random.Generator) -> str:
    """Sample how a door stands."""
    u = rng.random()
    return "open" if u < difficulty.open else "half" if u < difficulty.open + difficulty.half else "shut"


LONG_WALL = 1.4  # m, from which on a wall may have a niche
NICHE_WIDTHS, NICHE_DEPTHS = (0.35, 1.3), (0.04, 0.4)  # m, at least, at most
NICHE_BOTTOMS, NICHE_HEIGHTS = (0.3, 1.1), (0.4, 1.2)  # m
BEHIND_NICHE = 0.05  # m of wall that stay behind it
NICHE_MOUTH = 0.02  # m by which its free space begins before the face, so that it is one with the room's
CORNER = 0.1  # m between a niche and the end of its wall


def cut_niches(
    spaces: Sequence[RoomCells], holes: Sequence[WallOpening], share: float, rng: np.random.Generator
) -> tuple[list[Prism], Array]:
    """Return free space of the niches, and (N,) NICHE_DTYPE.

    Args:
        share: of the longer walls that have one; 0: nothing is drawn from `rng`.
    """
    hollows: list[Prism] = []
    rows: list[tuple[object, ...]] = []
    if share <= 0:
        return hollows, np.array(rows, NICHE_DTYPE)
    for k in sorted({s.storey for s in spaces}):
        here = [s for s in spaces if s.storey == k]
        solid = compute_footprint([s.shape for s in here]).difference(shapely.union_all([s.shape for s in here]))
        solid = solid.difference(shapely.union_all([h.box.buffer(CORNER) for h in holes if h.storey == k]))
        for space in (s for s in here if s.room >= 0):
            ring = np.asarray(shapely.orient_polygons(space.shape).exterior.coords)
            for start, end in pairwise(ring):
                length = float(np.hypot(*(end - start)))
                if length >= LONG_WALL and rng.random() < share:
                    niche = _cut_niche(start, (end - start) / length, length, space, solid, rng)
                    if niche is not None:
                        hollows.append(niche[0])
                        rows.append(niche[1])
                        solid = solid.difference(niche[0].polygon.buffer(CORNER))
    return hollows, np.array(rows, NICHE_DTYPE)


def _cut_niche(
    start: Array, along: Array, length: float, space: RoomCells, solid: shapely.Geometry, rng: np.random.Generator
) -> tuple[Prism, tuple[object, ...]] | None:
    """Cut a niche into the wall that runs from a corner along the room, which lies to its left; None where the wall is too thin.

    Args:
        solid: what is wall, without what other openings and niches need.
    """
    width = float(rng.uniform(NICHE_WIDTHS[0], min(NICHE_WIDTHS[1], length - 2 * CORNER)))
    deepest = float(np.exp(rng.uniform(*np.log(NICHE_DEPTHS))))
    first = start + along * float(rng.uniform(CORNER, length - CORNER - width))
    out = np.array([along[1], -along[0]])
    high = space.ceiling - space.floor - space.plan.slope - CORNER
    bottom = float(rng.uniform(*NICHE_BOTTOMS))
    top = min(bottom + float(rng.uniform(*NICHE_HEIGHTS)), high)
    for depth in deepest * np.array([1.0, 0.6, 0.35]):
        corners = [first, first + along * width, first + along * width + out * depth, first + out * depth]
        behind = shapely.Polygon([*corners[:2], *(c + out * BEHIND_NICHE for c in corners[2:])])
        if depth >= NICHE_DEPTHS[0] and solid.buffer(1e-6).contains(behind):
            shape = shapely.Polygon([c - out * NICHE_MOUTH for c in corners[:2]] + corners[2:])
            centre = (*(np.mean(corners, axis=0)).tolist(), space.floor)
            direction = float(np.arctan2(out[1], out[0]))
            return Prism(shape, space.floor + bottom, space.floor + top), (centre, width, float(depth), direction, bottom, top)
    return None
