"""From plans to a building: walls with thickness, openings, slabs, stairs, and what is fitted and stands in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import shapely
from topomerge.datasets.buildings import fittings
from topomerge.datasets.buildings.stairs import staircase
from topomerge.datasets.core.building import DOOR_DTYPE, LEVEL_DTYPE, STAIR_DTYPE, SURFACES, Building
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.core.plan import Opening, Plan, PlanRoom, check_plan
from topomerge.datasets.core.solids import Prism, Soup, boundary, rectangle

from topomerge.errors import InputError
from topomerge.types import Array, TrueRoom

OUTER = 0.3  # m, thickness of outer walls
REACH = 0.6  # m beyond its wall that an opening looks for the room it leads to
AROUND = 8.0  # m of outdoor space that is modelled around a building
DOOR_TOPS = (2.0, 2.05, 2.1, 2.2)  # m


@dataclass(frozen=True, eq=False)
class Space:
    """A room, or the void over one, as free space."""

    shape: shapely.Polygon
    plan: PlanRoom
    storey: int
    room: int  # index of the true room, -1: a void
    floor: float
    ceiling: float


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


def erect(
    plans: Sequence[Plan],
    difficulty: Difficulty | None = None,
    rng: np.random.Generator | int = 0,
    name: str = "building",
    kind: str = "",
    parameters: Mapping[str, Any] | None = None,
) -> Building:
    """Turn plans, lowest storey first, into a building.

    Args:
        rng: generator or seed; the same seed gives the same bytes.
        parameters: kept with the building, beside the difficulty.

    Raises:
        InputError: no plans, or one that no building could have (`check_plan`), or a stair too steep (`staircase`).
    """
    difficulty = difficulty or Difficulty()
    seed = int(rng) if isinstance(rng, int | np.integer) else -1
    rng = np.random.default_rng(rng)
    if not plans:
        raise InputError(f"{name}: no storeys")
    for k, plan in enumerate(plans):
        check_plan(plan, f"{name} storey {k}")
    floors = np.concatenate([[0.0], np.cumsum([p.height for p in plans])])
    spaces = [s for k in range(len(plans)) for s in _spaces(plans, k, float(floors[k]), difficulty, rng)]
    spaces = _numbered(spaces)
    holes = [h for k, plan in enumerate(plans) for h in _holes(plan, k, spaces, difficulty, rng)]
    stairs, wells, soup = _stairs(plans, floors, spaces)
    _shell(spaces, holes, wells, floors, soup)
    doors = _doors(holes, spaces, difficulty, rng)
    things = fittings.fit(soup, plans, spaces, holes, doors, stairs, difficulty, rng)
    vertices, triangles, labels, thing_of = soup.arrays()
    levels = np.zeros(len(plans), LEVEL_DTYPE)
    levels["floor"], levels["ceiling"] = floors[:-1], [z + p.ceiling for z, p in zip(floors, plans, strict=False)]
    known = {"difficulty": asdict(difficulty), **(parameters or {})}
    rooms = tuple(_true_room(s) for s in spaces if s.room >= 0)
    return Building(name, kind, vertices, triangles, labels, thing_of, rooms, doors, stairs, levels, things, seed, known)


def _spaces(plans: Sequence[Plan], k: int, floor: float, difficulty: Difficulty, rng: np.random.Generator) -> list[Space]:
    """Free space of the rooms of storey k; a room that the walls fill is left out."""
    plan, last = plans[k], k + 1 == len(plans)
    solid = shapely.union_all([rectangle(w.start, w.end, w.thickness) for w in plan.walls if not w.glass])
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
        out.append(Space(shape, replace(room, slope=slope), k, -1, floor, floor + ceiling))
    return out


def _numbered(spaces: list[Space]) -> list[Space]:
    count, out = 0, []
    for space in spaces:
        void = space.plan.kind == "void"
        out.append(replace(space, room=-1 if void else count))
        count += not void
    return out


def _true_room(space: Space) -> TrueRoom:
    ring = np.asarray(shapely.orient_polygons(space.shape).exterior.coords)[:-1]
    kind = space.plan.kind
    return TrueRoom(space.plan.name, ring, space.floor, space.ceiling - space.plan.slope / 2, space.storey, kind)


def _holes(plan: Plan, k: int, spaces: list[Space], difficulty: Difficulty, rng: np.random.Generator) -> list[Hole]:
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
    steps = np.arange(0.02, REACH + 0.5, 0.04)
    probes = (start + end)[:, None, None] / 2 + normal[:, None, None] * np.stack([-steps, steps])[None, ..., None]
    which = _which(probes, shapes, here)
    limit = np.array([o.thickness / 2 + REACH for o in openings])
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
    found = np.flatnonzero((which != -2) & (steps <= limit))
    return (int(which[found[0]]), float(steps[found[0]])) if len(found) else (-2, 0.0)


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


def _stairs(plans: Sequence[Plan], floors: Array, spaces: list[Space]) -> tuple[Array, list[Prism], Soup]:
    """True stairs, the holes in the slabs, and the steps."""
    rows, wells, soup = [], [], Soup()
    for k, plan in enumerate(plans[:-1]):
        for flight in plan.flights:
            built = staircase(flight, float(plan.height))
            path = built.path + [0, 0, floors[k]]
            rooms = [_room_at(path[i, :2], k + up, spaces) for i, up in ((0, 0), (-1, 1))]
            if None in rooms:
                raise InputError(f"storey {k}: the {flight.kind} stair at {flight.corner} ends in no room")
            low = min(s.ceiling for s in spaces if s.room == rooms[0])
            if flight.kind != "lift":
                wells.append(Prism(built.well, low, float(floors[k + 1])))
            soup.add(built.vertices + [0, 0, floors[k]], built.triangles, "stair")
            ends = (path[0], path[-1], built.footprint, built.riser, built.tread, path)
            rows.append((flight.kind, (k, k + 1), tuple(rooms), *ends))
    return np.array(rows, STAIR_DTYPE), wells, soup


def _room_at(point: Array, storey: int, spaces: list[Space]) -> int | None:
    at = shapely.Point(point)
    return next((s.room for s in spaces if s.storey == storey and s.room >= 0 and s.shape.covers(at)), None)


def footprint(shapes: Sequence[shapely.Geometry]) -> shapely.Geometry:
    """Plan of a storey out to the outer walls' faces; courtyards of more than 9 m2 stay open."""
    closed = shapely.union_all([s.buffer(2 * OUTER, join_style="mitre") for s in shapes]).buffer(-OUTER, join_style="mitre")
    kept = [
        shapely.Polygon(p.exterior, [h for h in p.interiors if shapely.Polygon(h).area > 9]) for p in shapely.get_parts(closed)
    ]
    return shapely.union_all(kept)


