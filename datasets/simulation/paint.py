"""Colours of what a scan shows: walls and what hangs on them, leaves of doors and their frames, furniture; under uneven light.

A building keeps its paint: two scans of it differ in light and exposure only. Leaves may have the colour of their wall, and what
is as large as a door may be painted on a wall: colour alone must not make a door.
"""

from __future__ import annotations

import numpy as np
from topomerge.datasets.core.building import SURFACES, Building
from topomerge.datasets.simulation.rays import Hits

from topomerge.errors import InputError
from topomerge.types import Array

SHADES = ("colour", "intensity")  # what a sensor may tell of a surface beside its place
ACCENT, WAINSCOT, SKIRTING, ROUGH = 0.25, 0.15, 0.5, 0.3  # share of the rooms with walls of another colour, in two colours, ...
LIKE_WALL = 0.3  # share of the buildings whose doors have the colour of their walls
OTHER_LEAF = 0.15  # share of the doors that are unlike the others of the building
POSTERS, PANELS = 0.12, 0.03  # a metre of wall: what hangs on it, and what reaches from the floor to the height of a door
FRAME = 0.12  # m to all sides of an opening
ON_WALL = 0.3  # m from the outline of a room to the surface of its wall
LIGHT_WAVES = 5
FALLOFF = 4.0  # m: intensities are given as if surfaces were this far away, mostly


def painted(building: Building, hits: Hits, points: Array, rooms: Array, kind: str, rng: np.random.Generator) -> Array:
    """(n, 3) uint8 colours; of an intensity all three are equal.

    Args:
        points: (n, 3) m, where the hits truly are.
        rooms: (n,) the room of each, -1 none.
        kind: ``colour`` or ``intensity``.
        rng: of light and exposure.

    Raises:
        InputError: another kind.
    """
    if kind not in SHADES:
        raise InputError(f"shades {kind!r} of a sensor: {', '.join(SHADES)} or none are possible")
    paint = np.random.default_rng([max(building.seed, 0), len(building.triangles), 21])
    wall = _wall_colour(paint)
    label = building.labels[hits.triangle]
    out = np.tile(wall, (len(points), 1))
    for name, colour in (("floor", _any(paint)), ("ceiling", np.full(3, paint.uniform(200, 250))), ("facade", _any(paint))):
        out[label == SURFACES.index(name)] = colour
    _paint_things(building, hits, out, paint)
    on_wall = np.isin(label, [SURFACES.index("wall"), SURFACES.index("column")])
    for r, room in enumerate(building.rooms):
        rows = np.flatnonzero(on_wall & (rooms == r))
        out[rows] = _wall(points[rows] - [0, 0, room.floor], np.asarray(room.polygon, float), wall, paint)
    _paint_doors(building, hits, points, out, wall, paint)
    return _lit(out, points, rooms, hits, kind, rng)


def _wall_colour(rng: np.random.Generator) -> Array:
    """Mostly nearly white or grey, sometimes anything."""
    if rng.random() < 0.2:
        return _any(rng)
    return np.clip(rng.uniform(150, 240) + rng.normal(0, 8, 3), 0, 255)


def _any(rng: np.random.Generator) -> Array:
    if rng.random() < 0.4:  # wood
        return np.clip(rng.uniform(0.5, 1.2) * np.array([170.0, 120.0, 75.0]) + rng.normal(0, 12, 3), 5, 250)
    return np.clip(rng.uniform(30, 230) + rng.normal(0, 35, 3), 5, 250)


def _paint_things(building: Building, hits: Hits, out: Array, rng: np.random.Generator) -> None:
    """One colour for each thing."""
    colours = np.array([_any(rng) for _ in range(len(building.things) + 1)])
    thing = building.thing_of[hits.triangle]
    out[thing >= 0] = colours[thing[thing >= 0]]


