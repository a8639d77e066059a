"""A building's structure: walls with thickness, doors as openings in them, rooms whose outlines are the walls' faces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from topomerge.structure.floors import FacePoints, build_floor_polygons, find_wall_columns, is_flight, select_face_points
from topomerge.structure.lines import LINE_GAP, Line, detect_lines, estimate_main_direction
from topomerge.structure.walls import WALL_DTYPE, detect_walls
from topomerge.types import Array, TopometricMap

OPENING_DTYPE = np.dtype(
    [
        ("edge", "i4"),  # row of the map's edges
        ("wall", "i4"),  # row of the walls; -1: none was seen around it
        ("centre", "f8", 3),  # on the floor, in the middle of the wall, in the input's frame
        ("width", "f8"),  # m
        ("height", "f8"),  # m; 0 where nothing was seen above
        ("direction", "f8"),  # rad, of the wall's normal, in [0, pi)
        ("kind", "U8"),  # door | opening
    ]
)
SET_WINDOW_DTYPE = np.dtype(
    [
        ("window", "i4"),  # row of the map's windows
        ("wall", "i4"),  # row of the walls; -1: none was seen around it
        ("centre", "f8", 3),  # on the floor, in the middle of the wall, in the input's frame
        ("width", "f8"),  # m
        ("sill", "f8"),  # m above the floor; a usual height where it was not seen
        ("head", "f8"),
        ("direction", "f8"),  # rad, of the wall's normal, in [0, pi)
    ]
)
USUAL_SILL, USUAL_HEAD, LEAST_PANE = 0.9, 2.1, 0.3  # m above the floor, where they were not seen, and between them at least
CARRIER_REACH = 0.8  # m between the middle of a door and the middle line of its wall
STRANGE = 0.4  # m: a wall of other rooms has to be so much nearer
LEAST_SHARE = 0.5  # of an opening's width that is in its wall


def place_openings(map: TopometricMap, walls: Array) -> Array:
    """Return (O,) OPENING_DTYPE, in the order of the map's edges; flights of stairs are none.

    An opening lies in the middle of the wall that carries it, and turned as it is: the wall's direction is better known.

    Args:
        walls: WALL_DTYPE of the whole map.
    """
    rows = [i for i, edge in enumerate(map.edges) if not is_flight(edge)]
    out = np.zeros(len(rows), OPENING_DTYPE)
    for opening, i in zip(out, rows, strict=True):
        edge = map.edges[i]
        for name in ("centre", "width", "height", "direction", "kind"):
            opening[name] = edge[name]
        opening["edge"], opening["wall"] = i, _find_carrier_wall(edge, edge["rooms"], walls, map.rooms)
        if opening["wall"] >= 0:
            _set_into(opening, walls[opening["wall"]])
    return out


def place_windows(map: TopometricMap, walls: Array) -> Array:
    """Return (W,) SET_WINDOW_DTYPE, in the order of the map's windows; they lie in their walls as openings do.

    Args:
        walls: WALL_DTYPE of the whole map.
    """
    out = np.zeros(len(map.windows), SET_WINDOW_DTYPE)
    for k, (pane, window) in enumerate(zip(out, map.windows, strict=True)):
        for name in ("centre", "width", "direction"):
            pane[name] = window[name]
        pane["window"], pane["wall"] = k, _find_carrier_wall(window, window["rooms"], walls, map.rooms)
        if pane["wall"] >= 0:
            _set_into(pane, walls[pane["wall"]])
        pane["sill"], pane["head"] = _estimate_pane_heights(float(window["sill"]), float(window["head"]))
    return out


def _estimate_pane_heights(sill: float, head: float) -> tuple[float, float]:
    """Return the sill and head above the floor, usual ones where they were not seen; LEAST_PANE high what ends below the
    floor."""
    low = sill if np.isfinite(sill) else min(USUAL_SILL, head - LEAST_PANE) if np.isfinite(head) else USUAL_SILL
    low = max(low, 0.0)
    if not np.isfinite(head):
        return low, max(USUAL_HEAD, low + LEAST_PANE)
    return low, head if head > low else low + LEAST_PANE


def _find_carrier_wall(edge: Array, rooms: Array, walls: Array, table: Array) -> int:
    """Return the row of the wall nearest to a door or a window among those that part its rooms, -1 none.

    Args:
        rooms: (2,) on its two sides, -1 none.
        table: ROOM_DTYPE of the whole map.
    """
    inner = rooms[rooms >= 0]
    line = walls["end"] - walls["start"]
    length = np.maximum(np.hypot(*line.T), 1e-9)
    along = line / length[:, None]
    apart = edge["centre"][:2] - walls["start"]
    place = (apart * along).sum(axis=1)
    off = np.abs(apart[:, 0] * along[:, 1] - apart[:, 1] * along[:, 0])
    past = np.maximum(np.maximum(-place, place - length), 0.0)
    adjoining = np.isin(walls["rooms"], inner).sum(axis=1)
    two = (np.sort(walls["rooms"], axis=1) == np.sort(rooms)).all(axis=1)
    cost = np.hypot(off, past) + np.where(two, 0.0, STRANGE)
    fits = np.isin(walls["storey"], table["storey"][inner]) & (adjoining > 0) & (off <= CARRIER_REACH)
    fits &= past <= (0.5 - LEAST_SHARE) * edge["width"] + 0.1
    return int(np.flatnonzero(fits)[cost[fits].argmin()]) if fits.any() else -1


def _set_into(opening: Any, wall: Array) -> None:
    line = wall["end"] - wall["start"]
    length = float(np.hypot(*line))
    along = line / length
    width = min(float(opening["width"]), length)
    place = float(np.clip((opening["centre"][:2] - wall["start"]) @ along, width / 2, length - width / 2))
    opening["centre"][:2] = wall["start"] + along * place
    opening["width"], opening["direction"] = width, float(np.arctan2(along[0], -along[1]) % np.pi)


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


def trace_room_outline(floor: shapely.MultiPolygon, lines: list[Line]) -> shapely.MultiPolygon:
    """Return the floor with its edges on the lines of walls, m; the floor itself where there are none."""
    if floor.is_empty or not lines:
        return floor
    box = shapely.box(*floor.bounds).buffer(OUTLINE_MARGIN, join_style="mitre")
    low = np.array(floor.bounds[:2])
    walls = [_extend_line(line, LINE_GAP / 2 if line.length > LINE_GAP else REACH_ON, low) for line in lines]
    long = [_extend_line(line, 1e3, low) for line in lines]
    own = [_extend_line(edge, REACH_ON, low) for edge in find_unseen_edges(floor, lines)]
    seen = [wall for wall, line in zip(walls, lines, strict=True) if line.weight > 0]
    box, moved = shapely.affinity.translate(box, *-low), shapely.affinity.translate(floor, *-low)
    drawn = shapely.intersection(np.array([*long, *own]), box)
    network = shapely.union_all([*drawn, box.exterior], grid_size=CORNER_GRID)
    pieces = shapely.get_parts(shapely.polygonize(shapely.get_parts(network)))
    room = _label_pieces(pieces, moved, shapely.union_all([s.buffer(1e-4, cap_style="flat") for s in seen]))
    shape = shapely.union_all(pieces[room], grid_size=CORNER_GRID) if room.any() else moved
    parts = [p for p in shapely.get_parts(shapely.simplify(shape, 1e-4)) if p.area > 0.05]
    parts = [shapely.Polygon(p.exterior, [h for h in p.interiors if shapely.Polygon(h).area > 0.2]) for p in parts]
    placed = shapely.affinity.translate(shapely.MultiPolygon(parts), *low)
    return shapely.MultiPolygon([shapely.geometry.polygon.orient(p) for p in placed.geoms]) if parts else floor


def _extend_line(line: Line, more: float, low: Array) -> shapely.LineString:
    ends = [line.middle - low + line.along * t for t in (line.start - more, line.end + more)]
    return shapely.LineString(ends)


def find_unseen_edges(floor: shapely.MultiPolygon, lines: list[Line]) -> list[Line]:
    """Return edges of a floor, beside which no line of a wall runs; nothing was seen on them."""
    out = []
    for part in shapely.get_parts(shapely.simplify(floor, SIMPLER)):
        for ring in (part.exterior, *part.interiors):
            for a, b in pairwise(np.asarray(ring.coords)[:, :2]):
                length = float(np.hypot(*(b - a)))
                edge = Line((a + b) / 2, (b - a) / max(length, 1e-9), -length / 2, length / 2)
                if length >= OWN_EDGE and not any(_is_along(line, edge) for line in lines):
                    out.append(edge)
    return out


def _is_along(line: Line, edge: Line) -> bool:
    t = float((edge.middle - line.middle) @ line.along)
    near = line.start - REACH_ON < t < line.end + REACH_ON and abs(line.along @ edge.along) > SAME_TURN
    return near and abs(float((edge.middle - line.middle) @ line.across)) < SAME_LINE


def _label_pieces(pieces: Array, floor: shapely.MultiPolygon, seen: shapely.Geometry) -> Array:
    """Return (n,) bool: which pieces are room."""
    area = shapely.area(pieces)
    inside = shapely.area(shapely.intersection(pieces, floor))
    a, b, edges = _find_borders(pieces)
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


def _find_borders(pieces: Array) -> tuple[Array, Array, Array]:
    """Return the pairs of pieces that share an edge, and the edge."""
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


def separate_outlines(outlines: list[shapely.MultiPolygon]) -> list[shapely.MultiPolygon]:
    """Return the outlines of one storey without what an earlier one covers already."""
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


SAME_FACE = 0.05  # m: lines no farther apart are one face
PARALLEL = np.cos(np.radians(4.0))
THIN, THICK = 0.05, 0.45  # m: gaps between faces of two rooms that say how thick walls are
UNKNOWN_THICKNESS = 0.12  # m, of inner walls
BESIDE_LINE = 0.4  # m: here a floor must lie, on the side of a line from which a room sees it
HIDDEN = 0.12  # m: so near to a neighbour's face a floor ends at a wall that hides behind furniture
SAMPLES = np.linspace(0.05, 0.95, 13)


def resolve_shared_lines(lines: list[list[Line]], floors: list[shapely.MultiPolygon]) -> list[list[Line]]:
    """Return the lines of each room, without those that a neighbour sees better, before which the room's own are put.

    Args:
        lines: of each room of a storey.
        floors: of each, m.
    """
    for floor in floors:
        shapely.prepare(floor)
    faces = [_Face(r, line, _find_room_side(line, floors[r])) for r, own in enumerate(lines) for line in own]
    faces += [
        _Face(r, line, _find_room_side(line, floors[r]))
        for r, own in enumerate(lines)
        for line in find_unseen_edges(floors[r], own)
    ]
    pairs = _find_parallel_pairs([face.line for face in faces])
    gaps = [_measure_gap(faces[i], faces[j]) for i, j in pairs if faces[i].line.weight * faces[j].line.weight > 0]
    usual = [gap for gap in gaps if THIN < gap < THICK]
    thickness = float(np.median(usual)) if usual else UNKNOWN_THICKNESS
    better: dict[int, int] = {}
    for i, j in pairs:
        a, b = faces[i], faces[j]
        reach = SAME_FACE if a.line.weight else HIDDEN
        if a.room != b.room and (a.line.weight, -i) < (b.line.weight, -j) and _measure_distance(a.line, b.line) < reach:
            better.setdefault(i, j)
    out: list[list[Line]] = [[] for _ in lines]
    for i, face in enumerate(faces):
        if i not in better:
            out[face.room] += [face.line] if face.line.weight else []
        elif face.side.any():
            out[face.room].append(_shift_line(faces[better[i]].line, face.side * thickness, face.line))
    return out


@dataclass(frozen=True, eq=False)
class _Face:
    """A line of a room; `side` (2,) leads from it into the room, unit; 0 where it is not known."""

    room: int
    line: Line
    side: Array


def _find_parallel_pairs(lines: list[Line]) -> list[tuple[int, int]]:
    """Return the ordered pairs of nearly parallel lines that lie beside each other."""
    if not lines:
        return []
    segments = [shapely.LineString(line.ends) for line in lines]
    first, second = shapely.STRtree(segments).query(segments, predicate="dwithin", distance=THICK)
    along = np.array([line.along for line in lines])
    straight = (np.abs((along[first] * along[second]).sum(axis=1)) > PARALLEL) & (first != second)
    pairs = zip(first[straight].tolist(), second[straight].tolist(), strict=True)
    return [(i, j) for i, j in pairs if _measure_overlap(lines[i], lines[j]) > 0.2]


def _measure_overlap(a: Line, b: Line) -> float:
    t = np.sort((b.ends - a.middle) @ a.along)
    return float(min(t[1], a.end) - max(t[0], a.start))


def _measure_distance(a: Line, b: Line) -> float:
    """Measure the distance, m, between two lines, in the middle of where they lie beside each other."""
    t = np.sort((b.ends - a.middle) @ a.along)
    middle = a.middle + a.along * (min(t[1], a.end) + max(t[0], a.start)) / 2
    return abs(float((middle - b.middle) @ b.across))


def _measure_gap(a: _Face, b: _Face) -> float:
    """Measure the metres of wall between two faces; -1 where they do not look away from each other."""
    if a.room == b.room or a.side @ b.side > -PARALLEL or (b.line.middle - a.line.middle) @ a.side > 0:
        return -1.0
    return _measure_distance(a.line, b.line)


def _find_room_side(line: Line, floor: shapely.MultiPolygon) -> Array:
    """Return (2,) across a line to where the room lies; 0 where it lies on both sides or on none."""
    at = line.ends[0] + SAMPLES[:, None] * (line.ends[1] - line.ends[0])
    left, right = (float(_is_within(floor, at + line.across * way).mean()) for way in (BESIDE_LINE, -BESIDE_LINE))
    return line.across * (0 if abs(left - right) < 0.3 else 1 if left > right else -1)


def _is_within(floor: shapely.MultiPolygon, points: Array) -> Array:
    return np.asarray(shapely.contains_xy(floor, points[:, 0], points[:, 1]))


def _shift_line(line: Line, off: Array, extent: Line) -> Line:
    """Return a line that is concluded: one moved by `off` (2,) m, as long as another."""
    t = np.sort((extent.ends - line.middle) @ line.along)
    return replace(line, middle=line.middle + off, start=float(t[0]), end=float(t[1]), weight=0.0)


@dataclass(frozen=True, eq=False)
class PlanStructure:
    """Walls, openings and windows between the rooms of a map.

    Args:
        walls: (W,) WALL_DTYPE, by storey.
        openings: (O,) OPENING_DTYPE, a row for each door and opening of the map that is no flight of stairs.
        windows: (N,) SET_WINDOW_DTYPE, a row for each window of the map.
        rooms: of each room its floor between the faces of its walls, m, counter-clockwise; rooms of a storey do not overlap.
        storey_of_rooms: (R,) int32.
    """

    walls: Array
    openings: Array
    windows: Array
    rooms: list[shapely.MultiPolygon]
    storey_of_rooms: Array


def build_plan_structure(map: TopometricMap) -> PlanStructure:
    """Build the walls, openings and outlines of rooms of a map; the same map gives the same ones.

    A room's faces are straight lines through the means of the cells that it sees; its outline runs along them where they are, and
    where no wall was seen, and in maps that do not hold these means, along its floor (`build_floor_polygons`). Two faces that
    look away
    from each other, no more than 0.6 m apart, are a wall; the other faces are walls of which one side was seen.
    """
    if map not in _structures:
        _structures[map] = _compute_structure(map)
    return _structures[map]


_structures: WeakKeyDictionary[TopometricMap, PlanStructure] = WeakKeyDictionary()  # several formats need it


def _compute_structure(map: TopometricMap) -> PlanStructure:
    floors = build_floor_polygons(map)
    rooms, walls = list(floors), [np.zeros(0, WALL_DTYPE)]
    for storey in range(len(map.storeys)):
        of = np.flatnonzero(map.rooms["storey"] == storey)
        points = select_face_points(map, storey, floors)
        if points.measured:
            for r, outline in zip(of.tolist(), _trace_outlines(points, of, floors), strict=True):
                rooms[r] = outline
        walls.append(detect_walls(map, storey, rooms, points))
    every = np.concatenate(walls)
    openings = place_openings(map, every) if len(map.edges) else np.zeros(0, OPENING_DTYPE)
    return PlanStructure(every, openings, place_windows(map, every), rooms, map.rooms["storey"])


def _trace_outlines(points: FacePoints, rooms: Array, floors: list[shapely.MultiPolygon]) -> list[shapely.MultiPolygon]:
    columns = [find_wall_columns(points, r) for r in rooms.tolist()]
    main = estimate_main_direction([line for column in columns for line in detect_lines(*column)])
    own = [floors[r] for r in rooms.tolist()]
    lines = resolve_shared_lines([detect_lines(*column, main) for column in columns], own)
    return separate_outlines([trace_room_outline(*room) for room in zip(own, lines, strict=True)])
