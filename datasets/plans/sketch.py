"""What every reader of plans ends with: shapes, walls and openings in metres, y up, made into a checked `Plan`.

A reader collects a `Sketch`; `finish` insets the rooms where walls have no lines of their own, cuts holes open, keeps the
largest part that doors connect, and refuses what no building could have. The reason of a refusal starts with a few fixed
words and a colon, so that refusals can be counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from topomerge.datasets.core.plan import MAX_DOOR, MIN_AREA, MIN_DOOR, Flight, Opening, Plan, PlanRoom, Wall, check_plan
from topomerge.datasets.core.solids import rectangle
from topomerge.datasets.plans.doors import sides

from topomerge.errors import InputError
from topomerge.types import Array

SKETCH_OVERLAP = 0.02  # share of the smaller room
MIN_TOTAL, MAX_TOTAL = 8.0, 60_000.0  # m2 of a storey's rooms
NARROWEST_DOORS, WIDEST_DOORS = 0.5, 3.5  # m, plausible median width of a storey's doors
SLIT = 2e-4  # m, width of the cut from a hole to the outline: below the grid of `solids`, which closes it again
TOLERANCE = 0.02  # m, of simplified outlines
MIN_SHARE = 0.5  # of the floor that the largest connected part must hold


@dataclass(eq=False)
class Sketch:
    """A storey while it is being read.

    Args:
        names, kinds, shapes: of the rooms; shapes are shapely polygons, m, y up, holes allowed.
        walls: with a thickness of their own; they are cut out of the shapes.
        openings, ends: each opening and the two rooms (indices, -1: outside) that it joins.
        inset: m, half the thickness of walls that have no lines: taken off each shape all around.
        notes: what was changed or left out.
    """

    names: list[str] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    shapes: list[shapely.Polygon] = field(default_factory=list)
    walls: list[Wall] = field(default_factory=list)
    openings: list[Opening] = field(default_factory=list)
    ends: list[tuple[int, int]] = field(default_factory=list)
    flights: list[Flight] = field(default_factory=list)
    inset: float = 0.0
    height: float = 3.2
    ceiling: float = 2.7
    notes: list[str] = field(default_factory=list)

    def add_room(self, name: str, kind: str, shape: shapely.Polygon) -> int:
        """Index of the new room."""
        self.names.append(name)
        self.kinds.append(kind)
        self.shapes.append(shape)
        return len(self.shapes) - 1

    def add_opening(self, opening: Opening, ends: tuple[int, int]) -> None:
        """Keep an opening that joins two different spaces; one that a person can't pass is no door but stays a window."""
        if ends[0] != ends[1]:
            self.openings.append(opening)
            self.ends.append(ends)


def check_size(path: Path, limit: int, what: str = "plan") -> None:
    """Refuse a file that is too large to be what it should be.

    Args:
        limit: bytes.

    Raises:
        InputError: with the size.
    """
    if path.stat().st_size > limit:
        raise InputError(f"absurd size: {path.stat().st_size} bytes for one {what}")


def read_limited(path: Path, limit: int, what: str = "plan") -> bytes:
    """The bytes of a file that has at most `limit` of them (`check_size`)."""
    check_size(path, limit, what)
    return path.read_bytes()