def _shell(spaces: list[Space], holes: list[Hole], wells: list[Prism], floors: Array, soup: Soup) -> None:
    """Add walls, floors, ceilings, facade and roof."""
    plans = [footprint([s.shape for s in spaces if s.storey == k]) for k in range(len(floors) - 1)]
    world = shapely.box(*shapely.union_all(plans).bounds).buffer(AROUND, join_style="mitre")
    roof = max(float(floors[-1]), max(s.ceiling for s in spaces) + 0.2)
    tops = [*floors[1:-1], roof]
    outside = [Prism(world.difference(p), float(z), float(t)) for p, z, t in zip(plans, floors, tops, strict=False)]
    rooms = [Prism(s.shape, s.floor, s.ceiling) for s in spaces]
    gaps = [Prism(h.box, h.bottom, h.top) for h in holes]
    faces = boundary([*rooms, *gaps, *wells, *outside, Prism(world, roof, roof + 1)])
    rim = np.array(world.bounds).reshape(2, 2)
    on_rim = (np.abs(faces.sides[:, :2, None, :2] - rim) < 0.01).any(axis=2).all(axis=1).any(axis=1)
    sides = faces.sides[~on_rim]
    normal = np.cross(sides[:, 1] - sides[:, 0], sides[:, 3] - sides[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    outer = _outdoors(sides.mean(axis=1) + 0.02 * normal, plans, floors)
    count = np.arange(len(sides))[:, None, None]
    labels = np.repeat(np.where(outer, SURFACES.index("facade"), SURFACES.index("wall")), 2)
    soup.add(sides.reshape(-1, 3), (np.array([[0, 1, 2], [0, 2, 3]]) + 4 * count).reshape(-1, 3), labels)
    ground = faces.ups[:, 0, 2] < floors[0] + 1e-3
    for flat, label, up in ((faces.ups, "floor", 0.02), (faces.downs[faces.downs[:, 0, 2] < roof + 0.5], "ceiling", -0.02)):
        centre = flat.mean(axis=1) + [0, 0, up]
        outer = _outdoors(centre, plans, floors)
        kept = ~(outer & ground) if label == "floor" else np.ones(len(flat), bool)
        values = np.where(outer, SURFACES.index("facade"), np.where(_indoors(centre, spaces), SURFACES.index(label), 0))
        at_floor = (np.abs(flat[:, 0, 2, None] - floors) < 1e-3).any(axis=1) & (label == "floor") & ~outer
        values[at_floor] = SURFACES.index("floor")
        soup.add(flat[kept].reshape(-1, 3), np.arange(3 * kept.sum()).reshape(-1, 3), values[kept])


def _outdoors(points: Array, plans: list[shapely.Geometry], floors: Array) -> Array:
    storey = np.clip(np.searchsorted(floors, points[:, 2], side="right") - 1, 0, len(plans) - 1)
    out = points[:, 2] > floors[-1]
    for k, plan in enumerate(plans):
        here = (storey == k) & ~out
        shapely.prepare(plan)
        out[here] = ~shapely.contains_xy(plan, points[here, :2])
    return np.asarray(out)


def _indoors(points: Array, spaces: list[Space]) -> Array:
    """Does a point lie within a room's outline, at its height?"""
    tree = shapely.STRtree([s.shape for s in spaces])
    point, space = tree.query(shapely.points(points[:, :2]), predicate="intersects")
    low, high = (np.array([getattr(s, w) for s in spaces]) for w in ("floor", "ceiling"))
    right = (points[point, 2] > low[space]) & (points[point, 2] < high[space])
    out = np.zeros(len(points), bool)
    out[point[right]] = True
    return out


def _doors(holes: list[Hole], spaces: list[Space], difficulty: Difficulty, rng: np.random.Generator) -> Array:
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
