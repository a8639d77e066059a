"""Walls of a storey: pairs of faces that look away from each other, and single faces."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import shapely

from topomerge.structure.floors import FacePoints, compute_jambs, is_flight, measure_room_levels
from topomerge.types import Array, TopometricMap

HEIGHT_REACH = 0.06  # m beside a wall, in which its cells are
HEIGHT_BIN = 0.1  # m along it
CEILING_REACH = 0.25  # m: what is no farther below a ceiling is of it
PARTITION = 0.5  # m below the ceiling: what ends so far below is no wall up to it
DOOR_NEAR = 0.4  # m
LEAST_BINS = 4  # over which a ceiling was seen, to say that a wall ends below


def add_wall_heights(map: TopometricMap, walls: Array, points: FacePoints) -> Array:
    """Return the walls from the lower floor beside them to the higher ceiling.

    Those over which the ceiling was seen, and nothing between it and their own top, end there; of which one side only was seen,
    these are cupboards and left out, if no door is in them.

    Args:
        walls: WALL_DTYPE of one storey.
        points: of the storey.
    """
    levels, seen = measure_room_levels(map)
    tree = shapely.STRtree(shapely.points(points.at))
    furniture = np.zeros(len(walls), bool)
    for k, wall in enumerate(walls):
        adjoining = wall["rooms"][wall["rooms"] >= 0]
        wall["low"], wall["high"] = levels[adjoining, 0].min(), levels[adjoining, 1].max()
        adjoining = adjoining[seen[adjoining]]
        if len(adjoining):
            top = _measure_own_top(wall, points, tree, float((levels[adjoining, 1] - levels[adjoining, 0]).min()))
            if np.isfinite(top):
                wall["high"], furniture[k] = wall["low"] + top, wall["faces"] == 1 and not _is_near_door(wall, map)
    return walls[~furniture]


def _is_near_door(wall: Array, map: TopometricMap) -> bool:
    """Return whether a door of its rooms is in a wall. Cupboards have none."""
    line = shapely.LineString([wall["start"], wall["end"]])
    own = np.isin(map.edges["rooms"], wall["rooms"][wall["rooms"] >= 0]).any(axis=1)
    return bool((shapely.distance(line, shapely.points(map.edges["centre"][own, :2])) < DOOR_NEAR).any())


def _measure_own_top(wall: Array, points: FacePoints, tree: shapely.STRtree, ceiling: float) -> float:
    """Return the height, m above the floor, where a wall ends below a ceiling that is so high; inf: it does not, or that was not
    seen."""
    line = shapely.LineString([wall["start"], wall["end"]])
    rows = tree.query(line, predicate="dwithin", distance=wall["thickness"] / 2 + HEIGHT_REACH)
    along = (wall["end"] - wall["start"]) / max(line.length, 1e-9)
    place = ((points.at[rows] - wall["start"]) @ along / HEIGHT_BIN).astype(np.int64)
    place = np.clip(place, 0, int(line.length / HEIGHT_BIN))
    roof = points.height[rows] > ceiling - CEILING_REACH
    covered, top = np.zeros(int(line.length / HEIGHT_BIN) + 1, bool), np.zeros(int(line.length / HEIGHT_BIN) + 1)
    covered[place[roof]] = True
    np.maximum.at(top, place[~roof], points.height[rows][~roof])
    if covered.sum() < max(LEAST_BINS, len(covered) / 2):
        return np.inf
    reached = float(np.quantile(top[covered], 0.8))
    return reached if 0 < reached < ceiling - PARTITION else np.inf


JOINT_REACH = 0.7  # m beyond the end of a wall
IN_LINE = np.cos(np.radians(8.0))
CROSSING = np.sin(np.radians(20.0))
THROUGH = 0.1  # m that an end may lie beyond the middle of the wall that it meets
INTO_ROOM = 0.03  # m by which a wall may reach into a room where it is lengthened


def join_walls(walls: Array, rooms: shapely.Geometry) -> Array:
    """Return the walls with each end at the middle of the wall that it meets; at a corner, both cover it.

    Args:
        walls: WALL_DTYPE of one storey.
        rooms: the outlines of the rooms, m: no wall is lengthened into them.
    """
    out = walls.copy()
    tree = shapely.STRtree([shapely.LineString([w["start"], w["end"]]) for w in walls])
    inner = rooms.buffer(-INTO_ROOM)
    for i, wall in enumerate(walls):
        for name, other in (("start", "end"), ("end", "start")):
            tip, way = wall[name], wall[name] - wall[other]
            length = float(np.hypot(*way))
            if length < 1e-6:
                continue
            way = way / length
            near = tree.query(shapely.Point(tip), predicate="dwithin", distance=2 * JOINT_REACH)
            more = _measure_extension(tip, way, float(wall["thickness"]), walls[near[near != i]])
            if more is not None and more > -length / 2:
                new = tip + way * more
                if more < 0 or not _is_inside_rooms(inner, tip, new, way, float(wall["thickness"])):
                    out[name][i] = new
    return out


def _is_inside_rooms(rooms: shapely.Geometry, tip: Array, new: Array, way: Array, thickness: float) -> bool:
    """Return whether the longer part of a wall would stand in a room."""
    part = shapely.LineString([tip, new]).buffer(max(thickness / 2 - 0.01, 0.01), cap_style="flat")
    return bool(shapely.area(shapely.intersection(part, rooms)) > 0.1 * max(part.area, 1e-9))


def _measure_extension(tip: Array, way: Array, thickness: float, others: Array) -> float | None:
    """Return the metres by which a wall that ends at `tip`, going `way`, is lengthened; None: it meets nothing."""
    best: float | None = None
    for other in others:
        line = other["end"] - other["start"]
        length = float(np.hypot(*line))
        if length < 1e-6:
            continue
        line = line / length
        turn = way[0] * line[1] - way[1] * line[0]
        if abs(way @ line) > IN_LINE:
            starts = [other["start"], other["end"]]
            ahead = [float((p - tip) @ way) for p in starts]
            off = min(abs(float((p - tip) @ (-way[1], way[0]))) for p in starts)
            if off < (thickness + other["thickness"]) / 2 and 0 <= min(ahead) <= JOINT_REACH:
                return min(ahead) / 2
        elif abs(turn) > CROSSING:
            apart = other["start"] - tip
            more = float(apart[0] * line[1] - apart[1] * line[0]) / turn
            place = float((tip + way * more - other["start"]) @ line)
            if not -THROUGH <= more <= JOINT_REACH or not -JOINT_REACH <= place <= length + JOINT_REACH:
                continue
            corner = place < thickness or place > length - thickness
            more += other["thickness"] / 2 if corner else 0.0
            best = more if best is None or abs(more) < abs(best) else best
    return best


WALL_DTYPE = np.dtype(
    [
        ("storey", "i4"),
        ("start", "f8", 2),  # ends of the middle line, m, in the input's frame
        ("end", "f8", 2),
        ("thickness", "f8"),  # m; a guess where one face only was seen
        ("faces", "i4"),  # seen: 2 or 1
        ("low", "f8"),  # m, height of its foot and of its top
        ("high", "f8"),
        ("rooms", "i4", 2),  # to its left and to its right, seen from start to end; -1: outside, or never seen
    ]
)
THICKEST = 0.6  # m: farther apart, two faces are of two walls
THINNEST = 0.04  # m
BACK_TO_BACK = -np.cos(np.radians(10.0))
USUAL_THICKNESS = 0.2  # m, where no wall of a storey was seen from both sides
BIN = 0.1  # m along a face
FACE_REACH = 0.06  # m: cells this near to a face are of it
BIN_CELLS = 4  # cells of a bin, at the heights of faces, of which a wall was seen
BRIDGED = 1.2  # m: shorter gaps in a face are shadows of furniture
LEAST_WALL = 0.3  # m
LEAST_FACE = 0.5  # m: shorter pieces of one face beside a wall of two are the end of a wall across
DOOR_REACH = 0.8  # m between the middle of a door and the face that it is in
BESIDE_DOOR = 3  # bins of a face that are seen beside a door: else it is no hole in a wall
WIDEST = 3.5  # m: wider openings are no hole in a wall


def build_wall_polygon(wall: Any, opening: Any = None, more: float = 0.0) -> shapely.Polygon:
    """Return a wall (a row of WALL_DTYPE) from above, or what an opening (a row of OPENING_DTYPE) takes of it; counter-clockwise,
    m.

    Args:
        more: m by which it is thicker on either side.
    """
    start, end = wall["start"], wall["end"]
    along = (end - start) / max(float(np.hypot(*(end - start))), 1e-9)
    if opening is not None:
        half = along * float(opening["width"]) / 2
        start, end = opening["centre"][:2] - half, opening["centre"][:2] + half
    across = np.array([-along[1], along[0]]) * (float(wall["thickness"]) / 2 + more)
    return shapely.Polygon([start - across, end - across, end + across, start + across])


@dataclass(frozen=True, eq=False)
class _Face:
    """An edge of an outline, from `a` to `b` (2,) m, its room to the left; `seen` (n,) bool for each `BIN` of it."""

    room: int
    a: Array
    b: Array
    along: Array
    length: float
    seen: Array

    @property
    def out(self) -> Array:
        """(2,) away from the room."""
        return np.array([self.along[1], -self.along[0]])

    def measure_share(self, start: float, end: float) -> float:
        """Return share of the bins of a stretch in which it was seen."""
        bins = self.seen[int(start / BIN) : max(int(np.ceil(end / BIN - 1e-6)), int(start / BIN) + 1)]
        return float(bins.mean()) if len(bins) else 0.0


def detect_walls(map: TopometricMap, storey: int, rooms: list[shapely.MultiPolygon], points: FacePoints) -> Array:
    """Return (W,) WALL_DTYPE of a storey.

    Args:
        rooms: outlines of all rooms of the map, m.
        points: of the storey.
    """
    faces = _collect_faces(map, storey, rooms, points)
    pairs = _pair_faces(faces)
    rows = [wall for i, j, start, end in pairs if (wall := _build_double_wall(faces[i], faces[j], start, end)) is not None]
    thickness = float(np.median([row[2] for row in rows])) if rows else USUAL_THICKNESS
    rows += _build_single_walls(faces, pairs, thickness)
    walls = np.zeros(len(rows), WALL_DTYPE)
    walls["storey"] = storey
    for k, (start, end, thick, seen, sides) in enumerate(rows):
        walls["start"][k], walls["end"][k], walls["thickness"][k] = start, end, thick
        walls["faces"][k], walls["rooms"][k] = seen, sides
    walls = add_wall_heights(map, walls, points)
    return join_walls(walls, shapely.union_all([rooms[r] for r in np.flatnonzero(map.rooms["storey"] == storey)]))


def _collect_faces(map: TopometricMap, storey: int, rooms: list[shapely.MultiPolygon], points: FacePoints) -> list[_Face]:
    """Return the edges of all outlines of a storey."""
    upright = points.upright
    tree = shapely.STRtree(shapely.points(points.at[upright]))
    at, scale = points.at[upright], 0.1 / points.edge
    reach = FACE_REACH if points.measured else FACE_REACH + points.edge / 2
    faces = []
    for r in np.flatnonzero(map.rooms["storey"] == storey).tolist():
        doors = [e for e in map.edges if r in e["rooms"] and not is_flight(e) and e["width"] <= WIDEST]
        for part in rooms[r].geoms:
            for ring in (part.exterior, *part.interiors):
                for a, b in pairwise(np.asarray(ring.coords)[:, :2]):
                    length = float(np.hypot(*(b - a)))
                    if length < 1e-6:
                        continue
                    along = (b - a) / length
                    near = tree.query(shapely.LineString([a, b]), predicate="dwithin", distance=reach)
                    count = np.bincount(
                        np.clip((at[near] - a) @ along / BIN, 0, np.ceil(length / BIN) - 1).astype(np.int64),
                        minlength=int(np.ceil(length / BIN)),
                    )
                    face = _Face(r, a, b, along, length, count >= BIN_CELLS * scale)
                    faces.append(_bridge_gaps(face, doors))
    return faces


def _bridge_gaps(face: _Face, doors: list[Array]) -> _Face:
    """Return the face without short gaps, and with the doors that are in it."""
    seen = face.seen.copy()
    for door in doors:
        ends = (compute_jambs(door)[:, :2] - face.a) @ face.along
        off = abs(float((door["centre"][:2] - face.a) @ face.out))
        middle, half = float(ends.mean()), float(door["width"]) / 2
        if off < DOOR_REACH and -half < middle < face.length + half:
            low, high = (int(np.clip(x / BIN, 0, len(seen))) for x in (middle - half - BIN, middle + half + BIN))
            if face.seen[:low].sum() + face.seen[high:].sum() >= BESIDE_DOOR:
                seen[low:high] = True
    runs = np.flatnonzero(seen)
    for a, b in pairwise(runs.tolist()):
        if (b - a - 1) * BIN <= BRIDGED:
            seen[a:b] = True
    return _Face(face.room, face.a, face.b, face.along, face.length, seen)


def _pair_faces(faces: list[_Face]) -> list[tuple[int, int, float, float]]:
    """Return (i, j, start, end): faces i < j are two sides of a wall, between two places on i, m; the nearest other side each."""
    lines = [shapely.LineString([f.a, f.b]) for f in faces]
    if not lines:
        return []
    first, second = shapely.STRtree(lines).query(lines, predicate="dwithin", distance=THICKEST)
    opposite: dict[int, list[tuple[float, int, float, float]]] = {}
    for i, j in zip(first.tolist(), second.tolist(), strict=True):
        f, g = faces[i], faces[j]
        if i == j or f.along @ g.along > BACK_TO_BACK:
            continue
        low, high = sorted(float((p - f.a) @ f.along) for p in (g.a, g.b))
        low, high = max(low, 0.0), min(high, f.length)
        if high - low < BIN:
            continue
        gap = float((_project_onto_face(g, f.a + f.along * (low + high) / 2) - f.a) @ f.out)
        if -THINNEST < gap <= THICKEST:
            opposite.setdefault(i, []).append((gap, j, low, high))
    pairs = []
    for i, others in opposite.items():
        free = [(0.0, faces[i].length)]
        for _, j, low, high in sorted(others):
            for start, end in _intersect_intervals(free, low, high):
                pairs.append((i, j, start, end))
            free = _subtract_interval(free, low, high)
    paired = {(i, j) for i, j, _, _ in pairs}
    return [pair for pair in pairs if pair[0] < pair[1] or (pair[1], pair[0]) not in paired]


def _project_onto_face(face: _Face, point: Array) -> Array:
    """Return the point of a face's line that is nearest to another."""
    out: Array = face.a + face.along * float((point - face.a) @ face.along)
    return out


