"""Rooms as polygons: what the exports for plans and models share.

The floor of a room is its navigable cells seen from above. Their outline is made of steps as long as a cell; straight walls are
fitted to it, so that a room that stands askew has straight walls, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import shapely
from scipy import ndimage

from topomerge.kernels.occupied_cells import OFFSET_STEPS
from topomerge.types import Array, TopometricMap

CLOSED_GAP = 0.1  # m: gaps in a floor up to twice this are closed: scan lines
FLOOR_HOLE = 1.0  # m2: smaller holes in a floor are furniture, shadows or columns
OUTLINE_STEP = 1.6  # cells: smaller jogs of an outline are steps of its cells
BEVEL = 7  # cells: a wall across a corner that is shorter is none
CORNER_REACH = 4.0  # cells: so far from the end of a wall it may meet the next
GROWTH = 0.3  # m: a floor is grown to its wall by at most this
SPECK = 0.05  # m2: smaller pieces of a floor are left out
UNSEEN_HEIGHT = 2.5  # m: of a room whose ceiling nobody saw


def build_floor_polygons(map: TopometricMap) -> list[shapely.MultiPolygon]:
    """Return the floor of each room in the input's frame, m, exteriors counter-clockwise; rooms of a storey do not overlap.

    Navigable cells end short of the walls. All outlines are moved outwards by the distance at which their areas are those in the
    table of rooms, in the median. A room without navigable cells has its bounding box; it is empty where that is flat.
    """
    if map not in _FOUND:
        _FOUND[map] = _build_floors(map)
    return list(_FOUND[map])


_FOUND: WeakKeyDictionary[TopometricMap, list[shapely.MultiPolygon]] = WeakKeyDictionary()  # several formats need them


def _build_floors(map: TopometricMap) -> list[shapely.MultiPolygon]:
    edge, origin = map.navigable.edge, map.navigable.origin[:2]
    plans = [_rasterise_floor(map.navigable.cells[rows, :2], edge) for rows in _group_by_room(map.navigable_room, len(map.rooms))]
    cells = [None if plan is None else _straighten_walls(_trace_polygon(plan.cells, plan.low)) for plan in plans]
    growth = _estimate_growth(map, plans, cells)
    floors: list[shapely.MultiPolygon] = []
    adjoining: dict[int, list[shapely.MultiPolygon]] = {}
    for r, shape in enumerate(cells):
        if shape is None:
            floor = shapely.box(*map.rooms["lo"][r, :2], *map.rooms["hi"][r, :2])
        else:
            grown = shape.buffer(growth / edge, join_style="mitre", mitre_limit=1.5)
            floor = shapely.affinity.affine_transform(grown, [edge, 0, 0, edge, *origin])
        others = adjoining.setdefault(int(map.rooms["storey"][r]), [])
        taken = [others[k] for k in np.flatnonzero(shapely.intersects(others, floor))] if others else []
        floors.append(_collect_polygons(floor.difference(shapely.union_all(taken)) if taken else floor, SPECK))
        others.append(floors[-1])
    return floors


def measure_room_levels(map: TopometricMap) -> tuple[Array, Array]:
    """Return (R, 2) floor and ceiling of each room, m; (R,) bool: was a ceiling seen?

    A room without one reaches to that of its storey, or is 2.5 m high.
    """
    z = map.navigable.compute_centroids()[:, 2]
    levels = np.zeros((len(map.rooms), 2))
    for r, rows in enumerate(_group_by_room(map.navigable_room, len(map.rooms))):
        room, storey = map.rooms[r], map.storeys[map.rooms["storey"][r]]
        floor = _estimate_floor_level(map.navigable.cells[rows], z[rows]) if len(rows) else float(room["lo"][2])
        height = float(room["height"]) or float(storey["ceiling"]) - floor
        levels[r] = floor, floor + (height if np.isfinite(height) and height > 0 else UNSEEN_HEIGHT)
    return levels, map.rooms["height"] > 0


def compute_jambs(edge: Any) -> Array:
    """Return (2, 3) the two sides of a door (a row of `edges`) on its floor, m."""
    along = np.array([-np.sin(edge["direction"]), np.cos(edge["direction"]), 0.0]) * float(edge["width"]) / 2
    return np.stack([edge["centre"] - along, edge["centre"] + along])


def is_flight(edge: Any) -> bool:
    """Return whether an edge leads from storey to storey, with a lower and an upper end."""
    return str(edge["kind"]) in ("stairs", "ramp")


def find_inside_point(floor: shapely.MultiPolygon, requested: Array) -> Array:
    """Return (2,) `requested`, where that lies inside the floor, else a point that does, m."""
    point = shapely.Point(*requested[:2])
    if floor.is_empty or floor.contains(point):
        return np.asarray(requested[:2], np.float64)
    return np.asarray(max(floor.geoms, key=lambda part: part.area).representative_point().coords[0])


def _group_by_room(label: Array, count: int) -> list[Array]:
    order = np.argsort(label, kind="stable")
    return np.split(order, np.searchsorted(label[order], np.arange(count + 1)))[1:-1]


def _estimate_floor_level(cells: Array, z: Array) -> float:
    """Return the median height of the lowest cell of each column: what lies above is its dilation upwards, or a gallery."""
    order = np.lexsort((z, cells[:, 1], cells[:, 0]))
    column = cells[order, :2]
    first = np.ones(len(order), bool)
    first[1:] = (column[1:] != column[:-1]).any(axis=1)
    return float(np.median(z[order][first]))


@dataclass(frozen=True, eq=False)
class _Plan:
    """A floor from above: cell (i, j) of `cells` is column low + (i, j) of the grid."""

    cells: Array  # (nx, ny) bool, with small gaps and holes filled
    low: Array  # (2,)
    filled: int  # how many cells that were


def _rasterise_floor(columns: Array, edge: float) -> _Plan | None:
    """Return the floor over columns (n, 2) of a grid."""
    if not len(columns):
        return None
    reach = max(round(CLOSED_GAP / edge), 1)
    low = columns.min(axis=0) - reach - 1
    plan = np.zeros(columns.max(axis=0) - low + reach + 2, bool)
    plan[tuple((columns - low).T)] = True
    closed = ndimage.binary_closing(plan, ndimage.generate_binary_structure(2, 1), iterations=reach) | plan
    holes, _ = ndimage.label(ndimage.binary_fill_holes(closed) & ~closed)
    small = np.bincount(holes.ravel()) * edge**2 <= FLOOR_HOLE
    small[0] = False
    filled = closed | small[holes]
    return _Plan(filled, low, int(filled.sum() - plan.sum()))


def _trace_polygon(cells: Array, low: Array) -> shapely.MultiPolygon:
    """Return the filled cells as polygons, in cells: the union of their runs along y."""
    change = np.diff(np.pad(cells, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    x, start = np.nonzero(change == 1)
    stop = np.nonzero(change == -1)[1]
    runs = shapely.union_all(shapely.box(x, start, x + 1, stop))
    return _collect_polygons(shapely.affinity.translate(runs, *low.tolist()))


def _estimate_growth(map: TopometricMap, plans: list[_Plan | None], cells: list[Any]) -> float:
    """Estimate the distance, m, between the cells of floors and the walls around them."""
    edge = map.navigable.edge
    missing = [
        (float(map.rooms["area"][r]) / edge**2 + plan.filled - shape.area) / shape.length * edge
        for r, (plan, shape) in enumerate(zip(plans, cells, strict=True))
        if plan is not None
    ]
    return float(np.clip(np.median(missing), 0.0, GROWTH)) if missing else 0.0


def _straighten_walls(cells: shapely.MultiPolygon) -> shapely.MultiPolygon:
    """Put straight walls in place of the steps of cells."""
    parts = []
    for part in cells.geoms:
        rings = [_straighten_ring(np.asarray(ring.coords)[:-1]) for ring in (part.exterior, *part.interiors)]
        straight = _collect_polygons(
            shapely.make_valid(shapely.Polygon(rings[0], [ring for ring in rings[1:] if len(ring) > 2])), 4.0
        )
        # Fitted walls of a very narrow place can cross each other: there the cells say it better.
        parts.append(straight if abs(straight.area - part.area) < 0.1 * part.area + 2 else part)
    return _collect_polygons(shapely.union_all(parts))


def _straighten_ring(corners: Array) -> Array:
    """Return (k, 2) corners of a ring around cells -> (j, 2) corners of one with straight walls, all in cells.

    The middles of the cells' sides lie nearer to the wall than their corners do. Walls are found among them (Douglas and Peucker
    1973) and fitted by least squares.
    """
    ring = shapely.segmentize(shapely.LinearRing(corners), 1.0)
    middle = np.asarray(ring.coords)
    middle = (middle[1:] + middle[:-1]) / 2
    far = int(((middle - middle.mean(axis=0)) ** 2).sum(axis=1).argmax())  # begins at a corner of the room, not amid a wall
    middle = np.roll(middle, -far, axis=0)
    middle = np.concatenate([middle, middle[:1]])
    number = {tuple(point): i for i, point in reversed(list(enumerate(middle.tolist())))}
    corners_of_walls = shapely.simplify(shapely.LineString(middle), OUTLINE_STEP, preserve_topology=False).coords
    cuts = [number[point] for point in corners_of_walls[:-1]] + [len(middle) - 1]
    walls = [middle[a : b + 1] for a, b in pairwise(cuts)]
    walls = _remove_bevels([wall for wall in walls if len(wall) > 3] if len(walls) > 4 else walls)
    return _intersect_walls(walls) if len(walls) > 2 else corners


def _remove_bevels(walls: list[Array]) -> list[Array]:
    """Return the walls without short ones across a corner, where the two beside them meet: nobody stood in the tip of that
    corner."""
    lines = [_fit_line(points) for points in walls]
    long_walls = []
    for k, points in enumerate(walls):
        met = _intersect_lines(lines[k - 1], lines[(k + 1) % len(walls)]) if len(points) <= BEVEL else None
        if met is None or np.hypot(*(met - points.mean(axis=0))) > CORNER_REACH:
            long_walls.append(points)
    return long_walls


def _intersect_walls(walls: list[Array]) -> Array:
    """Return (j, 2) where walls, given by points (n, 2) along them, meet; two for walls side by side."""
    lines = [_fit_line(points) for points in walls]
    corners: list[Array] = []
    for k in range(len(walls)):
        before, after = lines[k - 1], lines[k]
        end, start = walls[k - 1][-1], walls[k][0]
        met = _intersect_lines(before, after)
        if met is not None and np.hypot(*(met - (end + start) / 2)) <= CORNER_REACH:
            corners.append(met)
        else:
            corners += [m + d * float((p - m) @ d) for (m, d), p in ((before, end), (after, start))]
    return np.array(corners)


def _fit_line(points: Array) -> tuple[Array, Array]:
    """Return a point and the direction of the line through most of the points (n, 2): niches of a cell, as at doors, do not turn
    it."""
    points = points[2:-2] if len(points) > 8 else points  # cut across the corners
    weight = np.ones(len(points))
    for _ in range(5):
        middle = weight @ points / weight.sum()
        along = np.linalg.svd((points - middle) * np.sqrt(weight)[:, None], full_matrices=False)[2][0]
        off = np.abs((points - middle) @ (-along[1], along[0]))
        weight = 1 / np.maximum(off, 0.3)
    return middle, along


def _intersect_lines(a: tuple[Array, Array], b: tuple[Array, Array]) -> Array | None:
    """Return (2,) where two lines meet; None where they are too nearly parallel to say."""
    cross = a[1][0] * b[1][1] - a[1][1] * b[1][0]
    if abs(cross) < 0.2:
        return None
    apart = b[0] - a[0]
    met: Array = a[0] + a[1] * (apart[0] * b[1][1] - apart[1] * b[1][0]) / cross
    return met


def _collect_polygons(shape: Any, least: float = 0.0) -> shapely.MultiPolygon:
    """Return the polygons in any shape, counter-clockwise; those smaller than `least` only where there are no others."""
    parts = [p for p in shapely.get_parts(shape) if p.geom_type == "Polygon" and p.area > 0]
    large = [p for p in parts if p.area >= least] or parts
    return shapely.MultiPolygon([shapely.geometry.polygon.orient(p) for p in large])


FACE_HEIGHTS = (0.3, 2.2)  # m above the floor: skirting and ceilings are no faces of walls
ABOVE = 6.0  # m above the floor: cells higher up are of no use
LEAST_CELLS = 6  # of a column, between 0.3 and 2.2 m: fewer are furniture
FULL_COLUMN = 12  # cells: as many say no more
STRAY = 1.0  # m: cells of no room belong to a floor this near


@dataclass(frozen=True, eq=False)
class FacePoints:
    """Cells of one storey.

    Args:
        at: (n, 2) float64 m, mean of the points of each cell, or its middle.
        height: (n,) m above the floor of the room.
        room: (n,) int32 the room that sees it, -1 none.
        column: (n,) int64 cells of one column and room have one number.
        edge: m, of a cell.
        measured: are the means of points known?
    """

    at: Array
    height: Array
    room: Array
    column: Array
    edge: float
    measured: bool

    @property
    def upright(self) -> Array:
        """(n,) bool: at the heights of `FACE_HEIGHTS`."""
        return np.asarray((self.height > FACE_HEIGHTS[0]) & (self.height < FACE_HEIGHTS[1]))


def select_face_points(map: TopometricMap, storey: int, floors: list[shapely.MultiPolygon] | None = None) -> FacePoints:
    """Return the cells of a storey above its floors.

    Args:
        floors: of each room of the map, m; cells of no room go to the nearest. None: they stay out.
    """
    grid = map.grid
    rows = np.flatnonzero(map.find_cell_storeys() == storey)
    cells, offset = grid.cells[rows], grid.properties.get("offset")
    within = 0.5 if offset is None else (offset[rows].astype(np.float64) + 0.5) / OFFSET_STEPS
    middles = grid.origin + (cells + within) * grid.edge
    room = map.room[rows].astype(np.int32)
    stray, rooms = np.flatnonzero(room < 0), np.flatnonzero(map.rooms["storey"] == storey)
    if floors is not None and len(stray) and len(rooms):
        columns, of = np.unique(cells[stray, :2], axis=0, return_inverse=True)
        middle = grid.origin[:2] + (columns + 0.5) * grid.edge
        tree = shapely.STRtree([floors[r] for r in rooms])
        near, which = tree.query_nearest(shapely.points(middle), max_distance=STRAY, all_matches=False)
        nearest = np.full(len(columns), -1, np.int32)
        nearest[near] = rooms[which]
        room[stray] = nearest[of.ravel()]
    floor = np.append(measure_room_levels(map)[0][:, 0], map.storeys["floor"][storey])
    height = middles[:, 2] - floor[room]
    use = (height > 0) & (height < ABOVE) & ((floors is not None) | (room >= 0))
    column = (cells[:, 0].astype(np.int64) * grid.shape[1] + cells[:, 1]) * (len(map.rooms) + 1) + room + 1
    return FacePoints(middles[use, :2], height[use], room[use], column[use], grid.edge, offset is not None)


def find_wall_columns(points: FacePoints, room: int) -> tuple[Array, Array]:
    """Return (n, 2) where the columns of a room that fill like walls stand, m, and (n,) m of wall that each is."""
    rows = np.flatnonzero(points.upright & (points.room == room))
    _, column, count = np.unique(points.column[rows], return_inverse=True, return_counts=True)
    at = np.column_stack([np.bincount(column, points.at[rows, k], len(count)) / np.maximum(count, 1) for k in (0, 1)])
    scale = 0.1 / points.edge  # how many cells stand above each other
    full = count >= LEAST_CELLS * scale
    return at[full], np.minimum(count[full] / (FULL_COLUMN * scale), 1.0) * points.edge