def _wall(points: Array, polygon: Array, base: Array, rng: np.random.Generator) -> Array:
    """(n, 3) colours of points on the walls of a room, heights above its floor."""
    own = _any(rng) if rng.random() < ACCENT else np.clip(base + rng.normal(0, 5, 3), 0, 255)
    out = np.tile(own, (len(points), 1))
    below, lower = float(rng.uniform(0.8, 1.4)), _any(rng)
    if rng.random() < WAINSCOT:
        out[points[:, 2] < below] = lower
    if rng.random() < SKIRTING:
        out[points[:, 2] < rng.uniform(0.06, 0.12)] = _any(rng)
    rough, grain = rng.random() < ROUGH, float(rng.uniform(0.1, 0.4))
    if rough and len(points):  # bricks, wood chips: patches of other brightness
        cell = np.floor(points / grain).astype(np.int64)
        mixed = (cell @ np.array([73856093, 19349663, 83492791])) % 251 / 250 - 0.5
        out = out * (1 + float(rng.uniform(0.1, 0.35)) * mixed[:, None])
    for start, end in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        length = float(np.hypot(*(end - start)))
        along = (end - start) / max(length, 1e-9)
        at = points[:, :2] - start
        t, off = at @ along, np.abs(at @ (-along[1], along[0]))
        for count, tall in ((rng.poisson(POSTERS * length), False), (rng.poisson(PANELS * length), True)):
            for _ in range(count):
                middle, half = rng.uniform(0, length), rng.uniform(0.15, 0.8)
                low, high = (0.0, rng.uniform(1.8, 2.3)) if tall else np.sort(rng.uniform(0.6, 2.3, 2))
                colour = _any(rng)
                inside = (np.abs(t - middle) < half) & (off < ON_WALL) & (points[:, 2] > low) & (points[:, 2] < high)
                out[inside] = colour
    return out


def _paint_doors(building: Building, hits: Hits, points: Array, out: Array, wall: Array, rng: np.random.Generator) -> None:
    """Leaves, and the frames around them."""
    usual = np.clip(wall + rng.normal(0, 4, 3), 0, 255) if rng.random() < LIKE_WALL else _any(rng)
    framed, frame_of = rng.random() < 0.8, int(rng.integers(3))
    frame = (usual, wall, _any(rng))[frame_of]
    thing = building.thing_of[hits.triangle]
    leaf_of = np.where(thing >= 0, building.things["door"][thing], -1) if len(building.things) else thing
    on_wall = building.labels[hits.triangle] == SURFACES.index("wall")
    for d, door in enumerate(building.doors):
        leaf = _any(rng) if rng.random() < OTHER_LEAF else usual
        out[leaf_of == d] = leaf
        if not framed or door["state"] == "none":
            continue
        normal = np.array([np.cos(door["direction"]), np.sin(door["direction"])])
        at = points - door["centre"]
        across, beside = np.abs(at[:, :2] @ normal), np.abs(at[:, :2] @ (-normal[1], normal[0]))
        around = (across < door["thickness"] / 2 + 0.05) & (beside < door["width"] / 2 + FRAME / 2)
        around &= (at[:, 2] > -0.05) & (at[:, 2] < door["height"] + FRAME / 2)
        out[on_wall & around] = frame


def _lit(out: Array, points: Array, rooms: Array, hits: Hits, kind: str, rng: np.random.Generator) -> Array:
    """Under the light of a room and with the exposure of each view, as bytes."""
    light = rng.uniform(0.6, 1.1, int(rooms.max(initial=-1)) + 2)[rooms]
    for _ in range(LIGHT_WAVES):
        wave = rng.normal(size=3) * np.array([1, 1, 0.7]) * 2 * np.pi / rng.uniform(2.0, 9.0)
        light = light * (1 + rng.uniform(0, 0.12) * np.sin(points @ wave + rng.uniform(0, 2 * np.pi)))
    light = light * np.exp(rng.normal(0, 0.06, int(hits.pose.max(initial=0)) + 1))[hits.pose]
    if kind == "intensity":
        grey = out @ np.array([0.45, 0.35, 0.2]) * (0.4 + 0.6 * hits.cosine)
        far = np.clip(hits.ranges / FALLOFF, 0.5, None) ** rng.uniform(-1.0, 0.2)
        out, light = np.repeat((grey * far)[:, None], 3, axis=1), np.ones(len(out))
        out = out * (1 + rng.normal(0, rng.uniform(0.03, 0.12), (len(out), 1)))
    else:
        out = out * light[:, None] + rng.normal(0, rng.uniform(2, 10), out.shape)
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)
