"""The free space of a building's rooms, and the plan of a storey out to the outer walls' faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.core.plan import Plan, PlanRoom
from topomerge.datasets.core.solids import rectangle

from topomerge.types import TrueRoom

OUTER_WALL = 0.3  # m, thickness of outer walls


@dataclass(frozen=True, eq=False)
class Space:
    """A room, or the void over one, as free space."""

    shape: shapely.Polygon
    plan: PlanRoom
    storey: int
    room: int  # index of the true room, -1: a void
    floor: float
    ceiling: float


def storey_spaces(plans: Sequence[Plan], k: int, floor: float, difficulty: Difficulty, rng: np.random.Generator) -> list[Space]:
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


def numbered(spaces: list[Space]) -> list[Space]:
    count, out = 0, []
    for space in spaces:
        void = space.plan.kind == "void"
        out.append(replace(space, room=-1 if void else count))
        count += not void
    return out


def true_room(space: Space) -> TrueRoom:
    ring = np.asarray(shapely.orient_polygons(space.shape).exterior.coords)[:-1]
    kind = space.plan.kind
    return TrueRoom(space.plan.name, ring, space.floor, space.ceiling - space.plan.slope / 2, space.storey, kind)


def footprint(shapes: Sequence[shapely.Geometry]) -> shapely.Geometry:
    """Plan of a storey out to the outer walls' faces; courtyards of more than 9 m2 stay open."""
    closed = shapely.union_all([s.buffer(2 * OUTER_WALL, join_style="mitre") for s in shapes]).buffer(
        -OUTER_WALL, join_style="mitre"
    )
    outlines = [
        shapely.Polygon(p.exterior, [h for h in p.interiors if shapely.Polygon(h).area > 9]) for p in shapely.get_parts(closed)
    ]
    return shapely.union_all(outlines)
