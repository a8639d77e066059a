"""The outline of a room along its walls: their lines cut the plane, and a minimal cut says which of its pieces are room.

A piece is room rather than not by how much of it the floor covers; an edge of the outline costs nothing where a wall was seen,
and its length where not. So leaks through windows are cut off, and corners that nobody saw are completed (compare Oesau et al.
2014, "Indoor scene reconstruction using feature sensitive primitive extraction and graph-cut").
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from topomerge.structure.lines import LINE_GAP, Line
from topomerge.types import Array

OUTLINE_MARGIN = 3.0  # m around a floor, in which its corners are
UNSEEN_COST = 0.4  # m2 that a metre of outline without a wall costs
BEYOND_COST = 0.5  # of a square metre that the floor does not cover, where one that it covers costs 1
OWN_EDGE = 0.4  # m: longer edges of the floor cut the plane, too, where no wall is near
SAME_LINE = 0.2  # m
SAME_TURN = np.cos(np.radians(10.0))
REACH_ON = 0.4  # m: a wall may go on so far past what was seen of it
SIMPLER = 0.12  # m
SLIVER = 0.1  # m: narrower parts of an outline that touches another one are none
UNIT = 1e4  # of costs: a square centimetre
CORNER_GRID = 1e-6  # m, of corners


def room_outline(floor: shapely.MultiPolygon, lines: list[Line]) -> shapely.MultiPolygon:
    """The floor with its edges on the lines of walls, m; the floor itself where there are none."""
    if floor.is_empty or not lines:
        return floor
    box = shapely.box(*floor.bounds).buffer(OUTLINE_MARGIN, join_style="mitre")
    low = np.array(floor.bounds[:2])
    walls = [_segment(line, LINE_GAP / 2 if line.length > LINE_GAP else REACH_ON, low) for line in lines]
    long = [_segment(line, 1e3, low) for line in lines]
    own = [_segment(edge, REACH_ON, low) for edge in unseen_edges(floor, lines)]
    seen = [wall for wall, line in zip(walls, lines, strict=True) if line.weight > 0]
    box, moved = shapely.affinity.translate(box, *-low), shapely.affinity.translate(floor, *-low)
    drawn = shapely.intersection(np.array([*long, *own]), box)
    network = shapely.union_all([*drawn, box.exterior], grid_size=CORNER_GRID)
    pieces = shapely.get_parts(shapely.polygonize(shapely.get_parts(network)))
    room = _cut(pieces, moved, shapely.union_all([s.buffer(1e-4, cap_style="flat") for s in seen]))
    shape = shapely.union_all(pieces[room], grid_size=CORNER_GRID) if room.any() else moved
    parts = [p for p in shapely.get_parts(shapely.simplify(shape, 1e-4)) if p.area > 0.05]
    parts = [shapely.Polygon(p.exterior, [h for h in p.interiors if shapely.Polygon(h).area > 0.2]) for p in parts]
    placed = shapely.affinity.translate(shapely.MultiPolygon(parts), *low)
    return shapely.MultiPolygon([shapely.geometry.polygon.orient(p) for p in placed.geoms]) if parts else floor


def _segment(line: Line, more: float, low: Array) -> shapely.LineString:
    ends = [line.middle - low + line.along * t for t in (line.start - more, line.end + more)]
    return shapely.LineString(ends)


def unseen_edges(floor: shapely.MultiPolygon, lines: list[Line]) -> list[Line]:
    """Edges of a floor, beside which no line of a wall runs; nothing was seen on them."""
    out = []
    for part in shapely.get_parts(shapely.simplify(floor, SIMPLER)):
        for ring in (part.exterior, *part.interiors):
            for a, b in pairwise(np.asarray(ring.coords)[:, :2]):
                length = float(np.hypot(*(b - a)))
                edge = Line((a + b) / 2, (b - a) / max(length, 1e-9), -length / 2, length / 2)
                if length >= OWN_EDGE and not any(_runs_along(line, edge) for line in lines):
                    out.append(edge)
    return out


def _runs_along(line: Line, edge: Line) -> bool:
    t = float((edge.middle - line.middle) @ line.along)
    beside = line.start - REACH_ON < t < line.end + REACH_ON and abs(line.along @ edge.along) > SAME_TURN
    return beside and abs(float((edge.middle - line.middle) @ line.across)) < SAME_LINE


def _cut(pieces: Array, floor: shapely.MultiPolygon, seen: shapely.Geometry) -> Array:
    """(n,) bool: which pieces are room."""
    area = shapely.area(pieces)
    inside = shapely.area(shapely.intersection(pieces, floor))
    a, b, edges = _borders(pieces)
    cost = UNSEEN_COST * (shapely.length(edges) - shapely.length(shapely.intersection(edges, seen)))
    count = len(pieces)
    source, sink, every = np.full(count, count), np.full(count, count + 1), np.arange(count)
    start = np.concatenate([a, b, source, every])
    end = np.concatenate([b, a, every, sink])
    capacity = np.concatenate([cost, cost, inside, BEYOND_COST * (area - inside)])
    whole = np.maximum(np.round(capacity * UNIT), 0).astype(np.int32)
    graph = coo_array((whole, (start, end)), shape=(count + 2, count + 2)).tocsr()
    flow = maximum_flow(graph, count, count + 1).flow
    left = graph - flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    reached = breadth_first_order(left, count, return_predecessors=False)
    out = np.zeros(count + 2, bool)
    out[reached] = True
    return out[:count]


def _borders(pieces: Array) -> tuple[Array, Array, Array]:
    """Pairs of pieces that share an edge, and the edge."""
    owner: dict[tuple[tuple[float, float], tuple[float, float]], int] = {}
    rows = []
    for i, piece in enumerate(pieces):
        for ring in (piece.exterior, *piece.interiors):
            for p, q in pairwise([(x, y) for x, y in ring.coords]):
                key = (p, q) if p < q else (q, p)
                if key in owner:
                    rows.append((owner[key], i, key))
                else:
                    owner[key] = i
    a, b = (np.array([row[k] for row in rows], np.int64) for k in (0, 1))
    return a, b, shapely.linestrings([row[2] for row in rows]) if rows else np.array([], object)


def apart(outlines: list[shapely.MultiPolygon]) -> list[shapely.MultiPolygon]:
    """Outlines of one storey without what an earlier one covers already."""
    out: list[shapely.MultiPolygon] = []
    for outline in outlines:
        taken = [out[k] for k in np.flatnonzero(shapely.intersects(out, outline))] if out else []
        rest = outline
        if taken:  # slivers between lines of two rooms go, corners stay
            free = shapely.difference(outline, shapely.union_all(taken))
            rest = free.buffer(-SLIVER, join_style="mitre").buffer(SLIVER, join_style="mitre").intersection(free)
        parts = [p for p in shapely.get_parts(rest) if p.geom_type == "Polygon" and p.area > 0.05]
        out.append(shapely.MultiPolygon([shapely.geometry.polygon.orient(p) for p in parts]))
    return out
