"""Walls of a storey: pairs of faces that look away from each other, and single faces."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import shapely

from topomerge.structure.face_points import FacePoints
from topomerge.structure.floors import is_flight, jambs
from topomerge.structure.joints import joined
from topomerge.structure.wall_heights import with_heights
from topomerge.types import Array, TopometricMap

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


def wall_part(wall: Any, opening: Any = None, more: float = 0.0) -> shapely.Polygon:
    """A wall (a row of WALL_DTYPE) from above, or what an opening (a row of OPENING_DTYPE) takes of it; counter-clockwise, m.

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

    def share(self, start: float, end: float) -> float:
        """Share of the bins of a stretch in which it was seen."""
        bins = self.seen[int(start / BIN) : max(int(np.ceil(end / BIN - 1e-6)), int(start / BIN) + 1)]
        return float(bins.mean()) if len(bins) else 0.0


def walls_between(map: TopometricMap, storey: int, rooms: list[shapely.MultiPolygon], points: FacePoints) -> Array:
    """(W,) WALL_DTYPE of a storey.

    Args:
        rooms: outlines of all rooms of the map, m.
        points: of the storey.
    """
    faces = _faces(map, storey, rooms, points)
    pairs = _pairs(faces)
    rows = [wall for i, j, start, end in pairs if (wall := _double(faces[i], faces[j], start, end)) is not None]
    thickness = float(np.median([row[2] for row in rows])) if rows else USUAL_THICKNESS
    rows += _singles(faces, pairs, thickness)
    walls = np.zeros(len(rows), WALL_DTYPE)
    walls["storey"] = storey
    for k, (start, end, thick, seen, sides) in enumerate(rows):
        walls["start"][k], walls["end"][k], walls["thickness"][k] = start, end, thick
        walls["faces"][k], walls["rooms"][k] = seen, sides
    walls = with_heights(map, walls, points)
    return joined(walls, shapely.union_all([rooms[r] for r in np.flatnonzero(map.rooms["storey"] == storey)]))


def _faces(map: TopometricMap, storey: int, rooms: list[shapely.MultiPolygon], points: FacePoints) -> list[_Face]:
    """The edges of all outlines of a storey."""
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
                    faces.append(_bridged(face, doors))
    return faces


def _bridged(face: _Face, doors: list[Array]) -> _Face:
    """The face without short gaps, and with the doors that are in it."""
    seen = face.seen.copy()
    for door in doors:
        ends = (jambs(door)[:, :2] - face.a) @ face.along
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


def _pairs(faces: list[_Face]) -> list[tuple[int, int, float, float]]:
    """(i, j, start, end): faces i < j are two sides of a wall, between two places on i, m; the nearest other side each."""
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
        gap = float((_across(g, f.a + f.along * (low + high) / 2) - f.a) @ f.out)
        if -THINNEST < gap <= THICKEST:
            opposite.setdefault(i, []).append((gap, j, low, high))
    pairs = []
    for i, others in opposite.items():
        free = [(0.0, faces[i].length)]
        for _, j, low, high in sorted(others):
            for start, end in _overlaps(free, low, high):
                pairs.append((i, j, start, end))
            free = _without(free, low, high)
    there = {(i, j) for i, j, _, _ in pairs}
    return [pair for pair in pairs if pair[0] < pair[1] or (pair[1], pair[0]) not in there]


def _across(face: _Face, point: Array) -> Array:
    """The point of a face's line that is nearest to another."""
    out: Array = face.a + face.along * float((point - face.a) @ face.along)
    return out


def _overlaps(free: list[tuple[float, float]], low: float, high: float) -> list[tuple[float, float]]:
    cut = [(max(a, low), min(b, high)) for a, b in free]
    return [(a, b) for a, b in cut if b - a > BIN]


def _without(free: list[tuple[float, float]], low: float, high: float) -> list[tuple[float, float]]:
    return [(a, b) for x, y in free for a, b in ((x, min(y, low)), (max(x, high), y)) if b > a]


Row = tuple[Array, Array, float, int, tuple[int, int]]


def _double(f: _Face, g: _Face, start: float, end: float) -> Row | None:
    """The wall between two faces, from `start` to `end` on the first; None where neither was seen."""
    along = f.along - g.along
    along /= np.hypot(*along)
    ends = [f.a + f.along * t for t in (start, end)]
    far = [_across(g, p) for p in ends]
    shares = f.share(start, end), g.share(*sorted(float((p - g.a) @ g.along) for p in far))
    if max(shares) < 0.5:
        return None
    middle = (ends[0] + ends[1] + far[0] + far[1]) / 4
    out = np.array([along[1], -along[0]])
    thickness = max(float((far[0] + far[1] - ends[0] - ends[1]) @ out) / 2, THINNEST)
    t = [float((p - middle) @ along) for p in ends]
    seen = 2 if min(shares) >= 0.3 else 1
    return middle + along * t[0], middle + along * t[1], thickness, seen, (f.room, g.room)


def _singles(faces: list[_Face], pairs: list[tuple[int, int, float, float]], thickness: float) -> list[Row]:
    """Walls of which nobody saw the other side."""
    rows: list[Row] = []
    taken: dict[int, list[tuple[float, float]]] = {}
    for i, j, start, end in pairs:
        f, g = faces[i], faces[j]
        taken.setdefault(i, []).append((start, end))
        there = sorted(float((f.a + f.along * t - g.a) @ g.along) for t in (start, end))
        taken.setdefault(j, []).append((there[0], there[1]))
    for i, face in enumerate(faces):
        free = [(0.0, face.length)]
        for low, high in taken.get(i, []):
            free = _without(free, low, high)
        for low, high in free:
            for start, end in _runs(face, low, high):
                if end - start >= (LEAST_FACE if i in taken else LEAST_WALL):
                    ends = [face.a + face.along * t + face.out * thickness / 2 for t in (start, end)]
                    rows.append((ends[0], ends[1], thickness, 1, (face.room, -1)))
    return rows


def _runs(face: _Face, low: float, high: float) -> list[tuple[float, float]]:
    """Stretches of a part of a face that were seen."""
    first, last = int(low / BIN), int(np.ceil(high / BIN - 1e-6))
    change = np.flatnonzero(np.diff(np.pad(face.seen[first:last].astype(np.int8), 1)))
    runs = change.reshape(-1, 2) + first
    return [(max(a * BIN, low), min(b * BIN, high)) for a, b in runs.tolist()]
