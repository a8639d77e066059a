"""Pairs of maps of worlds of boxes, which share nothing with the simulator that the verdict learned from: walls, doors and
furniture are boxes, points lie on what the visited rooms show, maps are as extracted. Kind and seed say all about a pair.

Kinds that must not merge: ``storeys`` (one plan, each with furniture of its own), ``halves`` (the same, all rooms seen: two
halves of a point-symmetric building), ``hotel`` (other rooms of one row of equal rooms, half of the furniture moved),
``row`` (the same with all furniture in its place), ``row-other`` (the same with other furniture), ``row-overlap`` (equal
rooms that share two of three: only the true pose is right, and several shifts explain what is seen). Kinds that should:
``same``, ``same-moved`` (one world, seven tenths of its rooms each, a tenth or a quarter of the furniture moved).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from topomerge.extraction.extract import extract
from topomerge.io.maps import load_map, save_map
from topomerge.registration.pipeline import Registration
from topomerge.types import Array, Sim3, TopometricMap

HEIGHT, DOOR, DOOR_HEIGHT, GAP = 2.6, 0.9, 2.05, 0.06  # m; gap: half of a wall's thickness
DENSITY, NOISE = 300.0, 0.015  # points per m2; m
RIGHT = 0.5  # m
APART = ("storeys", "halves", "hotel", "row", "row-other", "row-overlap")
TOGETHER = ("same", "same-moved")
BOX_KINDS = (*TOGETHER, *APART)
ROW_ROOMS, ROOMS_SEEN = 10, 3  # of a side of a row; of a map
Sequence3 = tuple[float, float, float]


@dataclass
class World:
    """A corridor and the rooms beside it, in which boxes stand.

    Args:
        rooms: (n, 4) x0, y0, x1, y1 between the faces of the walls, m; the first one is the corridor.
        doors: (d, 3) x, y, room: from the corridor into each room.
        things: of each room, boxes (k, 5) x0, y0, x1, y1, height.
    """

    rooms: Array
    doors: Array
    things: list[Array]

    def clear_of(self, room: int) -> Array:
        """Return (k, 2) doors of a room."""
        return self.doors[self.doors[:, 2] == room, :2]


def draw_world(rng: np.random.Generator, count: int, width: float | None = None) -> World:
    """Return rooms on both sides of a corridor: `count` of them of one width beside each other, or as many of about 4 m."""
    length, depth, corridor = count * (width or 4.0), rng.uniform(3.6, 5.0), 2.0
    rooms, doors = [[0.0, depth, length, depth + corridor]], []
    for low, high, wall in ((0.0, depth, depth), (depth + corridor, depth + corridor + depth, depth + corridor)):
        if width is None and wall > depth:
            high = wall + rng.uniform(3.5, 5.0)
        cuts = [0.0]
        while cuts[-1] < length - 1e-6:
            wide = width or rng.uniform(2.8, 5.5)
            cuts.append(length if width is None and cuts[-1] + wide > length - 2.2 else cuts[-1] + wide)
        for x0, x1 in pairwise(cuts):
            doors.append([x0 + (0.8 if width else rng.uniform(0.8, x1 - x0 - 0.8)), wall, len(rooms)])
            rooms.append([x0, low, x1, high])
    inner = np.array(rooms) + np.array([1, 1, -1, -1]) * GAP
    return World(inner, np.array(doors), [np.zeros((0, 5)) for _ in rooms])


def furnish_room(world: World, room: int, count: int, rng: np.random.Generator) -> Array:
    """Return (k, 5) boxes on the floor of a room, clear of each other and of its doors, most of them along walls."""
    x0, y0, x1, y1 = world.rooms[room]
    things: list[list[float]] = []
    for _ in range(6 * count):
        wide, deep, tall = rng.uniform(0.5, 1.7), rng.uniform(0.4, 0.9), rng.uniform(0.4, 1.9)
        wide, deep = (wide, deep) if rng.random() < 0.5 else (deep, wide)
        if len(things) == count or x1 - x0 < wide + 0.6 or y1 - y0 < deep + 0.6:
            continue
        x, y = rng.uniform(x0 + 0.06, x1 - wide - 0.06), rng.uniform(y0 + 0.06, y1 - deep - 0.06)
        if rng.random() < 0.6:
            sides = [(x0 + 0.05, y), (x1 - wide - 0.05, y), (x, y0 + 0.05), (x, y1 - deep - 0.05)]
            x, y = sides[int(rng.integers(4))]
        touches = any(x < o[2] + 0.1 and x + wide > o[0] - 0.1 and y < o[3] + 0.1 and y + deep > o[1] - 0.1 for o in things)
        blocks = any(x - 0.5 < d[0] < x + wide + 0.5 and y - 0.5 < d[1] < y + deep + 0.5 for d in world.clear_of(room))
        if not touches and not blocks:
            things.append([x, y, x + wide, y + deep, tall])
    return np.array(things).reshape(-1, 5)


def furnish_all(world: World, rng: np.random.Generator) -> World:
    """Return the world with one to four things in each room beside the corridor."""
    rooms = range(1, len(world.rooms))
    things = [furnish_room(world, room, int(rng.integers(1, 5)), rng) for room in rooms]
    return World(world.rooms, world.doors, [world.things[0], *things])


def move_things(world: World, share: float, rng: np.random.Generator) -> World:
    """Return the world with a share of its things at other places of their rooms."""
    things = []
    for room, boxes in enumerate(world.things):
        stays = rng.random(len(boxes)) > share
        things.append(np.concatenate([boxes[stays], furnish_room(world, room, int((~stays).sum()), rng)]))
    return World(world.rooms, world.doors, things)


def scan_world(world: World, visited: list[int], rng: np.random.Generator) -> tuple[Array, Sim3]:
    """Return (n, 3) points of the visited rooms in a frame of the map's own, and that frame: world -> map."""
    parts = [scan_room(world, room, rng) for room in visited]
    for x, y, room in world.doors:
        if int(room) in visited or 0 in visited:
            parts.append(sample_plane((x - DOOR / 2, y - GAP, 0.0), (DOOR, 0, 0), (0, 2 * GAP, 0), rng))
    points = np.concatenate(parts)
    x, y, z = rng.uniform(-20.0, 20.0, 3) * (1.0, 1.0, 0.05)
    frame = Sim3(float(rng.uniform(-np.pi, np.pi)), (float(x), float(y), float(z)))
    return frame.apply(points + rng.normal(0.0, NOISE, points.shape)), frame


