"""Sibling storeys of real plans made into one building: registered over each other, with stairs where both have a stairwell.

Plans of one survey share a frame (RMF levels, malls); those of the campus plans were each drawn in a frame and scale of their
own. These are registered: hypotheses from stairwells, lifts and outer walls are compared by how well the walls of the two storeys
lie over each other, and refined by iterated nearest points (Besl and McKay 1992) over scale and shift. Siblings are drawn the
same way up: plans are not turned. The scale of the plan whose stairwells are nearer to a usual size holds for both.

Beside a building: another wing with nearly the same plan, its ends longer or shorter, half of the time mirrored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import shapely
from scipy.spatial import cKDTree
from topomerge.datasets.buildings.stairs import add_stairs
from topomerge.datasets.core.building import Building, Opening, Plan, Wall
from topomerge.datasets.plans.floorplans import Refusal, group_siblings, iter_plans, map_plans_to_frames, remove_dead_flights

from topomerge.errors import InputError
from topomerge.types import Array

END_SHARE = (0.15, 0.35)  # share of the building's length that an end takes
END_STRETCH = (0.1, 0.3)  # by which an end is longer, or shorter
SLOPE_STEP = 1e-3  # m, step of the slope of the map

Place = Callable[[Array], Array]


def make_twin_wing(building: Building, rng: np.random.Generator | int = 0) -> Building:
    """Make a wing that is hard to tell from the building: the same rooms, in the same order, in nearly the same places.

    Along its longer side, one of its ends or both are stretched or shrunk by `END_STRETCH`, with all that stands in them: end
    walls move by metres, doors with them. Half of the twins are mirrored, too.

    Args:
        rng: generator or seed.
    """
    rng = np.random.default_rng(rng)
    corners = np.concatenate([room.polygon for room in building.rooms])
    low, high = corners.min(axis=0), corners.max(axis=0)
    axis = int(np.argmax(high - low))
    knots = np.array(
        [low[axis], *(rng.uniform(*END_SHARE, 2) * (1, -1) * (high - low)[axis] + (low[axis], high[axis])), high[axis]]
    )
    factors = np.exp(rng.choice([-1, 1], 2) * np.log1p(rng.uniform(*END_STRETCH, 2)))
    if rng.random() < 0.5:
        factors[int(rng.integers(2))] = 1.0
    mirrored = bool(rng.random() < 0.5)
    return stretch_building(building, axis, _build_piecewise_map(knots, (float(factors[0]), 1.0, float(factors[1]))), mirrored)


def _build_piecewise_map(knots: Array, slopes: tuple[float, float, float]) -> Place:
    """Build a continuous map of a coordinate with a slope before, between and after the two inner knots."""

    def place(x: Array) -> Array:
        middle = np.clip(x, knots[1], knots[2])
        return np.asarray(middle + slopes[0] * np.minimum(x - knots[1], 0) + slopes[2] * np.maximum(x - knots[2], 0))

    return place


def stretch_building(building: Building, axis: int, place: Place, mirrored: bool = False) -> Building:
    """Return the building with one horizontal coordinate mapped by an increasing function, then perhaps mirrored (x -> -x)."""

    def move(points: Array) -> Array:
        out = np.array(points, np.float64)
        out[..., axis] = place(out[..., axis])
        if mirrored:
            out[..., 0] *= -1
        return out

    def slope(points: Array) -> Array:
        x = np.asarray(points, np.float64)[..., axis]
        return (place(x + SLOPE_STEP) - place(x - SLOPE_STEP)) / (2 * SLOPE_STEP)

    turn = -1 if mirrored else 1
    doors, stairs, things = building.doors.copy(), building.stairs.copy(), building.things.copy()
    across = np.stack([np.cos(doors["direction"]), np.sin(doors["direction"])], axis=1)  # of the wall
    along = np.abs(across[:, 1 - axis])  # share of the wall's own direction that the map stretches
    factor = slope(doors["centre"])
    doors["width"] *= np.hypot(along * factor, across[:, axis])
    doors["thickness"] *= np.hypot(across[:, axis] * factor, along)
    doors["direction"] = (turn * doors["direction"]) % np.pi
    doors["centre"] = move(doors["centre"])
    for name in ("lower", "upper", "path"):
        stairs[name] = move(stairs[name])
    footprint = move(stairs["footprint"])
    stairs["footprint"] = footprint[:, ::-1] if mirrored else footprint
    heading = np.stack([np.cos(things["yaw"]), np.sin(things["yaw"])], axis=1)
    factor = slope(things["centre"])
    things["size"][:, 0] *= np.hypot(heading[:, axis] * factor, heading[:, 1 - axis])
    things["size"][:, 1] *= np.hypot(heading[:, 1 - axis] * factor, heading[:, axis])
    things["centre"], things["pivot"] = move(things["centre"]), move(things["pivot"])
    things["yaw"] = np.pi * mirrored + turn * things["yaw"]
    return replace(
        building,
        vertices=move(building.vertices).astype(np.float32),
        triangles=building.triangles[:, ::turn].copy(),
        rooms=tuple(replace(room, polygon=move(room.polygon)[::turn].copy()) for room in building.rooms),
        doors=doors,
        stairs=stairs,
        things=things,
    )


SAMPLE = 0.25  # m between points along walls
WALL_NEAR = 0.5  # m; walls that lie over each other
DRAWN_WALLS = 0.55  # least share of the walls, where the storeys overlap, that do
SURVEYED_WALLS = 0.4  # least share of walls where the frame is known to be the same
COVER = 0.75  # least share of the smaller storey that lies over the larger one
STOREY_SCALES = (0.35, 2.9)  # of one plan by the other
SHAFTS = 7  # largest stairwells and lifts that hypotheses are made of
STAIRWELL = 18.0  # m2, usual
SAME_OUTLINE = 0.8  # IoU of two rooms, above each other, of the same plan


@dataclass(frozen=True)
class Fit:
    """How a storey lies over the one beneath: `scale` and `shift` take its own frame there.

    Args:
        walls: share of the walls within `WALL_NEAR` of a wall of the other storey, where the two overlap.
        cover: share of the smaller storey's area that lies over the larger one.
        common: the two plans had the same frame.
    """

    scale: float
    shift: tuple[float, float]
    walls: float
    cover: float
    common: bool


@dataclass(frozen=True, eq=False)
class Stack:
    """Plans of one building, lowest storey first, in one frame, ready for `build_building`.

    Args:
        fits: of each storey but the lowest one.
        stairs: number of flights between each two storeys; 0: nothing joins them on foot.
    """

    names: tuple[str, ...]
    plans: tuple[Plan, ...]
    fits: tuple[Fit, ...]
    stairs: tuple[int, ...]


def iter_stacks(folder: str | Path, plans: dict[str, Plan | Refusal] | None = None) -> Iterator[tuple[str, Stack | Refusal]]:
    """Yield every two neighbouring sibling storeys of a folder as a stack, or why they are none; names are joined by " + ".

    Args:
        plans: of `iter_plans`, where they are known already.

    Raises:
        InputError: no such folder.
    """
    plan_of = dict(iter_plans(folder)) if plans is None else plans
    frames = map_plans_to_frames(folder)
    for group in group_siblings(folder):
        for names in pairwise(group):
            storeys = [plan_of.get(name) for name in names]
            refused = [n for n, p in zip(names, storeys, strict=True) if not isinstance(p, Plan)]
            name = " + ".join(names)
            try:
                if refused:
                    raise InputError(f"a storey is missing or was refused: {', '.join(refused)}")
                common = frames[names[0]] == frames[names[1]]
                yield name, stack_storeys([p for p in storeys if isinstance(p, Plan)], names, common)
            except InputError as error:
                yield name, Refusal(name, str(error))


def stack_storeys(plans: Sequence[Plan], names: Sequence[str] = (), common: bool = False) -> Stack:
    """Put plans over each other, lowest first.

    Args:
        common: they are in one frame already, which is checked; otherwise they are registered.

    Raises:
        InputError: fewer than two plans, or two that do not lie over each other.
    """
    if len(plans) < 2:
        raise InputError("a stack needs two storeys or more")
    names = tuple(names) or tuple(f"storey {k}" for k in range(len(plans)))
    fits = [register(low, high, common) for low, high in pairwise(plans)]
    least = SURVEYED_WALLS if common else DRAWN_WALLS
    for fit, name in zip(fits, names[1:], strict=True):
        if fit.walls < least or fit.cover < COVER:
            raise InputError(
                f"storeys do not fit: {fit.walls:.0%} of the walls of {name} lie over walls ({least:.0%} are wanted), "
                f"{fit.cover:.0%} of its floor over floor ({COVER:.0%})"
            )
    placed, scale, shift = [plans[0]], 1.0, np.zeros(2)
    for plan, fit in zip(plans[1:], fits, strict=True):
        shift, scale = scale * np.array(fit.shift) + shift, scale * fit.scale
        placed.append(transform_plan(plan, scale, shift))
    if not common:
        unit = _estimate_unit(plans, placed)
        placed = [transform_plan(plan, unit, np.zeros(2)) for plan in placed]
    built, stairs = add_stairs(remove_dead_flights(placed))
    return Stack(names, tuple(built), tuple(fits), stairs)


def _estimate_unit(plans: Sequence[Plan], placed: Sequence[Plan]) -> float:
    """Estimate the factor for all: the scale of the plan whose stairwells (whose storey, if there are none) are nearest to a
    usual size."""
    best, factor = np.inf, 1.0
    for plan, now in zip(plans, placed, strict=True):
        wells = [_build_polygon(r).area for r in plan.rooms if r.kind == "stairs"]
        if wells and abs(np.log(np.median(wells) / STAIRWELL)) < best:
            best = abs(float(np.log(np.median(wells) / STAIRWELL)))
            factor = float(np.sqrt(_build_polygon(plan.rooms[0]).area / _build_polygon(now.rooms[0]).area))
    return round(factor, 4)


def transform_plan(plan: Plan, scale: float, shift: Array) -> Plan:
    """Return a plan scaled, then shifted. Doors keep their width (in a shrinking plan they shrink to 0.7 m), walls their
    thickness."""

    def place(points: Array) -> Array:
        return np.round(np.asarray(points, float) * scale + shift, 4)

    def wall(w: Wall) -> Wall:
        start, end = place(np.array([w.start, w.end])).tolist()
        return replace(w, start=tuple(start), end=tuple(end))

    def opening(o: Opening) -> Opening:
        ends = np.array([o.start, o.end], float)
        width = float(np.hypot(*(ends[1] - ends[0])))
        requested = width if o.kind == "window" and scale > 1 else min(width, max(width * scale, 0.7))
        middle = ends.mean(axis=0) * scale + shift
        a, b = np.round(middle + (ends - ends.mean(axis=0)) * requested / width, 4).tolist()
        return replace(o, start=tuple(a), end=tuple(b), thickness=round(o.thickness * max(scale, 1.0), 3))

    if scale == 1 and not np.any(shift):
        return plan
    return replace(
        plan,
        rooms=tuple(replace(room, polygon=place(room.polygon)) for room in plan.rooms),
        walls=tuple(wall(w) for w in plan.walls),
        openings=tuple(opening(o) for o in plan.openings if o.start != o.end),
        flights=tuple(replace(f, corner=tuple(place(np.array(f.corner)).tolist())) for f in plan.flights if scale == 1),
    )


def register(low: Plan, high: Plan, common: bool = False) -> Fit:
    """Register the plan `high` over the plan `low` by the best of all hypotheses; with a common frame only that one."""
    target, source = _StoreyShape.from_plan(low), _StoreyShape.from_plan(high)
    if common:
        return _fit(target, source, 1.0, np.zeros(2), True)
    guesses = np.array(list(_iter_hypotheses(target, source)))
    rough = [_score(target, source, g[0], g[1:], 8) for g in guesses]
    best = sorted(np.argsort(rough)[::-1][:12].tolist())
    refined = [_refine(target, source, *guesses[i]) for i in best]
    scale, x, y = max(refined, key=lambda g: _score(target, source, g[0], np.array(g[1:]), 2))
    return _fit(target, source, round(scale, 4), np.round([x, y], 3), False)


@dataclass(frozen=True, eq=False)
class _StoreyShape:
    points: Array  # (n, 2) along the walls
    tree: cKDTree
    floor: shapely.Geometry
    shafts: list[tuple[str, float, Array]]  # kind, area, middle; largest first

    @classmethod
    def from_plan(cls, plan: Plan) -> _StoreyShape:
        shapes = [_build_polygon(room) for room in plan.rooms]
        rings = [s.exterior for s in shapes]
        points = np.concatenate([shapely.get_coordinates(shapely.segmentize(ring, SAMPLE)) for ring in rings])
        floor = shapely.union_all([s.buffer(0.4, join_style="mitre") for s in shapes]).simplify(0.2)
        shafts = [
            (r.kind, s.area, shapely.get_coordinates(s.centroid)[0])
            for r, s in zip(plan.rooms, shapes, strict=True)
            if r.kind in ("stairs", "lift")
        ]
        return cls(points, cKDTree(points), floor, sorted(shafts, key=lambda shaft: -shaft[1])[:SHAFTS])


def _build_polygon(room: object) -> shapely.Polygon:
    return shapely.Polygon(room.polygon)  # type: ignore[attr-defined]


def _iter_hypotheses(target: _StoreyShape, source: _StoreyShape) -> Iterator[tuple[float, float, float]]:
    """Yield the scale and shift from: nothing, two shafts of each, one shaft and its size, the corners of the boxes around."""
    yield 1.0, 0.0, 0.0
    shafts = [(a, b) for a, b in product(target.shafts, source.shafts) if a[0] == b[0]]
    low, high = (np.array(s.floor.bounds).reshape(2, 2) for s in (target, source))
    sizes = (low[1] - low[0]) / (high[1] - high[0])
    for (_, area, at), (_, other, other_place) in shafts:
        for scale in (1.0, float(np.sqrt(area / other)), *sizes.tolist()):
            if STOREY_SCALES[0] <= scale <= STOREY_SCALES[1]:
                yield scale, *(at - scale * other_place).tolist()
    for (a, b), (c, d) in product(shafts, shafts):
        v, w = c[2] - a[2], d[2] - b[2]
        if a is c or b is d or min(np.hypot(*v), np.hypot(*w)) < 3:
            continue
        scale = float(np.hypot(*v) / np.hypot(*w))
        if STOREY_SCALES[0] <= scale <= STOREY_SCALES[1] and v @ w > 0.985 * np.hypot(*v) * np.hypot(*w):
            yield scale, *((a[2] + c[2]) / 2 - scale * (b[2] + d[2]) / 2).tolist()
    for scale in (1.0, float(sizes[0]), float(sizes[1]), float(np.sqrt(sizes.prod()))):
        for i, j in product((0, 1), repeat=2):
            corner = np.array([low[i, 0], low[j, 1]]) - scale * np.array([high[i, 0], high[j, 1]])
            yield scale, *corner.tolist()


def _refine(target: _StoreyShape, source: _StoreyShape, scale: float, x: float, y: float) -> tuple[float, float, float]:
    points, shift = source.points[::2], np.array([x, y])
    for reach in np.geomspace(1.5, WALL_NEAR, 12):
        apart, nearest = target.tree.query(scale * points + shift)
        p, q = points[apart < reach], target.points[nearest[apart < reach]]
        if len(p) < 20:
            break
        a, b = p - p.mean(axis=0), q - q.mean(axis=0)
        scale = float(np.clip((a * b).sum() / (a * a).sum(), *STOREY_SCALES))
        shift = q.mean(axis=0) - scale * p.mean(axis=0)
    return scale, float(shift[0]), float(shift[1])


def _score(target: _StoreyShape, source: _StoreyShape, scale: float, shift: Array, step: int = 1) -> float:
    walls, cover = _measure_overlay(target, source, scale, shift, step)
    return walls * min(cover / COVER, 1.0)


def _measure_overlay(
    target: _StoreyShape, source: _StoreyShape, scale: float, shift: Array, step: int = 1
) -> tuple[float, float]:
    """Return the shares of walls over walls, and of floor over floor."""
    near = WALL_NEAR * min(
        scale, 1.0
    )  # a plan that shrinks has more walls a metre, so that more of them lie near others by chance
    floor = shapely.transform(source.floor, lambda p: p * scale + shift)
    common = floor.intersection(target.floor)
    cover = common.area / min(floor.area, target.floor.area)
    if cover < 0.3:
        return 0.0, float(cover)
    shapely.prepare(common)
    points = source.points[::step] * scale + shift
    points = points[shapely.contains_xy(common, points)]
    others = target.points[::step]
    others = others[shapely.contains_xy(common, others)]
    if min(len(points), len(others)) < 10:
        return 0.0, float(cover)
    over = target.tree.query(points, distance_upper_bound=near)[0] < near
    under = source.tree.query((others - shift) / scale, distance_upper_bound=near / scale)[0] < near / scale
    return float(over.mean() + under.mean()) / 2, float(cover)


def _fit(target: _StoreyShape, source: _StoreyShape, scale: float, shift: Array, common: bool) -> Fit:
    walls, cover = _measure_overlay(target, source, scale, np.asarray(shift))
    return Fit(float(scale), (float(shift[0]), float(shift[1])), round(walls, 3), round(cover, 3), common)


def count_matching_rooms(low: Plan, high: Plan) -> int:
    """Count the rooms of one storey that lie over a room of the same outline (IoU above `SAME_OUTLINE`)."""
    a, b = ([_build_polygon(r) for r in plan.rooms if r.kind != "lift"] for plan in (low, high))
    i, j = shapely.STRtree(b).query(a, predicate="intersects")
    one, other = np.array(a)[i], np.array(b)[j]
    both = shapely.area(shapely.intersection(one, other))
    return len(np.unique(i[both > SAME_OUTLINE * (shapely.area(one) + shapely.area(other) - both)]))