def _intersect_intervals(free: list[tuple[float, float]], low: float, high: float) -> list[tuple[float, float]]:
    cut = [(max(a, low), min(b, high)) for a, b in free]
    return [(a, b) for a, b in cut if b - a > BIN]


def _subtract_interval(free: list[tuple[float, float]], low: float, high: float) -> list[tuple[float, float]]:
    return [(a, b) for x, y in free for a, b in ((x, min(y, low)), (max(x, high), y)) if b > a]


Row = tuple[Array, Array, float, int, tuple[int, int]]


def _build_double_wall(f: _Face, g: _Face, start: float, end: float) -> Row | None:
    """Return the wall between two faces, from `start` to `end` on the first; None where neither was seen."""
    along = f.along - g.along
    along /= np.hypot(*along)
    ends = [f.a + f.along * t for t in (start, end)]
    far = [_project_onto_face(g, p) for p in ends]
    shares = f.measure_share(start, end), g.measure_share(*sorted(float((p - g.a) @ g.along) for p in far))
    if max(shares) < 0.5:
        return None
    middle = (ends[0] + ends[1] + far[0] + far[1]) / 4
    out = np.array([along[1], -along[0]])
    thickness = max(float((far[0] + far[1] - ends[0] - ends[1]) @ out) / 2, THINNEST)
    t = [float((p - middle) @ along) for p in ends]
    seen = 2 if min(shares) >= 0.3 else 1
    return middle + along * t[0], middle + along * t[1], thickness, seen, (f.room, g.room)


