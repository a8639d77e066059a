"""Sketches of real plans: shapes, walls, openings, and where doors go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from topomerge.datasets.core.building import MAX_DOOR, MIN_AREA, MIN_DOOR, Flight, Opening, Plan, PlanRoom, Wall, check_plan
from topomerge.datasets.core.solids import build_rectangle

from topomerge.errors import InputError
from topomerge.types import Array

LEAF_WIDTH = 1.4  # m; wider doorways have no leaf
PROBE_STEP = 0.05  # m, between the samples along an edge
DOOR_MARGIN = 0.1  # m, that a door keeps from the corners, where there is room
DOOR_SPARE = 0.3  # m, that an opening is thicker than the gap between the rooms: walls may be set into them


def build_opening(kind: str, start: Array, end: Array, thickness: float) -> Opening:
    """Build an opening from two points; a door that is too wide for a leaf becomes a plain opening."""
    width = float(np.hypot(*(np.asarray(end) - np.asarray(start))))
    if kind == "door" and width > LEAF_WIDTH:
        kind = "opening"
    return Opening(kind, (float(start[0]), float(start[1])), (float(end[0]), float(end[1])), thickness)


def convert_to_window(opening: Opening, bottom: float, top: float) -> Opening:
    """Return the same hole, glazed."""
    return replace(opening, kind="window", bottom=bottom, top=top)


def find_side_rooms(start: Array, end: Array, shapes: Sequence[shapely.Polygon], reach: float | Array) -> Array:
    """Find the shapes on the two sides of segments.

    Args:
        start, end: (n, 2).
        reach: m, or (n,), how far from the middle of the segment a shape is looked for.

    Returns:
        (n, 2) index of the first shape on the left and on the right, -1: none.
    """
    along = (end - start) / np.maximum(np.linalg.norm(end - start, axis=1), 1e-9)[:, None]
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    steps = np.arange(0.02, float(np.max(reach, initial=0)), PROBE_STEP)
    offsets = np.stack([steps, -steps])[None, :, :, None] * normal[:, None, None]  # (n, 2, s, 2)
    points = ((start + end) / 2)[:, None, None] + offsets
    which = np.full(points.shape[:-1], -1)
    point, shape = shapely.STRtree(shapes).query(shapely.points(points.reshape(-1, 2)), predicate="within")
    order = np.argsort([-shapes[i].area for i in shape], kind="stable")  # where shapes overlap, the smaller one counts
    which.reshape(-1)[point[order]] = shape[order]
    which[np.broadcast_to(steps > np.reshape(reach, (-1, 1, 1)), which.shape)] = -1
    first = np.argmax(which >= 0, axis=2)
    nearest_room: Array = np.take_along_axis(which, first[..., None], axis=2)[..., 0]
    return nearest_room


def find_facing_runs(a: shapely.Polygon, b: shapely.Polygon, reach: float) -> list[Array]:
    """Find runs along the outline of `a` that look straight at `b` from at most `reach` m.

    Returns:
        One (n, 5) array a run: point on the outline of `a`, outward normal, and gap to `b`, m; points are `PROBE_STEP` apart.
    """
    ring = np.asarray(shapely.orient_polygons(a).exterior.coords)[:, :2]
    rings = [ring, *(np.asarray(r.coords)[:, :2] for r in shapely.orient_polygons(a).interiors)]
    low, high = np.array(a.bounds).reshape(2, 2) + [[-reach - 1], [reach + 1]]
    b = shapely.intersection(b, shapely.box(*low, *high))  # b may be a hall that is much larger
    near = b.buffer(reach + PROBE_STEP)
    runs = []
    for corners in rings:
        for start, end in pairwise(corners):
            length = float(np.hypot(*(end - start)))
            if length > PROBE_STEP and near.intersects(shapely.LineString([start, end])):
                runs += _split_runs(start, (end - start) / length, length, b, reach)
    return runs


def _split_runs(start: Array, along: Array, length: float, b: shapely.Polygon, reach: float) -> list[Array]:
    t = np.linspace(0, length, max(int(length / PROBE_STEP), 2) + 1)
    t = np.clip(t, 1e-3, length - 1e-3)
    points = start + t[:, None] * along
    normal = np.array([along[1], -along[0]])  # outward of a counter-clockwise outline
    back = points - normal * 0.1  # b may overlap a little
    rays = shapely.linestrings(np.stack([back, points + normal * (reach + 1e-6)], axis=1))
    hits = shapely.intersection(rays, b)
    gaps = np.maximum(shapely.distance(hits, shapely.points(back)) - 0.1, 0.0)
    seen = ~shapely.is_empty(hits) & np.isfinite(gaps)
    rows = np.column_stack([points, np.broadcast_to(normal, points.shape), gaps])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(int), [0]])))
    return [rows[i:j] for i, j in edges.reshape(-1, 2) if j - i > 1]


def place_door(
    a: shapely.Polygon, b: shapely.Polygon, width: float, reach: float, near: Array | None = None, kind: str = "door"
) -> Opening | None:
    """Return a door between two rooms whose outlines run along the wall's faces.

    Args:
        width: m; made narrower, down to 0.6 m, where the rooms do not face each other for so long.
        reach: m, how far apart the outlines may be.
        near: (2,) where the door should be; None: in the middle of the longest stretch that the rooms share.

    Returns:
        None where the rooms face each other nowhere for 0.6 m.
    """
    best: tuple[float, Array] | None = None
    for run in find_facing_runs(a, b, reach):
        length = float(np.hypot(*(run[-1, :2] - run[0, :2])))
        if length < 0.6:
            continue
        cost = -length if near is None else float(np.linalg.norm(run[:, :2] - near, axis=1).min())
        if best is None or cost < best[0] - 1e-6:
            best = (cost, run)
    if best is None:
        return None
    return _cut_out(best[1], width, near, kind)


def _cut_out(run: Array, width: float, near: Array | None, kind: str) -> Opening:
    first, last = run[0, :2], run[-1, :2]
    length = float(np.hypot(*(last - first)))
    along = (last - first) / length
    margin = float(np.clip((length - width) / 2, 0, DOOR_MARGIN))
    width = min(width, length - 2 * margin)
    requested = length / 2 if near is None else float((np.asarray(near) - first) @ along)
    middle = float(np.clip(requested, margin + width / 2, length - margin - width / 2))
    t = (run[:, :2] - first) @ along
    gaps = run[np.abs(t - middle) <= width / 2 + PROBE_STEP, 4]
    depth = float(gaps.max())
    start, end = (first + along * (middle + s * width / 2) + run[0, 2:4] * depth / 2 for s in (-1, 1))
    return build_opening(kind, start, end, depth + DOOR_SPARE)


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
        """Add a room and return its index."""
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
    """Read the bytes of a file that has at most `limit` of them (`check_size`)."""
    check_size(path, limit, what)
    return path.read_bytes()


def finish(sketch: Sketch) -> tuple[Plan, list[str]]:
    """Check a plan and return it with notes on what was changed.

    Raises:
        InputError: for the reasons listed in `floorplans`.
    """
    notes = list(sketch.notes)
    shapes = [_check_shape(shape, name) for shape, name in zip(sketch.shapes, sketch.names, strict=True)]
    if sketch.inset:
        shapes = [_find_largest_part(shape.buffer(-sketch.inset, join_style="mitre")) for shape in shapes]
    solid = shapely.union_all([build_rectangle(w.start, w.end, w.thickness) for w in sketch.walls if not w.glass])
    shapes = [_find_largest_part(shape.difference(solid).simplify(TOLERANCE)) for shape in shapes]
    _check_overlap(shapes, sketch.names)
    passable = _check_doors(sketch) & _verify_openings(sketch, shapes)
    connected = _find_connected_rooms(sketch, shapes, passable)
    stays = np.array([_is_kept(ends, connected) for ends in sketch.ends], bool)
    walked = np.array([opening.kind != "window" for opening in sketch.openings], bool)
    lost = int((stays & walked & ~passable).sum())
    if lost:
        notes.append(f"left out {lost} doors that are too narrow or too wide or do not lead where they should")
    if int(connected.sum()) < len(shapes):
        notes.append(f"kept {int(connected.sum())} of {len(shapes)} rooms: the largest part that doors connect")
    _check_scale([shape for shape, keep in zip(shapes, connected, strict=True) if keep])
    rooms = tuple(
        PlanRoom(name, build_outline(shape), kind)
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


def build_outline(shape: shapely.Polygon) -> Array:
    """Build (k, 2) outline, counter-clockwise, not closed; holes are joined to it by a slit that is too thin to see."""
    while shape.interiors:
        ring = shape.interiors[0]
        others = shapely.union_all([shape.exterior, *list(shape.interiors)[1:]])
        cut = _cut(shape, shapely.shortest_line(shapely.Polygon(ring), others))
        if cut is None or len(cut.interiors) >= len(shape.interiors):
            raise InputError("room with a hole: it cannot be cut open")
        shape = cut
    return np.asarray(shapely.orient_polygons(shape).exterior.coords)[:-1, :2].copy()


def _cut(shape: shapely.Polygon, slit: shapely.LineString) -> shapely.Polygon | None:
    """Return the shape less a thin slit, or None where that breaks it."""
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


def _check_shape(shape: shapely.Polygon, name: str) -> shapely.Polygon:
    coordinates = shapely.get_coordinates(shape)
    if len(coordinates) < 4 or not np.isfinite(coordinates).all():
        raise InputError(f"not closed: room {name!r} has no outline")
    if not shape.is_valid:
        raise InputError(f"crosses itself: the outline of room {name!r}")
    return shape


def _find_largest_part(shape: shapely.Geometry) -> shapely.Polygon:
    parts = [p for p in shapely.get_parts(shape) if p.geom_type == "Polygon"]
    best = max(parts, key=lambda p: p.area, default=shapely.Polygon())
    if any(shapely.Polygon(r).area < 0.05 for r in best.interiors):  # specks
        best = shapely.Polygon(best.exterior, [r for r in best.interiors if shapely.Polygon(r).area >= 0.05])
    return best


def find_overlaps(shapes: Sequence[shapely.Polygon]) -> list[tuple[int, int, float]]:
    """Find pairs i < j of shapes and the share of the smaller one that lies in the other, where that is above 2 %."""
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
    for i, j, share in find_overlaps(shapes):
        raise InputError(f"overlapping rooms: {names[i]!r} and {names[j]!r} share {share:.0%} of the smaller")


def _check_doors(sketch: Sketch) -> Array:
    """Return (n,) bool: can one walk through the opening? Refuses a plan whose doors have no width or an absurd one."""
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


def _find_connected_rooms(sketch: Sketch, shapes: Sequence[shapely.Polygon], passable: Array) -> Array:
    """Return (R,) bool: rooms of the largest part that doors join; ties go to the larger area."""
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


def _verify_openings(sketch: Sketch, shapes: Sequence[shapely.Polygon]) -> Array:
    """Return (n,) bool: does one find the two rooms of an opening on its two sides?"""
    joined_rooms = find_side_rooms(
        np.array([o.start for o in sketch.openings]),
        np.array([o.end for o in sketch.openings]),
        shapes,
        np.array([o.thickness / 2 + 0.3 for o in sketch.openings]),
    )
    requested = np.array(sketch.ends, np.int64).reshape(-1, 2)
    good: Array = (np.sort(joined_rooms, axis=1) == np.sort(requested, axis=1)).all(axis=1)
    return good


def _is_kept(ends: tuple[int, int], connected: Array) -> bool:
    """Return whether an opening stays: those between kept rooms, and from a kept room to outside."""
    return all(e < 0 or connected[e] for e in ends) and any(e >= 0 for e in ends)