def finish(sketch: Sketch) -> tuple[Plan, list[str]]:
    """A checked plan and notes on what was changed.

    Raises:
        InputError: for the reasons listed in `floorplans`.
    """
    notes = list(sketch.notes)
    shapes = [_solid(shape, name) for shape, name in zip(sketch.shapes, sketch.names, strict=True)]
    if sketch.inset:
        shapes = [_largest(shape.buffer(-sketch.inset, join_style="mitre")) for shape in shapes]
    solid = shapely.union_all([rectangle(w.start, w.end, w.thickness) for w in sketch.walls if not w.glass])
    shapes = [_largest(shape.difference(solid).simplify(TOLERANCE)) for shape in shapes]
    _check_overlap(shapes, sketch.names)
    passable = _check_doors(sketch) & _verified(sketch, shapes)
    connected = _connected(sketch, shapes, passable)
    stays = np.array([_stays(ends, connected) for ends in sketch.ends], bool)
    walked = np.array([opening.kind != "window" for opening in sketch.openings], bool)
    lost = int((stays & walked & ~passable).sum())
    if lost:
        notes.append(f"left out {lost} doors that are too narrow or too wide or do not lead where they should")
    if int(connected.sum()) < len(shapes):
        notes.append(f"kept {int(connected.sum())} of {len(shapes)} rooms: the largest part that doors connect")
    _check_scale([shape for shape, keep in zip(shapes, connected, strict=True) if keep])
    rooms = tuple(
        PlanRoom(name, outline(shape), kind)
        for name, kind, shape, keep in zip(sketch.names, sketch.kinds, shapes, connected, strict=True)
        if keep
    )
    openings = tuple(o for o, good in zip(sketch.openings, stays & (passable | ~walked), strict=True) if good)
    plan = Plan(rooms, tuple(sketch.walls), openings, tuple(sketch.flights), height=sketch.height, ceiling=sketch.ceiling)
    try:
        check_plan(plan, "check")
    except InputError as error:
        raise InputError(f"not a plan: {error}") from error
    return plan, notes


def outline(shape: shapely.Polygon) -> Array:
    """(k, 2) outline, counter-clockwise, not closed; holes are joined to it by a slit that is too thin to see."""
    while shape.interiors:
        ring = shape.interiors[0]
        others = shapely.union_all([shape.exterior, *list(shape.interiors)[1:]])
        cut = _cut(shape, shapely.shortest_line(shapely.Polygon(ring), others))
        if cut is None or len(cut.interiors) >= len(shape.interiors):
            raise InputError("room with a hole: it cannot be cut open")
        shape = cut
    return np.asarray(shapely.orient_polygons(shape).exterior.coords)[:-1, :2].copy()


def _cut(shape: shapely.Polygon, slit: shapely.LineString) -> shapely.Polygon | None:
    """The shape less a thin slit, or None where that breaks it."""
    if slit.length < 1e-6:  # the hole touches the outline
        blade = slit.buffer(10 * SLIT)
    else:
        a, b = np.asarray(slit.coords)
        along = (b - a) / slit.length
        side = np.array([-along[1], along[0]]) * SLIT / 2
        a, b = a - along * SLIT, b + along * SLIT
        blade = shapely.Polygon([a - side, b - side, b + side, a + side])
    rest = shape.difference(blade)
    parts = [p for p in shapely.get_parts(rest) if p.area > 1e-3]
    return parts[0] if len(parts) == 1 and parts[0].geom_type == "Polygon" else None


def _solid(shape: shapely.Polygon, name: str) -> shapely.Polygon:
    coordinates = shapely.get_coordinates(shape)
    if len(coordinates) < 4 or not np.isfinite(coordinates).all():
        raise InputError(f"not closed: room {name!r} has no outline")
    if not shape.is_valid:
        raise InputError(f"crosses itself: the outline of room {name!r}")
    return shape


def _largest(shape: shapely.Geometry) -> shapely.Polygon:
    parts = [p for p in shapely.get_parts(shape) if p.geom_type == "Polygon"]
    best = max(parts, key=lambda p: p.area, default=shapely.Polygon())
    if any(shapely.Polygon(r).area < 0.05 for r in best.interiors):  # specks
        best = shapely.Polygon(best.exterior, [r for r in best.interiors if shapely.Polygon(r).area >= 0.05])
    return best