def _build_single_walls(faces: list[_Face], pairs: list[tuple[int, int, float, float]], thickness: float) -> list[Row]:
    """Build the walls of which nobody saw the other side."""
    rows: list[Row] = []
    taken: dict[int, list[tuple[float, float]]] = {}
    for i, j, start, end in pairs:
        f, g = faces[i], faces[j]
        taken.setdefault(i, []).append((start, end))
        span = sorted(float((f.a + f.along * t - g.a) @ g.along) for t in (start, end))
        taken.setdefault(j, []).append((span[0], span[1]))
    for i, face in enumerate(faces):
        free = [(0.0, face.length)]
        for low, high in taken.get(i, []):
            free = _subtract_interval(free, low, high)
        for low, high in free:
            for start, end in _find_seen_runs(face, low, high):
                if end - start >= (LEAST_FACE if i in taken else LEAST_WALL):
                    ends = [face.a + face.along * t + face.out * thickness / 2 for t in (start, end)]
                    rows.append((ends[0], ends[1], thickness, 1, (face.room, -1)))
    return rows


def _find_seen_runs(face: _Face, low: float, high: float) -> list[tuple[float, float]]:
    """Return the stretches of a part of a face that were seen."""
    first, last = int(low / BIN), int(np.ceil(high / BIN - 1e-6))
    change = np.flatnonzero(np.diff(np.pad(face.seen[first:last].astype(np.int8), 1)))
    runs = change.reshape(-1, 2) + first
    return [(max(a * BIN, low), min(b * BIN, high)) for a, b in runs.tolist()]
