"""The same building on another day: furniture has moved or gone, doors stand differently, people stand about."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from topomerge.datasets.buildings.fittings import SWING, compute_leaf_yaw, keep_clear
from topomerge.datasets.buildings.furniture import compute_footprints, make_item
from topomerge.datasets.buildings.openings import sample_door_state
from topomerge.datasets.core.building import SURFACES, Building, Difficulty
from topomerge.datasets.core.solids import build_rotation, triangulate_boxes

from topomerge.types import Array

MOVES_TRIED = 6
SMALL_MOVE = 0.15  # m, standard deviation of a small move


def simulate_session(building: Building, difficulty: Difficulty | None = None, rng: np.random.Generator | int = 0) -> Building:
    """Return the building as another session finds it; rooms, stairs and storeys are the same.

    Args:
        difficulty: its `moved`, `gone`, `doors_moved`, `open`, `half` and `people` are used.
        rng: generator or seed.
    """
    difficulty, rng = difficulty or Difficulty(), np.random.default_rng(rng)
    things, vertices, doors = building.things.copy(), building.vertices.astype(np.float64), building.doors.copy()
    owner = np.full(len(vertices), -1)
    owner[building.triangles] = building.thing_of[:, None]
    order = np.argsort(owner, kind="stable")
    starts = np.searchsorted(owner[order], np.arange(len(things) + 1))
    gone = np.zeros(len(things), bool)
    outlines = np.array([_compute_outline(t) for t in things], object)
    for i, thing in enumerate(building.things):
        if not thing["movable"] or thing["kind"] == "leaf":
            continue
        fate = rng.random()
        gone[i] = fate < difficulty.gone
        if difficulty.gone <= fate < difficulty.gone + 2 * difficulty.moved:
            near = fate >= difficulty.gone + difficulty.moved
            _move(building, things, outlines, gone, i, near, rng)
    _move_doors(things, doors, difficulty, rng)
    for i in np.flatnonzero(things["movable"] & ~gone).tolist():
        _carry(vertices, order[starts[i] : starts[i + 1]], building.things[i], things[i])
    stays = (building.thing_of < 0) | ~gone[building.thing_of]
    mesh = [vertices, building.triangles[stays], building.labels[stays], building.thing_of[stays]]
    things = _add_people(building, mesh, things, outlines[~gone], difficulty, rng)
    vertices, triangles, labels, thing_of = mesh
    return replace(
        building,
        vertices=vertices.astype(np.float32),
        triangles=triangles,
        labels=labels,
        thing_of=thing_of,
        things=things,
        doors=doors,
    )


def _compute_outline(thing: Array) -> shapely.Polygon:
    return shapely.Polygon(compute_footprints(thing["centre"][None, :2], thing["yaw"][None], thing["size"].tolist())[0])


def _move(building: Building, things: Array, outlines: Array, gone: Array, i: int, near: bool, rng: np.random.Generator) -> None:
    """Move a thing by a little, or anywhere in its room, if there is a place for it."""
    room = shapely.Polygon(building.rooms[things["room"][i]].polygon)
    low, high = np.array(room.bounds).reshape(2, 2)
    clear = [] if near else keep_clear(int(things["room"][i]), building.doors, building.stairs)
    others = outlines[(things["room"] == things["room"][i]) & ~gone & (np.arange(len(things)) != i)]
    for _ in range(MOVES_TRIED):
        new = things[i : i + 1].copy()[0]
        new["centre"][:2] = new["centre"][:2] + rng.normal(0, SMALL_MOVE, 2) if near else rng.uniform(low, high)
        new["yaw"] += rng.normal(0, 0.1) if near else rng.integers(4) * np.pi / 2
        outline = _compute_outline(new)
        if room.contains(outline) and not shapely.intersects([*others, *clear], outline).any():
            new["pivot"] = new["centre"][:2]
            things[i], outlines[i] = new, outline
            return


def _move_doors(things: Array, doors: Array, difficulty: Difficulty, rng: np.random.Generator) -> None:
    """Open and shut some of the doors."""
    moved = (rng.random(len(doors)) < difficulty.doors_moved) & (doors["state"] != "none")
    for d in np.flatnonzero(moved):
        outer = doors["rooms"][d].min() < 0
        doors["state"][d] = "shut" if outer else sample_door_state(difficulty, rng)
        angle = float(rng.uniform(*SWING[str(doors["state"][d])]))
        for i in np.flatnonzero((things["door"] == d) & (things["kind"] == "leaf")):
            yaw = compute_leaf_yaw(doors[d], things["pivot"][i], angle)
            reach = things["size"][i, 0] / 2 * np.array([np.cos(yaw), np.sin(yaw)])
            things["yaw"][i], things["centre"][i, :2] = yaw, things["pivot"][i] + reach


def _carry(vertices: Array, rows: Array, old: Array, new: Array) -> None:
    turn = build_rotation(float(new["yaw"] - old["yaw"]))
    vertices[rows, :2] = (vertices[rows, :2] - old["centre"][:2]) @ turn + new["centre"][:2]


def _add_people(
    building: Building, mesh: list[Array], things: Array, outlines: Array, difficulty: Difficulty, rng: np.random.Generator
) -> Array:
    """Put persons on free spots of the rooms; return the things with them."""
    tree = shapely.STRtree(outlines.tolist())
    stairs = [shapely.Polygon(s["footprint"]) for s in building.stairs]
    rows: list[Any] = []
    for index, room in enumerate(building.rooms):
        shape = shapely.Polygon(room.polygon)
        low, high = np.array(shape.bounds).reshape(2, 2)
        for _ in range(int(rng.poisson(difficulty.people)) if room.kind != "lift" else 0):
            item, yaw = make_item("person", rng), float(rng.uniform(0, 2 * np.pi))
            bodies = shapely.points(rng.uniform(low, high, (MOVES_TRIED, 2)))
            bodies = bodies[shapely.contains(shape, bodies) & (shapely.distance(shape.exterior, bodies) > 0.3)]
            bodies = [b for b in bodies if not len(tree.query(b, "dwithin", 0.3)) and all(b.distance(s) > 0.3 for s in stairs)]
            if not bodies:
                continue
            at = shapely.get_coordinates(bodies[0])[0]
            vertices, triangles = triangulate_boxes(item.parts, np.array([*at, room.floor]), yaw)
            mesh[1] = np.concatenate([mesh[1], (triangles + len(mesh[0])).astype(np.int32)])
            mesh[0] = np.concatenate([mesh[0], vertices])
            mesh[2] = np.append(mesh[2], np.full(len(triangles), SURFACES.index("person"), np.uint8))
            mesh[3] = np.append(mesh[3], np.full(len(triangles), len(things) + len(rows), np.int32))
            centre = (*at, room.floor + item.size[2] / 2)
            rows.append(("person", index, -1, centre, item.size, yaw, tuple(at), True))
    return np.concatenate([things, np.array(rows, things.dtype)])