def overlaps(shapes: Sequence[shapely.Polygon]) -> list[tuple[int, int, float]]:
    """Pairs i < j of shapes and the share of the smaller one that lies in the other, where that is above 2 %."""
    tree = shapely.STRtree(shapes)
    first, second = tree.query(shapes, predicate="intersects")
    overlapping = []
    for i, j in zip(first.tolist(), second.tolist(), strict=True):
        if i < j:
            share = shapes[i].intersection(shapes[j]).area / max(min(shapes[i].area, shapes[j].area), 1e-9)
            if share > SKETCH_OVERLAP:
                overlapping.append((i, j, float(share)))
    return overlapping


def _check_overlap(shapes: Sequence[shapely.Polygon], names: Sequence[str]) -> None:
    for i, j, share in overlaps(shapes):
        raise InputError(f"overlapping rooms: {names[i]!r} and {names[j]!r} share {share:.0%} of the smaller")


def _check_doors(sketch: Sketch) -> Array:
    """(n,) bool: can one walk through the opening? Refuses a plan whose doors have no width or an absurd one."""
    walked = np.array([o.kind in ("door", "opening") for o in sketch.openings], bool)
    width = np.array([np.hypot(o.end[0] - o.start[0], o.end[1] - o.start[1]) for o in sketch.openings])
    if not walked.any():
        raise InputError("no doors: nothing joins the rooms")
    if (width[walked] < 0.01).all():
        raise InputError("zero-width doors: every door's ends coincide")
    median = float(np.median(width[walked & (width >= 0.01)]))
    if not NARROWEST_DOORS <= median <= WIDEST_DOORS:
        raise InputError(f"absurd scale: half of the doors are narrower than {median:.2f} m")
    return walked & (width >= MIN_DOOR) & (width <= MAX_DOOR)


def _check_scale(shapes: Sequence[shapely.Polygon]) -> None:
    total = sum(shape.area for shape in shapes)
    if not MIN_TOTAL <= total <= MAX_TOTAL:
        raise InputError(f"absurd scale: rooms of {total:.1f} m2 together, not {MIN_TOTAL:g} to {MAX_TOTAL:g} m2")


def _connected(sketch: Sketch, shapes: Sequence[shapely.Polygon], passable: Array) -> Array:
    """(R,) bool: rooms of the largest part that doors join; ties go to the larger area."""
    count = len(shapes)
    if count < 2:
        raise InputError(f"too few rooms: {count}")
    areas = np.array([shape.area for shape in shapes])
    large = areas >= MIN_AREA
    ends = np.array(sketch.ends, np.int64).reshape(-1, 2)[passable]
    ends = ends[(ends >= 0).all(axis=1)]
    ends = ends[large[ends].all(axis=1)]
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    part = connected_components(graph, directed=False)[1]
    best = np.lexsort((np.bincount(part, areas), np.bincount(part, large)))[-1]
    connected: Array = (part == best) & large
    if connected.sum() < 2:
        raise InputError(f"disconnected: no door joins two of the {count} rooms")
    share = areas[connected].sum() / areas.sum()
    if share < MIN_SHARE:
        raise InputError(f"disconnected: the largest part that doors join holds {share:.0%} of the floor")
    return connected


def _verified(sketch: Sketch, shapes: Sequence[shapely.Polygon]) -> Array:
    """(n,) bool: does one find the two rooms of an opening on its two sides?"""
    joined_rooms = sides(
        np.array([o.start for o in sketch.openings]),
        np.array([o.end for o in sketch.openings]),
        shapes,
        np.array([o.thickness / 2 + 0.3 for o in sketch.openings]),
    )
    wanted = np.array(sketch.ends, np.int64).reshape(-1, 2)
    good: Array = (np.sort(joined_rooms, axis=1) == np.sort(wanted, axis=1)).all(axis=1)
    return good


def _stays(ends: tuple[int, int], connected: Array) -> bool:
    """Openings stay between kept rooms, and from a kept room to outside."""
    return all(e < 0 or connected[e] for e in ends) and any(e >= 0 for e in ends)
