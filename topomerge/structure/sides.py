"""A face is seen from one side: of two rooms that have the same line, one sees it, and the other ends before it.

Furniture hides walls. A room whose own face nobody saw reaches, in cells, to the face that its neighbour sees, and takes some of
the neighbour's cells for its own. Its outline then runs as far before that face as walls of the storey are thick.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely

from topomerge.structure.lines import Line
from topomerge.structure.outlines import unseen_edges
from topomerge.types import Array

SAME_FACE = 0.05  # m: lines no farther apart are one face
PARALLEL = np.cos(np.radians(4.0))
THIN, THICK = 0.05, 0.45  # m: gaps between faces of two rooms that say how thick walls are
UNKNOWN_THICKNESS = 0.12  # m, of inner walls
BESIDE_LINE = 0.4  # m: here a floor must lie, on the side of a line from which a room sees it
HIDDEN = 0.12  # m: so near to a neighbour's face a floor ends at a wall that hides behind furniture
SAMPLES = np.linspace(0.05, 0.95, 13)


def one_side_each(lines: list[list[Line]], floors: list[shapely.MultiPolygon]) -> list[list[Line]]:
    """The lines of each room, without those that a neighbour sees better, before which the room's own are put.

    Args:
        lines: of each room of a storey.
        floors: of each, m.
    """
    for floor in floors:
        shapely.prepare(floor)
    faces = [_Face(r, line, _side(line, floors[r])) for r, own in enumerate(lines) for line in own]
    faces += [_Face(r, line, _side(line, floors[r])) for r, own in enumerate(lines) for line in unseen_edges(floors[r], own)]
    pairs = _parallel_pairs([face.line for face in faces])
    gaps = [_gap(faces[i], faces[j]) for i, j in pairs if faces[i].line.weight * faces[j].line.weight > 0]
    usual = [gap for gap in gaps if THIN < gap < THICK]
    thickness = float(np.median(usual)) if usual else UNKNOWN_THICKNESS
    better: dict[int, int] = {}
    for i, j in pairs:
        a, b = faces[i], faces[j]
        reach = SAME_FACE if a.line.weight else HIDDEN
        if a.room != b.room and (a.line.weight, -i) < (b.line.weight, -j) and _distance(a.line, b.line) < reach:
            better.setdefault(i, j)
    out: list[list[Line]] = [[] for _ in lines]
    for i, face in enumerate(faces):
        if i not in better:
            out[face.room] += [face.line] if face.line.weight else []
        elif face.side.any():
            out[face.room].append(_moved(faces[better[i]].line, face.side * thickness, face.line))
    return out


@dataclass(frozen=True, eq=False)
class _Face:
    """A line of a room; `side` (2,) leads from it into the room, unit; 0 where it is not known."""

    room: int
    line: Line
    side: Array


def _parallel_pairs(lines: list[Line]) -> list[tuple[int, int]]:
    """Ordered pairs of nearly parallel lines that lie beside each other."""
    if not lines:
        return []
    segments = [shapely.LineString(line.ends) for line in lines]
    first, second = shapely.STRtree(segments).query(segments, predicate="dwithin", distance=THICK)
    along = np.array([line.along for line in lines])
    straight = (np.abs((along[first] * along[second]).sum(axis=1)) > PARALLEL) & (first != second)
    pairs = zip(first[straight].tolist(), second[straight].tolist(), strict=True)
    return [(i, j) for i, j in pairs if _overlap(lines[i], lines[j]) > 0.2]


def _overlap(a: Line, b: Line) -> float:
    t = np.sort((b.ends - a.middle) @ a.along)
    return float(min(t[1], a.end) - max(t[0], a.start))


def _distance(a: Line, b: Line) -> float:
    """m between two lines, in the middle of where they lie beside each other."""
    t = np.sort((b.ends - a.middle) @ a.along)
    middle = a.middle + a.along * (min(t[1], a.end) + max(t[0], a.start)) / 2
    return abs(float((middle - b.middle) @ b.across))


def _gap(a: _Face, b: _Face) -> float:
    """m of wall between two faces; -1 where they do not look away from each other."""
    if a.room == b.room or a.side @ b.side > -PARALLEL or (b.line.middle - a.line.middle) @ a.side > 0:
        return -1.0
    return _distance(a.line, b.line)


def _side(line: Line, floor: shapely.MultiPolygon) -> Array:
    """(2,) across a line to where the room lies; 0 where it lies on both sides or on none."""
    at = line.ends[0] + SAMPLES[:, None] * (line.ends[1] - line.ends[0])
    left, right = (float(_within(floor, at + line.across * way).mean()) for way in (BESIDE_LINE, -BESIDE_LINE))
    return line.across * (0 if abs(left - right) < 0.3 else 1 if left > right else -1)


def _within(floor: shapely.MultiPolygon, points: Array) -> Array:
    return np.asarray(shapely.contains_xy(floor, points[:, 0], points[:, 1]))


def _moved(line: Line, off: Array, extent: Line) -> Line:
    """A line that is concluded: one moved by `off` (2,) m, as long as another."""
    t = np.sort((extent.ends - line.middle) @ line.along)
    return replace(line, middle=line.middle + off, start=float(t[0]), end=float(t[1]), weight=0.0)
