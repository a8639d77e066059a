"""From plans to a building: walls with thickness, openings, slabs, stairs, and what is fitted and stands in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import shapely
from topomerge.datasets.buildings import fittings
from topomerge.datasets.buildings.openings import (
    RoomCells,
    WallOpening,
    build_openings,
    build_storey_spaces,
    build_true_doors,
    build_true_room,
    compute_footprint,
    cut_niches,
    number_spaces,
)
from topomerge.datasets.buildings.stairs import build_staircase
from topomerge.datasets.core.building import LEVEL_DTYPE, STAIR_DTYPE, SURFACES, Building, Difficulty, Plan, check_plan
from topomerge.datasets.core.solids import Prism, TriangleSoup, build_boundary

from topomerge.errors import InputError
from topomerge.types import Array

OUTDOORS = 8.0  # m of outdoor space that is modelled around a building


def build_building(
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
        InputError: no plans, or one that no building could have (`check_plan`), or a stair too steep (`build_staircase`).
    """
    difficulty = difficulty or Difficulty()
    seed = int(rng) if isinstance(rng, int | np.integer) else -1
    rng = np.random.default_rng(rng)
    if not plans:
        raise InputError(f"{name}: no storeys")
    for k, plan in enumerate(plans):
        check_plan(plan, f"{name} storey {k}")
    floors = np.concatenate([[0.0], np.cumsum([p.height for p in plans])])
    spaces = [s for k in range(len(plans)) for s in build_storey_spaces(plans, k, float(floors[k]), difficulty, rng)]
    spaces = number_spaces(spaces)
    holes = [h for k, plan in enumerate(plans) for h in build_openings(plan, k, spaces, difficulty, rng)]
    stairs, wells, soup = _build_stairs(plans, floors, spaces)
    hollows, niches = cut_niches(spaces, holes, difficulty.niches, rng)
    _add_shell(spaces, holes, [*wells, *hollows], floors, soup)
    doors = build_true_doors(holes, spaces, difficulty, rng)
    things = fittings.add_fittings(soup, plans, spaces, holes, doors, stairs, difficulty, rng)
    vertices, triangles, labels, thing_of = soup.build_arrays()
    levels = np.zeros(len(plans), LEVEL_DTYPE)
    levels["floor"], levels["ceiling"] = floors[:-1], [z + p.ceiling for z, p in zip(floors, plans, strict=False)]
    recorded = {"difficulty": asdict(difficulty), **(parameters or {})}
    rooms = tuple(build_true_room(s) for s in spaces if s.room >= 0)
    return Building(
        name, kind, vertices, triangles, labels, thing_of, rooms, doors, stairs, levels, things, seed, recorded, niches
    )


def _build_stairs(plans: Sequence[Plan], floors: Array, spaces: list[RoomCells]) -> tuple[Array, list[Prism], TriangleSoup]:
    """Return the true stairs, the holes in the slabs, and the steps."""
    rows, wells, soup = [], [], TriangleSoup()
    for k, plan in enumerate(plans[:-1]):
        for flight in plan.flights:
            built = build_staircase(flight, float(plan.height))
            path = built.path + [0, 0, floors[k]]
            rooms = [_find_room(path[i, :2], k + up, spaces) for i, up in ((0, 0), (-1, 1))]
            if None in rooms:
                raise InputError(f"storey {k}: the {flight.kind} stair at {flight.corner} ends in no room")
            low = min(s.ceiling for s in spaces if s.room == rooms[0])
            if flight.kind != "lift":
                wells.append(Prism(built.well, low, float(floors[k + 1])))
            soup.add(built.vertices + [0, 0, floors[k]], built.triangles, "stair")
            ends = (path[0], path[-1], built.footprint, built.riser, built.tread, path)
            rows.append((flight.kind, (k, k + 1), tuple(rooms), *ends))
    return np.array(rows, STAIR_DTYPE), wells, soup


