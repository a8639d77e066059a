"""Two sessions in one building between which walls, doors and furniture have changed, and the list of what has.

A wall with a door is put across a room, and a doorway is filled with masonry: boxes that are added to the mesh. Which session
comes first is drawn, so that walls are gone as often as they are new. Doors and furniture change as between any two sessions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.buildings.furniture import compute_footprints
from topomerge.datasets.buildings.layouts import BUILDING_KINDS, PROFILES
from topomerge.datasets.buildings.procedural import is_connected, make_plans
from topomerge.datasets.core.building import SURFACES, THING_DTYPE, Building, Difficulty, Opening, Plan
from topomerge.datasets.core.solids import build_rectangle, triangulate_boxes
from topomerge.datasets.plans.sealed import refuse_building
from topomerge.datasets.simulation.scanner import scan_building, transform_cloud
from topomerge.datasets.simulation.session import simulate_session

from topomerge.errors import InputError
from topomerge.types import Array, PointCloud, Sim3

THICKNESS, DOORWAY, LINTEL = 0.12, 0.9, 2.05  # m, of the walls that are put up
ROOM_AREA, FROM_DOOR = 14.0, 0.8  # m2 of a room that is divided, m between its doors and the new wall
PLACES_TRIED = 30
EXTRA_DOOR = 2.4  # m of wall that two rooms share, from which on they get a door
SMALL_THING, NUDGE = 0.25, 0.3  # m2 of a footprint, m of a move: what is less neither has to be found nor is it wrong
STAYS = 0.03  # m
KEPT_APART = ("leaf", "lamp", "beam")
SEEN_POINTS, SEEN_SHARE = 25, 0.6  # points on what stands; share of its ground that the other session saw
GROUND_CELL = 0.15  # m


@dataclass(frozen=True)
class TrueChange:
    """A change that is true, in the coordinates of the building.

    Args:
        kind: as `topomerge.changes.compare.KINDS`; furniture that moved is gone in one place and new in another.
        place: (2,) m.
        outline: of it from above, m.
        seen: could both sessions have seen it, and is it large enough to be judged?
    """

    kind: str
    place: tuple[float, float]
    outline: shapely.Polygon
    seen: bool = True


@dataclass(frozen=True, eq=False)
class ChangedPair:
    """Two clouds of one building, the pose of the second in the frame of the first, and what has changed.

    Args:
        building: as the first session found it.
        clouds: of the two sessions, in frames of their own.
        frames: building -> cloud.
        changes: from the first to the second; places in the building's coordinates.
    """

    building: Building
    clouds: tuple[PointCloud, PointCloud]
    frames: tuple[Sim3, Sim3]
    changes: tuple[TrueChange, ...]

    @property
    def truth(self) -> Sim3:
        """T_ab."""
        return self.frames[0] @ self.frames[1].inverse()


def make_changed_pair(
    kind: str, seed: int, sensors: tuple[str, str], changed: bool = True, spacing: float = 0.05, rooms: int = 12
) -> ChangedPair:
    """Make two sessions in one building.

    Args:
        kind, seed: of the building.
        sensors: of the two sessions.
        changed: did anything change between them?
        spacing: m between points.
        rooms: that the sessions visit at most, the same ones.

    Raises:
        InputError: no building of this seed, or a sealed one.
    """
    rng = np.random.default_rng([seed, BUILDING_KINDS.index(kind), 53])
    base = make_base_building(kind, seed, rng)
    visited = [i for i, r in enumerate(base.rooms) if r.kind != "lift"][:rooms]
    days = base, base
    done: list[TrueChange] = []
    if changed:
        base, other, done = _alter(base, visited, rng)
        later = simulate_session(other, Difficulty(moved=0.12, gone=0.1, doors_moved=0.3, people=0.1), rng)
        done += _list_door_states(base, later, visited) + _list_furniture(base, later, visited)
        days = base, later
        if rng.random() < 0.5:
            days, done = (later, base), [replace(c, kind=_REVERSED[c.kind]) for c in done]
    frames = Sim3(float(rng.uniform(-3, 3)), (3.0, -2.0, 0.4)), Sim3(float(rng.uniform(-3, 3)), (-5.0, 1.0, -0.3))
    scans = [
        scan_building(day, name, _find_reachable(day, visited), rng, spacing) for day, name in zip(days, sensors, strict=True)
    ]
    done = [replace(c, seen=c.seen and _is_seen(c, scans, days)) for c in done]
    walls = [c.outline for c in done if c.kind.startswith("wall") and c.seen]  # a room is split where its wall was seen
    done = [replace(c, seen=bool(shapely.intersects(walls, c.outline).any())) if c.kind.startswith("room") else c for c in done]
    clouds = transform_cloud(scans[0], frames[0]), transform_cloud(scans[1], frames[1])
    return ChangedPair(days[0], clouds, frames, tuple(done))


_REVERSED = {
    "room split": "room joined",
    "wall new": "wall gone", "wall gone": "wall new", "door new": "door gone", "door gone": "door new",
    "door bricked up": "door cut", "door opened": "door shut", "door shut": "door opened",
    "furniture new": "furniture gone", "furniture gone": "furniture new",
}  # fmt: skip


def make_base_building(kind: str, seed: int, rng: np.random.Generator) -> Building:
    """Make a building of one storey in which some neighbours have a door between them, too, so that one can be walled up."""
    refuse_building("procedural", str(seed))
    difficulty = Difficulty(furniture=1.0, open=0.7, half=0.1)
    for _ in range(10):
        plans = make_plans(PROFILES[kind], 1, difficulty, rng)
        plans = [_add_doors(plans[0], rng)]
        building = build_building(plans, difficulty, rng, f"{kind}-{seed}-1", kind, {})
        if is_connected(building):
            return replace(building, seed=seed)
    raise InputError(f"{kind}-{seed}: no plan found in which every room can be reached; another seed will do")


def _add_doors(plan: Plan, rng: np.random.Generator) -> Plan:
    """Add doors between up to three pairs of neighbours."""
    shapes = [shapely.Polygon(r.polygon) for r in plan.rooms]
    taken = [build_rectangle(o.start, o.end, o.thickness) for o in plan.openings]
    added: list[Opening] = []
    pairs = [(i, j) for i in range(len(shapes)) for j in range(i) if 0.02 < shapes[i].distance(shapes[j]) < 0.3]
    for k in rng.permutation(len(pairs)).tolist():
        i, j = pairs[k]
        gap = shapes[i].distance(shapes[j])
        strip = shapes[i].buffer(gap, join_style="mitre").intersection(shapes[j].buffer(gap, join_style="mitre"))
        corners = np.asarray(shapely.minimum_rotated_rectangle(strip).exterior.coords)[:4] if strip.area > 0 else np.zeros((4, 2))
        sides = np.linalg.norm(np.diff(corners[:3], axis=0), axis=1)
        if sides.max() < EXTRA_DOOR or sides.min() > 0.7 or len(added) == 3:
            continue
        along = np.diff(corners[:3], axis=0)[sides.argmax()] / sides.max()
        middle, half = corners.mean(axis=0), 0.45 * along
        opening = Opening("door", tuple(middle - half), tuple(middle + half), gap + 0.1, state="open")
        if not shapely.intersects(taken, build_rectangle(opening.start, opening.end, 1.2)).any():
            added.append(opening)
    return replace(plan, openings=(*plan.openings, *added))


def _alter(base: Building, visited: Sequence[int], rng: np.random.Generator) -> tuple[Building, Building, list[TrueChange]]:
    """Return the building, its things in the way taken out, and the same with a wall more and a doorway less; and what that
    is."""
    done: list[TrueChange] = []
    divided: list[TrueChange] = []
    other = base
    for room in rng.permutation(visited).tolist():
        wall = _draw_wall(base, room, rng)
        if wall is not None:
            parts, outline, doorway = wall
            base = _remove_things(base, outline)
            other = _add_masonry(base, parts, room)
            done += [_describe("wall new", outline), _describe("door new", doorway)]
            divided = [_describe("room split", shapely.Polygon(base.rooms[room].polygon))]
            break
    walled = shapely.union_all([c.outline for c in done])
    inner = np.flatnonzero((other.doors["rooms"] >= 0).all(axis=1) & np.isin(other.doors["rooms"], visited).all(axis=1))
    for d in rng.permutation(inner).tolist():
        door = other.doors[d]
        trial = replace(other, doors=np.delete(other.doors, d))
        outline = _outline_door(door)
        if not is_connected(trial) or outline.distance(walled) < 1.5:
            continue
        height = base.rooms[door["rooms"][0]].ceiling - float(door["centre"][2])
        centre = (*door["centre"][:2], float(door["centre"][2]) + height / 2)
        size = (float(door["thickness"]), float(door["width"]), height)
        other = _remove_leaves(other, d)
        other = _add_masonry(other, [(centre, size, float(door["direction"]))], int(door["rooms"][0]))
        other = replace(other, doors=np.delete(other.doors, d), things=_renumber_doors(other.things, d))
        done.append(_describe("door bricked up", outline))
        break
    return base, other, done + divided


Masonry = tuple[tuple[float, ...], tuple[float, ...], float]  # centre, size, yaw


def _draw_wall(
    building: Building, room: int, rng: np.random.Generator
) -> tuple[list[Masonry], shapely.Polygon, shapely.Polygon] | None:
    """Draw the boxes of a wall with a doorway across a room, its outline and that of the doorway."""
    about = building.rooms[room]
    shape = shapely.Polygon(about.polygon)
    if shape.area < ROOM_AREA or about.kind in ("stairs", "lift", "corridor", "void") or about.ceiling - about.floor < 2.3:
        return None
    corners = np.asarray(shapely.minimum_rotated_rectangle(shape).exterior.coords)[:4]
    sides = np.diff(corners[:3], axis=0)
    lengths = np.linalg.norm(sides, axis=1)
    way = sides[lengths.argmax()] / lengths.max()
    across = np.array([-way[1], way[0]])
    own = building.doors[(building.doors["rooms"] == room).any(axis=1)]
    doors = [_outline_door(d).buffer(FROM_DOOR) for d in own]
    fixed = [t for t in building.things if t["room"] == room and not t["movable"]]
    for _ in range(PLACES_TRIED):
        at = corners.mean(axis=0) + way * rng.uniform(-0.25, 0.25) * lengths.max()
        line = shapely.LineString([at - 30 * across, at + 30 * across]).intersection(shape)
        if line.geom_type != "LineString" or line.length < 2.2:
            continue
        a, b = (np.array(p) for p in (line.coords[0], line.coords[-1]))
        outline = build_rectangle(tuple(a), tuple(b), THICKNESS)
        if any(outline.intersects(d) for d in doors) or any(outline.intersects(_outline_thing(t)) for t in fixed):
            continue
        place = float(rng.uniform(0.75, line.length - 0.75))
        along = (b - a) / line.length
        ends = [(0.0, place - DOORWAY / 2), (place + DOORWAY / 2, line.length)]
        yaw, low, high = float(np.arctan2(along[1], along[0])), about.floor, about.ceiling
        parts: list[Masonry] = []
        for s, t in ends:
            middle = a + along * (s + t) / 2
            parts.append(((*middle, (low + high) / 2), (t - s, THICKNESS, high - low), yaw))
        middle = a + along * place
        parts.append(((*middle, (low + LINTEL + high) / 2), (DOORWAY, THICKNESS, high - low - LINTEL), yaw))
        half = along * DOORWAY / 2
        return parts, outline, build_rectangle(tuple(middle - half), tuple(middle + half), THICKNESS)
    return None


def _add_masonry(building: Building, parts: Sequence[Masonry], room: int) -> Building:
    """Add boxes of masonry to the building; they are things, too, so that nobody walks through them."""
    vertices, triangles, rows = [building.vertices], [building.triangles], []
    count = len(building.vertices)
    for centre, size, yaw in parts:
        corners, faces = triangulate_boxes(np.array([[0, 0, 0, *size]]), np.array(centre), yaw)
        vertices.append(corners.astype(np.float32))
        triangles.append((faces + count).astype(np.int32))
        count += len(corners)
        rows.append(("column", room, -1, centre, size, yaw, centre[:2], False))
    added = sum(len(t) for t in triangles[1:])
    return replace(
        building,
        vertices=np.concatenate(vertices),
        triangles=np.concatenate(triangles),
        labels=np.append(building.labels, np.full(added, SURFACES.index("wall"), np.uint8)),
        thing_of=np.append(building.thing_of, np.full(added, -1, np.int32)),
        things=np.concatenate([building.things, np.array(rows, THING_DTYPE)]),
    )


def _remove_things(building: Building, outline: shapely.Polygon) -> Building:
    """Return the building without the movable things that stand in a place."""
    away = np.array([t["movable"] and outline.buffer(0.05).intersects(_outline_thing(t)) for t in building.things], bool)
    return _keep_things(building, ~away)


def _remove_leaves(building: Building, door: int) -> Building:
    return _keep_things(building, building.things["door"] != door)


def _keep_things(building: Building, keeps: Array) -> Building:
    number = np.where(keeps, np.cumsum(keeps) - 1, -1).astype(np.int32)
    stays = (building.thing_of < 0) | keeps[building.thing_of]
    owner = building.thing_of[stays]
    return replace(
        building,
        triangles=building.triangles[stays],
        labels=building.labels[stays],
        thing_of=np.where(owner >= 0, number[owner], -1).astype(np.int32),
        things=building.things[keeps],
    )


def _renumber_doors(things: Array, gone: int) -> Array:
    out = things.copy()
    out["door"] -= out["door"] > gone
    return out


def _outline_thing(thing: Array) -> shapely.Polygon:
    return shapely.Polygon(compute_footprints(thing["centre"][None, :2], thing["yaw"][None], thing["size"].tolist())[0])


def _outline_door(door: Array) -> shapely.Polygon:
    along = np.array([-np.sin(door["direction"]), np.cos(door["direction"])]) * float(door["width"]) / 2
    at = door["centre"][:2]
    return build_rectangle(tuple(at - along), tuple(at + along), max(float(door["thickness"]), 0.1))


def _describe(kind: str, outline: shapely.Polygon) -> TrueChange:
    return TrueChange(kind, (float(outline.centroid.x), float(outline.centroid.y)), outline)


def _find_reachable(building: Building, visited: Sequence[int]) -> list[int]:
    """Return those of the rooms that can be walked to from the most of them."""
    part = building.find_components()[list(visited)]
    most = np.bincount(part).argmax()
    return [r for r, p in zip(visited, part.tolist(), strict=True) if p == most]


def _list_door_states(old: Building, new: Building, visited: Sequence[int]) -> list[TrueChange]:
    """List the doors that were opened or shut; those that only swung further are as they were."""
    out = []
    for door in new.doors:
        same = np.flatnonzero(np.linalg.norm(old.doors["centre"] - door["centre"], axis=1) < 0.05)
        if len(same) and np.isin(door["rooms"], visited).any() and door["state"] != "none":
            before, after = (str(s) == "shut" for s in (old.doors["state"][same[0]], door["state"]))
            if before != after:
                out.append(_describe("door shut" if after else "door opened", _outline_door(door)))
    return out


def _list_furniture(old: Building, new: Building, visited: Sequence[int]) -> list[TrueChange]:
    """List the things that stand on the floor of a visited room in one session, and not there in the other one."""
    tables = []
    for building in (old, new):
        present = np.isin(np.arange(len(building.things)), building.thing_of)
        t = building.things
        floors = np.array([r.floor for r in building.rooms])[t["room"]]
        low, high = t["centre"][:, 2] - t["size"][:, 2] / 2 - floors, t["centre"][:, 2] + t["size"][:, 2] / 2 - floors
        shown = (
            present & ~np.isin(t["kind"], KEPT_APART) & t["movable"] & (low < 0.5) & (high > 0.3) & np.isin(t["room"], visited)
        )
        tables.append(t[shown])
    out = []
    for kind, own, others in (("furniture gone", tables[0], tables[1]), ("furniture new", tables[1], tables[0])):
        for thing in own:
            alike = others[(others["kind"] == thing["kind"]) & (np.abs(others["size"] - thing["size"]).max(axis=1) < 1e-6)]
            apart = np.linalg.norm(alike["centre"][:, :2] - thing["centre"][:2], axis=1).min(initial=np.inf)
            if apart > STAYS:
                judged = apart >= NUDGE and thing["size"][0] * thing["size"][1] >= SMALL_THING
                out.append(replace(_describe(kind, _outline_thing(thing)), seen=bool(judged)))
    return out


def _is_seen(change: TrueChange, scans: Sequence[PointCloud], days: Sequence[Building]) -> bool:
    """Return whether both sessions saw it: points on what stands, in one, and its ground, or the ceiling over it, in the other
    one."""
    near = change.outline.buffer(0.12)
    counts, shares = [], []
    for scan, day in zip(scans, days, strict=True):
        floor = min(r.floor for r in day.rooms)
        x0, y0, x1, y1 = near.bounds
        p = scan.points
        p = p[(p[:, 0] > x0) & (p[:, 0] < x1) & (p[:, 1] > y0) & (p[:, 1] < y1)]
        p = p[shapely.contains_xy(near, p[:, 0], p[:, 1])]
        height = p[:, 2] - floor
        counts.append(int(((height > 0.25) & (height < 2.0)).sum()))
        level = p[(np.abs(height) < 0.15) | ((height > 2.05) & ("furniture" not in change.kind))]
        level = level[shapely.contains_xy(change.outline, level[:, 0], level[:, 1])]
        cells = len(np.unique(np.floor(level[:, :2] / GROUND_CELL), axis=0)) * GROUND_CELL**2
        shares.append(cells / max(change.outline.area, GROUND_CELL**2))
    if change.kind in ("door opened", "door shut", "door bricked up", "door cut"):
        return min(counts) >= SEEN_POINTS
    stands = 1 if change.kind.endswith("new") else 0
    return counts[stands] >= SEEN_POINTS and shares[1 - stands] >= SEEN_SHARE