def scan_room(world: World, room: int, rng: np.random.Generator) -> Array:
    """Return (n, 3) points on floor, ceiling, walls and things of a room; none where a door is, or under a thing."""
    x0, y0, x1, y1 = world.rooms[room]
    wide, deep = (x1 - x0, 0, 0), (0, y1 - y0, 0)
    up = (0, 0, HEIGHT)
    flat = [sample_plane((x0, y0, z), wide, deep, rng) for z in (0.0, HEIGHT)]
    walls = np.concatenate([sample_plane(*side, up, rng) for side in (((x0, y0, 0), wide), ((x0, y1, 0), wide))])
    walls = np.concatenate([walls, *(sample_plane((x, y0, 0), deep, up, rng) for x in (x0, x1))])
    for x, y, other in world.doors:
        if room in (0, int(other)):
            in_door = (np.abs(walls[:, 0] - x) < DOOR / 2) & (np.abs(walls[:, 1] - y) < 0.2) & (walls[:, 2] < DOOR_HEIGHT)
            walls = walls[~in_door]
    points, faces = np.concatenate([*flat, walls]), []
    for u0, v0, u1, v1, tall in world.things[room]:
        inside = (points[:, :2] > (u0 + 0.02, v0 + 0.02)).all(axis=1) & (points[:, :2] < (u1 - 0.02, v1 - 0.02)).all(axis=1)
        points = points[~(inside & (points[:, 2] < tall - 0.02))]
        along, across, high = (u1 - u0, 0, 0), (0, v1 - v0, 0), (0, 0, tall)
        faces.append(sample_plane((u0, v0, tall), along, across, rng))
        faces += [sample_plane((u0, v, 0), along, high, rng) for v in (v0, v1)]
        faces += [sample_plane((u, v0, 0), across, high, rng) for u in (u0, u1)]
    return np.concatenate([points, *faces])