def _find_room(point: Array, storey: int, spaces: list[RoomCells]) -> int | None:
    at = shapely.Point(point)
    return next((s.room for s in spaces if s.storey == storey and s.room >= 0 and s.shape.covers(at)), None)


def _add_shell(spaces: list[RoomCells], holes: list[WallOpening], wells: list[Prism], floors: Array, soup: TriangleSoup) -> None:
    """Add walls, floors, ceilings, facade and roof."""
    plans = [compute_footprint([s.shape for s in spaces if s.storey == k]) for k in range(len(floors) - 1)]
    world = shapely.box(*shapely.union_all(plans).bounds).buffer(OUTDOORS, join_style="mitre")
    roof = max(float(floors[-1]), max(s.ceiling for s in spaces) + 0.2)
    tops = [*floors[1:-1], roof]
    outside = [Prism(world.difference(p), float(z), float(t)) for p, z, t in zip(plans, floors, tops, strict=False)]
    rooms = [Prism(s.shape, s.floor, s.ceiling) for s in spaces]
    gaps = [Prism(h.box, h.bottom, h.top) for h in holes]
    faces = build_boundary([*rooms, *gaps, *wells, *outside, Prism(world, roof, roof + 1)])
    rim = np.array(world.bounds).reshape(2, 2)
    on_rim = (np.abs(faces.sides[:, :2, None, :2] - rim) < 0.01).any(axis=2).all(axis=1).any(axis=1)
    sides = faces.sides[~on_rim]
    normal = np.cross(sides[:, 1] - sides[:, 0], sides[:, 3] - sides[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    outer = _is_outdoors(sides.mean(axis=1) + 0.02 * normal, plans, floors)
    count = np.arange(len(sides))[:, None, None]
    labels = np.repeat(np.where(outer, SURFACES.index("facade"), SURFACES.index("wall")), 2)
    soup.add(sides.reshape(-1, 3), (np.array([[0, 1, 2], [0, 2, 3]]) + 4 * count).reshape(-1, 3), labels)
    ground = faces.ups[:, 0, 2] < floors[0] + 1e-3
    for flat, label, up in ((faces.ups, "floor", 0.02), (faces.downs[faces.downs[:, 0, 2] < roof + 0.5], "ceiling", -0.02)):
        centre = flat.mean(axis=1) + [0, 0, up]
        outer = _is_outdoors(centre, plans, floors)
        shown = ~(outer & ground) if label == "floor" else np.ones(len(flat), bool)
        values = np.where(outer, SURFACES.index("facade"), np.where(_is_indoors(centre, spaces), SURFACES.index(label), 0))
        at_floor = (np.abs(flat[:, 0, 2, None] - floors) < 1e-3).any(axis=1) & (label == "floor") & ~outer
        values[at_floor] = SURFACES.index("floor")
        soup.add(flat[shown].reshape(-1, 3), np.arange(3 * shown.sum()).reshape(-1, 3), values[shown])


def _is_outdoors(points: Array, plans: list[shapely.Geometry], floors: Array) -> Array:
    storey = np.clip(np.searchsorted(floors, points[:, 2], side="right") - 1, 0, len(plans) - 1)
    out = points[:, 2] > floors[-1]
    for k, plan in enumerate(plans):
        here = (storey == k) & ~out
        shapely.prepare(plan)
        out[here] = ~shapely.contains_xy(plan, points[here, :2])
    return np.asarray(out)


def _is_indoors(points: Array, spaces: list[RoomCells]) -> Array:
    """Return whether a point lies within a room's outline, at its height."""
    tree = shapely.STRtree([s.shape for s in spaces])
    point, space = tree.query(shapely.points(points[:, :2]), predicate="intersects")
    low, high = (np.array([getattr(s, w) for s in spaces]) for w in ("floor", "ceiling"))
    right = (points[point, 2] > low[space]) & (points[point, 2] < high[space])
    out = np.zeros(len(points), bool)
    out[point[right]] = True
    return out