def sample_plane(corner: Sequence3, first: Sequence3, second: Sequence3, rng: np.random.Generator) -> Array:
    """Return (n, 3) points of a parallelogram, `DENSITY` a square metre."""
    u, v = np.array(first, float), np.array(second, float)
    count = rng.poisson(float(np.linalg.norm(u) * np.linalg.norm(v)) * DENSITY)
    return np.array(corner) + rng.random((count, 1)) * u + rng.random((count, 1)) * v


def draw_pair(kind: str, seed: int) -> tuple[tuple[Array, Sim3], tuple[Array, Sim3]]:
    """Return points and frame of both maps of a pair."""
    rng = np.random.default_rng([seed, (*APART, *TOGETHER).index(kind)])
    if kind in ("storeys", "halves", *TOGETHER):
        first = furnish_all(draw_world(rng, int(rng.integers(3, 6))), rng)
        second = furnish_all(first, rng) if kind in APART else move_things(first, 0.1 if kind == "same" else 0.25, rng)
        others = np.arange(1, len(first.rooms))
        seen = len(others) if kind == "halves" else max(3, round(0.7 * len(others)))
        visited = [[0, *sorted(rng.choice(others, seen, replace=False).tolist())] for _ in range(2)]
        return scan_world(first, visited[0], rng), scan_world(second, visited[1], rng)
    width = float(rng.uniform(3.4, 4.2))
    world = furnish_row(draw_world(rng, ROW_ROOMS, width), width, kind, rng)
    start = int(rng.integers(1, 3))
    starts = (start, start + ROOMS_SEEN + (-2 if kind == "row-overlap" else 1))
    one, other = (scan_part(world, width, k, rng) for k in starts)
    return one, other


def furnish_row(world: World, width: float, kind: str, rng: np.random.Generator) -> World:
    """Return a row with the things of one room of each side in all of its rooms, moved or new ones as the kind has them."""
    if kind == "row-other":
        return furnish_all(world, rng)
    things = [world.things[0]]
    for side in (1, 1 + ROW_ROOMS):
        furniture = furnish_room(world, side, 4, rng)
        things += [furniture + np.array([k, 0, k, 0, 0]) * width for k in range(ROW_ROOMS)]
    row = World(world.rooms, world.doors, things)
    return move_things(row, 0.5, rng) if kind == "hotel" else row


def scan_part(world: World, width: float, start: int, rng: np.random.Generator) -> tuple[Array, Sim3]:
    """Scan `ROOMS_SEEN` rooms of both sides of a row, and the corridor a little beyond them."""
    rooms = world.rooms.copy()
    rooms[0, [0, 2]] = (start - 0.4) * width, (start + ROOMS_SEEN + 0.4) * width
    visited = [0, *(1 + k + side for side in (0, ROW_ROOMS) for k in range(start, start + ROOMS_SEEN))]
    return scan_world(World(rooms, world.doors, world.things), visited, rng)


def load_pair(kind: str, seed: int, cache: Path) -> tuple[TopometricMap, TopometricMap, Sim3, Array]:
    """Load both maps of a pair, the true pose T_ab if they are of one place, and the middle of b, m; made where they are
    missing."""
    about = cache / f"{kind}-{seed}.json"
    files = [cache / f"{kind}-{seed}-{side}.tmap" for side in "ab"]
    if not about.exists():
        cache.mkdir(parents=True, exist_ok=True)
        pair = draw_pair(kind, seed)
        for (points, _), file in zip(pair, files, strict=True):
            save_map(extract(points), file)
        truth = pair[0][1] @ pair[1][1].inverse()
        about.write_text(json.dumps({"truth": [truth.yaw, *truth.translation], "middle": pair[1][0].mean(axis=0).tolist()}))
    read = json.loads(about.read_text())
    yaw, x, y, z = read["truth"]
    return load_map(files[0]), load_map(files[1]), Sim3(yaw, (x, y, z)), np.array(read["middle"])


def is_right(registration: Registration, kind: str, truth: Sim3, middle: Array) -> bool:
    """Return whether a pose is right. Of places that are not one, none is."""
    if registration.transform is None or kind in APART[:-1]:
        return False
    off = registration.transform.apply(middle[None]) - truth.apply(middle[None])
    return bool(np.linalg.norm(off) < RIGHT)
